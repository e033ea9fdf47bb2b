"""Langevin dynamics on constraints: the geodesic BAOAB scheme."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kcons.constraints.arguments import Count, NotNegative, Positive, Rng, checked, seed_from
from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.solvers.kernels.array_views import flat
from kcons.steppers import State, System
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Evaluate, Exchange, Kick, Operation, Project, drifts_of
from kcons.steppers.program import Program, Row
from kcons.thermostats.freedom import carried, refuse_dissipation
from kcons.thermostats.noise import fill_next

#: What the numbers of a bath begin with: the heat that has flowed in, the kinetic energy after noise, gamma and k_B T,
#: whether something is added to noise in Python, the seed's halves, the number of the step, how often noise has been
#: drawn in it, and how often it is in each; then masses and 1/sqrt(m) for each coordinate, 0 for fixed atoms; noise.
HEAT, WARM, FRICTION, KT, ASIDE, SEED, MASSES = 0, 1, 2, 3, 4, 5, 10


def noise_generator(key: tuple[int, int], number: int, part: int = 0) -> np.random.Generator:
    """A generator of numbers that are a function of a key, the number of a step and its part."""
    counter = np.array([0, 0, number, part], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter))


class SeededBath(Interpreted):
    """What baths share whose noise is a function of a seed and of the number of the step.

    Attributes
    ----------
    thermal_energy, friction : float
    seed : int
        What `rng` was, or what was drawn from it.
    substeps : int
        See `Langevin`.
    exchanged : (int, float) or None
        Number of the last step that was made, and its kinetic energy after noise in its middle, for logs: there
        velocities are as warm as the bath, at the ends of steps those of stiff motions are colder. None without noise.
    """

    exchanged: tuple[int, float] | None = None
    #: The operations of a step, and as the interpreter goes through them; of one whose flights are great circles.
    _in_flights: tuple[tuple[Operation, ...], Program]
    _great_circles: tuple[tuple[Operation, ...], Program]

    order = 2
    reversible = False
    symplectic = False
    force_evaluations = 1

    @checked
    def __init__(self, thermal_energy: Positive, friction: NotNegative, rng: Rng, substeps: Count) -> None:
        self.thermal_energy, self.friction, self.substeps = thermal_energy, friction, substeps
        self.seed = seed_from(rng)

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for velocity-dependent forces, and friction besides that of the thermostat."""
        refuse_dissipation(system, "place in this scheme; use friction")

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        return self.listed(system)[0]

    def listed(self, system: System | None) -> tuple[tuple[Operation, ...], Program]:
        """The operations, and as the interpreter goes through them."""
        return self._in_flights if system is None or system.great_circles is None else self._great_circles

    def depends_on(self, system: System, state: State) -> Any:
        return self.thermal_energy, self.friction, self.seed

    def refuse_back(self, system: System, dt: float) -> None:
        """Raise `InputError` for a negative time step."""
        if dt < 0:
            raise InputError(f"the time step is {system.shown_time(dt)}; noise cannot be taken back", item="dt")

    def drawn(self, number: int, shape: tuple[int, ...], part: int = 0) -> FloatArray:
        """Normal numbers that are a function of the seed, of the number of the step, and of its part."""
        return noise_generator((self.seed, 0), number, part).standard_normal(shape)


class Langevin(SeededBath):
    """Canonical sampling on constraints: kick, drift, friction and noise, drift, kick (g-BAOAB).

    Friction and noise act on velocities in the tangent plane, v = M_par^+ M (e^{-gamma dt} v + noise), exactly; the
    drifts follow the constraints in `substeps` RATTLE substeps each (great circles where possible), which cost no
    force evaluation. Sampling errors are of order dt^2 with a constant far below that of other schemes for
    configurations; velocities are less accurate.

    A step is a function of the state alone, also its noise: it is drawn for (seed, number of the step), so that a
    run continued from a saved state is the same to the last bit.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    friction : float
        gamma, in inverse units of time.
    rng : int, numpy.random.Generator or None
        A seed, or what one is drawn from, which `seed` then tells; None takes it from the operating system.
    substeps : int
        RATTLE substeps in each of the two drifts.

    Notes
    -----
    `State.thermostat` holds the heat that has flowed in: total energy less it is conserved (`conserved_energy`) to the
    order of the scheme.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    def __init__(self, thermal_energy: float, friction: float, rng: Rng, *, substeps: int = 3) -> None:
        super().__init__(thermal_energy, friction, rng, substeps)
        self._in_flights = listed_and_made(_geodesic_baoab((1.0 / self.substeps,) * self.substeps))
        self._great_circles = listed_and_made(_geodesic_baoab((1.0,), exact=True))

    def __repr__(self) -> str:
        return f"Langevin({self.thermal_energy!r}, {self.friction!r}, rng={self.seed}, substeps={self.substeps})"

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        self.refuse_back(system, dt)
        carried(state, 1, "Langevin")
        return LangevinStep(system, system.with_forces(state), dt, self, steps)

    def conserved_energy(self, system: System, state: State) -> float:
        """Total energy less the heat that has flowed in."""
        return system.total_energy(state) - (0.0 if state.thermostat is None else float(state.thermostat[0]))


def _geodesic_baoab(flight: tuple[float, ...], *, exact: bool = False) -> tuple[Operation, ...]:
    first, second = drifts_of((0.5, 0.5), flight, exact=exact)
    return Kick(0.5), first, Exchange(1.0), second, Evaluate(), Kick(0.5), Project()


class _Measure(Operation):
    """The heat that has come in since."""

    verb, meaning = "measure", "heat"


def listed_and_made(operations: tuple[Operation, ...], groups: tuple[str, ...] = ("",)) -> tuple[Any, Program]:
    """Operations, and the program in which an exchange is between projections, after which its heat is measured."""
    parts: list[Operation] = []
    for operation in operations:
        exchange = isinstance(operation, Exchange)
        parts += [Project(), operation, Project(), _Measure()] if exchange else [operation]
    return operations, Program(parts, {"exchange": _exchange, "measure": _measure}, groups)


_SUMS = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, fastmath=_SUMS)
def kinetic(v, masses):  # type: ignore[no-untyped-def]
    """sum m v^2/2, of numbers in a row."""
    total = 0.0
    for i in range(v.size):
        total += masses[i] * v[i] * v[i]
    return 0.5 * total


@njit(cache=True, nogil=True)
def _exchange(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """Draw noise and mix it in; 1 where something has to be added to it before."""
    n = v.size
    roots, noise = numbers[MASSES + n : MASSES + 2 * n], numbers[MASSES + 2 * n : MASSES + 3 * n]
    fill_next(numbers[SEED:MASSES], noise)
    spread = math.sqrt(-math.expm1(-2 * numbers[FRICTION] * time) * numbers[KT])
    for i in range(n):
        noise[i] *= spread * roots[i]
    if numbers[ASIDE] != 0.0:
        return 1
    _mix(v, time, numbers)
    return 0


@njit(cache=True, nogil=True)
def _mix(v, time, numbers):  # type: ignore[no-untyped-def]
    """v = keep v + noise."""
    u, n = flat(v), v.size
    noise, keep = numbers[MASSES + 2 * n :], math.exp(-numbers[FRICTION] * time)
    numbers[WARM] = kinetic(u, numbers[MASSES : MASSES + n])
    for i in range(n):
        u[i] = keep * u[i] + noise[i]


@njit(cache=True, nogil=True)
def _measure(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    before = numbers[WARM]
    numbers[WARM] = kinetic(flat(v), numbers[MASSES : MASSES + v.size])
    numbers[HEAT] += numbers[WARM] - before
    return 0


class LangevinStep(Interpreter):
    """Steps on their way."""

    def __init__(self, system: System, start: State, dt: float, thermostat: Langevin, steps: int) -> None:
        heat = 0.0 if start.thermostat is None else float(start.thermostat[HEAT])
        program, masses = thermostat.listed(system)[1], system.moving_masses
        aside, seed = system.motion.plan.driven, divmod(thermostat.seed, 2**32)
        parts = sum(row.name == "exchange" for row in program.rows)
        head = heat, 0.0, thermostat.friction, thermostat.thermal_energy, aside, *seed, start.step + 1, 0, parts
        numbers = np.concatenate((head, masses, system.root_weights.ravel(), masses))
        super().__init__(system, start, dt, program, steps, numbers)
        self.thermostat = thermostat

    def exchange(self, row: Row, begun: bool) -> None:
        """Velocities of targets, on which friction does not act, are added to the noise."""
        dt, v = row.length * self.dt, self.v
        x, time = self.place(row.here), self.at(row.end)
        kept = self.system.motion.project_velocities(x, np.zeros_like(v), time=time)
        noise = self.numbers[MASSES + 2 * v.size :].reshape(v.shape)
        noise += (1.0 - math.exp(-self.thermostat.friction * dt)) * kept
        _mix(v, dt, self.numbers)

    def variables(self) -> FloatArray:
        if self.thermostat.friction > 0:
            self.thermostat.exchanged = self.number, float(self.numbers[WARM])
        return self.numbers[: HEAT + 1].copy()
