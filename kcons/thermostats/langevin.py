"""Langevin dynamics on constraints: the geodesic BAOAB scheme, with one time step or several."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from kcons.constraints.arguments import Count, NotNegative, Positive, Rng, checked, seed_from
from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.solvers.kernels.array_views import flat
from kcons.steppers import State, System
from kcons.steppers.compiled_operations import square_sum
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Evaluate, Exchange, Operation, Program, Project, Row
from kcons.thermostats.force_groups import GroupedForces, SlowKicks, group_names, levels_of, middle_of, nested
from kcons.thermostats.freedom import carried, refuse_dissipation
from kcons.thermostats.noise import fill_next, noise_generator

#: What the numbers of a bath begin with: the heat that has flowed in, the kinetic energy after noise, gamma and k_B T,
#: whether something is added to noise in Python, the seed's halves, the number of the step, how often noise has been
#: drawn in it, and how often it is in each; then masses and 1/sqrt(m) for each coordinate, 0 for fixed atoms; noise.
HEAT, WARM, FRICTION, KT, ASIDE, SEED, MASSES = 0, 1, 2, 3, 4, 5, 10


class SeededBath(Interpreted):
    """What baths share whose noise is a function of a seed and of the number of the step.

    Attributes
    ----------
    thermal_energy, friction : float
    seed : int
        What `rng` was, or what was drawn from it.
    substeps : int
        See `Langevin`.
    names : tuple of str
        Groups of forces from the slowest to the fastest.
    middle : bool
        Whether the slowest kicks in the middle of a step.
    exchanged : (int, float) or None
        Number of the last step that was made, and its kinetic energy after noise in its middle, for logs: there
        velocities are as warm as the bath, at the ends of steps those of stiff motions are colder. None without noise.
    """

    exchanged: tuple[int, float] | None = None
    #: Whether kicks turn velocities on spheres.
    turns: ClassVar[bool] = False

    order = 2
    reversible = False
    symplectic = False

    @checked
    def __init__(
        self,
        thermal_energy: Positive,
        friction: NotNegative,
        rng: Rng,
        substeps: Count,
        steps: Mapping[str, int] | None = None,
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        self.thermal_energy, self.friction, self.substeps = thermal_energy, friction, substeps
        self.seed = seed_from(rng)
        levels = levels_of(steps)
        self.names = tuple(level.group for level in levels)
        self.middle = middle_of(levels, slow_kicks)
        flight = (1.0 / substeps,) * substeps
        listed = nested(levels, flight, turns=self.turns, middle=self.middle)
        exact = nested(levels, (1.0,), turns=self.turns, exact=True, middle=self.middle)
        self.force_evaluations = sum(isinstance(operation, Evaluate) for operation in listed)
        #: Of flights, and of great circles.
        self._programs = self._made(listed), self._made(exact)
        counts = {level.group: level.steps for level in levels}
        self._words = "" if steps is None else f", steps={counts}", ", slow_kicks='middle'" if self.middle else ""

    def _made(self, operations: tuple[Operation, ...]) -> Any:
        """The program of a step, or several."""
        raise NotImplementedError

    def check(self, system: System) -> None:
        """Raise for forces of velocities, and other groups of forces than have steps."""
        refuse_dissipation(system, "place in this scheme; use friction")
        group_names(system.force, self.names)

    def program(self, system: System | None) -> Program:
        found: Program = self._programs[system is not None and system.great_circles is not None]
        return found

    def depends_on(self, system: System, state: State) -> Any:
        # Where slow forces kick in the middle, each step begins with an evaluation of the others.
        return None if self.middle else (self.thermal_energy, self.friction, self.seed)

    def refuse_back(self, system: System, dt: float) -> None:
        """Raise `InputError` for a negative time step."""
        if dt < 0:
            raise InputError(f"the time step is {system.shown_time(dt)}; noise cannot be taken back", item="dt")

    def drawn(self, number: int, shape: tuple[int, ...], part: int = 0) -> FloatArray:
        """Normal numbers that are a function of the seed, of the number of the step, and of its part."""
        return noise_generator((self.seed, 0), number, part).standard_normal(shape)

    def groups(self, system: System, state: State) -> GroupedForces:
        """Forces at a state that steps begin with; those of groups are remembered, not to be evaluated anew."""
        found = GroupedForces(system, state, self.names, self.middle, self._left)
        self._left = (None, found) if len(self.names) > 1 else None
        return found

    def note(self, state: State) -> None:
        if self._left is not None:
            self._left = state.positions, self._left[1]


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

    def __repr__(self) -> str:
        return f"Langevin({self.thermal_energy!r}, {self.friction!r}, rng={self.seed}, substeps={self.substeps})"

    def _made(self, operations: tuple[Operation, ...]) -> Program:
        """An exchange is between projections, and its heat is measured."""
        parts: list[Operation] = []
        for operation in operations:
            exchange = isinstance(operation, Exchange)
            parts += [Project(), operation, Project(), _Measure()] if exchange else [operation]
        return Program(operations, {"exchange": _exchange, "measure": _measure}, self.names, parts)

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        self.refuse_back(system, dt)
        return LangevinStep(system, state, dt, self, 1 if self.middle else steps)

    def conserved_energy(self, system: System, state: State) -> float:
        """Total energy less the heat that has flowed in."""
        return system.total_energy(state) - (0.0 if state.thermostat is None else float(state.thermostat[0]))


class LangevinRespa(Langevin):
    """Langevin dynamics on constraints with several time steps: kicks of slow forces about steps of fast ones.

    Each group of forces kicks at the ends of its own step, and the fastest one moves the atoms by geodesic BAOAB, with
    friction and noise in the middle of each of its steps. Slow forces in steps of half a period of the fastest motion,
    or of its multiples, drive it (resonance), by the share of its stiffness that they have (`slow_share`): with bonds
    to hydrogen or whole molecules held and near pairs as fast forces, 8 to 16 fs are safe. `IsokineticSpheres` takes
    longer steps.

    Parameters
    ----------
    thermal_energy : float
        k_B T in the units of energy in use.
    friction : float
        gamma, in inverse units of time; 0 for constant energy.
    rng : int, numpy.random.Generator or None
        As for `Langevin`.
    steps : mapping of str to int, optional
        Steps of each group of forces in one step, ``{"slow": 1, "medium": 4, "fast": 12}``; each divides the next. The
        System has the forces, as `ForceGroups`. Without it all forces are one group.
    substeps : int
        RATTLE substeps in each drift.
    slow_kicks : {'ends', 'middle'}
        Where the slowest forces kick: half at each end of the step, or once in its middle. States halfway between two
        slow kicks are nearer to the canonical distribution than those at the kicks; they know no slow forces, so that
        each energy that is read costs an evaluation, and the other groups are evaluated once more a step.

    Raises
    ------
    InputError
        As for `Langevin`; numbers of steps that do not divide each other.

    Notes
    -----
    `State.thermostat` holds the heat, as for `Langevin`.

    References
    ----------
    Tuckerman, Berne and Martyna, J. Chem. Phys. 97, 1990 (1992); Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138
    (2016).
    """

    def __init__(
        self,
        thermal_energy: float,
        friction: float,
        rng: Rng,
        *,
        steps: Mapping[str, int] | None = None,
        substeps: int = 3,
        slow_kicks: SlowKicks = "ends",
    ) -> None:
        SeededBath.__init__(self, thermal_energy, friction, rng, substeps, steps, slow_kicks)

    def __repr__(self) -> str:
        return f"LangevinRespa({self.thermal_energy!r}, {self.friction!r}, rng={self.seed}{''.join(self._words)})"


class _Measure(Operation):
    """The heat that has come in since."""

    verb, meaning = "measure", "count the heat that came in"


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
    numbers[WARM] = 0.5 * square_sum(u, numbers[MASSES : MASSES + n])
    for i in range(n):
        u[i] = keep * u[i] + noise[i]


@njit(cache=True, nogil=True)
def _measure(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    before = numbers[WARM]
    numbers[WARM] = 0.5 * square_sum(flat(v), numbers[MASSES : MASSES + v.size])
    numbers[HEAT] += numbers[WARM] - before
    return 0


class GroupedSteps(Interpreter):
    """Steps on their way with forces in groups; `simple` steps have one, of the System's function."""

    def __init__(
        self,
        system: System,
        start: State,
        dt: float,
        groups: GroupedForces,
        program: Program,
        steps: int,
        numbers: FloatArray,
        simple: bool = True,
    ) -> None:
        self.groups, self.simple = groups, simple and groups.names == ("",)
        super().__init__(system, start, dt, program, steps, numbers)
        self.forces = groups.stacked()

    def evaluate(self, row: Row, begun: bool) -> None:
        if self.groups.names == ("",):
            return super().evaluate(row, begun)
        assert isinstance(row.operation, Evaluate)
        self.show(row)
        self.groups.evaluate(row.operation.group, self.whole(self.x), self.at(row.end), self.number)
        self.forces = self.groups.stacked()

    def applied(self, here: int) -> FloatArray | None:
        return super().applied(here) if self.groups.names == ("",) else self.groups.total()


class LangevinStep(GroupedSteps):
    """Steps on their way."""

    def __init__(self, system: System, start: State, dt: float, thermostat: Langevin, steps: int) -> None:
        heat = float(start.thermostat[HEAT]) if carried(start, 1, type(thermostat).__name__) else 0.0  # type: ignore[index]
        groups = thermostat.groups(system, start)
        program, masses = thermostat.program(system), system.moving_masses
        aside, seed = system.motion.plan.driven, divmod(thermostat.seed, 2**32)
        parts = sum(row.name == "exchange" for row in program.rows)
        head = heat, 0.0, thermostat.friction, thermostat.thermal_energy, aside, *seed, start.step + 1, 0, parts
        numbers = np.concatenate((head, masses, system.root_weights.ravel(), masses))
        super().__init__(system, start, dt, groups, program, steps, numbers)
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
