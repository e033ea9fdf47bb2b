"""Langevin dynamics on constraints: the geodesic BAOAB scheme."""

from __future__ import annotations

import math
import threading

import numpy as np

from kcons.constraints.arguments import finite_number, positive, seed_number, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.executors.piecewise import ArrayStep
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Operation, Project, drifts_of
from kcons.steppers.stages.compensated_steps import check_finite
from kcons.steppers.stepper import Listed, stays
from kcons.thermostats.freedom import carried, drift_velocity, open_directions, refuse_friction


class _Generator(threading.local):
    """A counter-based generator for each thread."""

    def __init__(self) -> None:
        self.bits = np.random.Philox(0)
        self.numbers = np.random.Generator(self.bits)


_GENERATOR = _Generator()


def wound(key: tuple[int, int], number: int, part: int = 0) -> np.random.Generator:
    """The generator of this thread at the stretch of the key's stream that belongs to a part of a step."""
    _GENERATOR.bits.state = {
        "bit_generator": "Philox",
        "state": {
            "counter": np.array([0, 0, number, part], dtype=np.uint64),
            "key": np.array(key, dtype=np.uint64),
        },
        "buffer": np.zeros(4, dtype=np.uint64),
        "buffer_pos": 4,
        "has_uint32": 0,
        "uinteger": 0,
    }
    return _GENERATOR.numbers


class SeededBath(Listed):
    """What baths share whose noise is a function of a seed and of the number of the step.

    Attributes
    ----------
    thermal_energy, friction : float
    seed, substeps : int
        See `Langevin`.
    exchanged : (int, float) or None
        Number of the last step that was made, and its kinetic energy after noise in its middle, for logs: there
        velocities are as warm as the bath, at the ends of steps those of stiff motions are colder. None without noise.
    """

    exchanged: tuple[int, float] | None = None

    order = 2
    reversible = False
    symplectic = False
    force_evaluations = 1

    def __init__(self, thermal_energy: float, friction: float, seed: int, substeps: int) -> None:
        self.thermal_energy = positive(thermal_energy, "thermal_energy")
        self.friction = finite_number(friction, "friction")
        if self.friction < 0:
            raise InputError(f"friction is {friction}; give one number >= 0", item="friction")
        self.seed = seed_number(seed)
        self.substeps = whole_number(substeps, "substeps")

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` for velocity-dependent forces, and friction besides that of the thermostat."""
        refuse_friction(system)
        if system.velocity_dependent:
            raise UnsupportedError("forces that depend on the velocities have no place in this scheme; use friction")

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        InputError
            A negative time step: noise cannot be taken back. The state carries variables of another thermostat.
        UnsupportedError
            Momentum is to be conserved where rows hold atoms in space.
        ConvergenceError, NonFiniteError, InputError, UnsupportedError
            As for all splittings.
        """
        self.check(system)
        still = stays(state, dt)
        if still is not None:
            return still
        if dt < 0:
            raise InputError(f"the time step is {system.shown_time(dt)}; noise cannot be taken back", item="dt")
        with np.errstate(over="ignore", invalid="ignore"):  # checked, with the step's number
            return self.begun(system, state, dt).through(self.operations(system))

    def begun(self, system: System, state: State, dt: float) -> ArrayStep:
        """A step that is about to be made from the state.

        Raises
        ------
        InputError
            The state carries variables of another thermostat.
        """
        raise NotImplementedError

    def drawn(self, number: int, shape: tuple[int, ...], part: int = 0) -> FloatArray:
        """Normal numbers that are a function of the seed, of the number of the step, and of its part."""
        return wound((self.seed, 0), number, part).standard_normal(shape)


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
    seed : int
    substeps : int
        RATTLE substeps in each of the two drifts.
    conserve_momentum : bool
        Friction and noise act relative to the centre of mass, in the directions in which no row knows a place in
        space; so many degrees of freedom less take part.

    Raises
    ------
    InputError
        Temperature not positive, friction negative, substeps below 1.

    Notes
    -----
    `State.thermostat` holds the heat that has flowed in: total energy less it is conserved (`conserved_energy`) to the
    order of the scheme.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    def __init__(
        self,
        thermal_energy: float,
        friction: float,
        seed: int,
        *,
        substeps: int = 3,
        conserve_momentum: bool = False,
    ) -> None:
        super().__init__(thermal_energy, friction, seed, substeps)
        self.conserve_momentum = bool(conserve_momentum)
        self._substeps = _geodesic_baoab((1.0 / self.substeps,) * self.substeps)
        self._great_circles = _geodesic_baoab((1.0,), exact=True)
        self._open: tuple[System, FloatArray] | None = None

    def __repr__(self) -> str:
        return f"Langevin({self.thermal_energy!r}, {self.friction!r}, seed={self.seed}, substeps={self.substeps})"

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        exact = system is not None and system.great_circles is not None
        return self._great_circles if exact else self._substeps

    def begun(self, system: System, state: State, dt: float) -> ArrayStep:
        carried(state, 1, "Langevin")
        return LangevinStep(system, system.with_forces(state), dt, self)

    def directions(self, system: System, x: FloatArray, time: float) -> FloatArray:
        """Those in which no row knows a place in space."""
        known = self._open
        if known is None or known[0] is not system:
            known = self._open = (system, open_directions(system.motion, x, time))
        return known[1]

    def conserved_energy(self, system: System, state: State) -> float:
        """Total energy less the heat that has flowed in."""
        return system.total_energy(state) - (0.0 if state.thermostat is None else float(state.thermostat[0]))


def _geodesic_baoab(flight: tuple[float, ...], *, exact: bool = False) -> tuple[Operation, ...]:
    first, second = drifts_of((0.5, 0.5), flight, exact=exact)
    return Kick(0.5), first, Exchange(1.0), second, Evaluate(), Kick(0.5), Project()


class LangevinStep(ArrayStep):
    """A step on its way, velocities on the constraints after each drift."""

    def __init__(self, system: System, start: State, dt: float, thermostat: Langevin) -> None:
        super().__init__(system, start, dt)
        self.thermostat = thermostat
        self.heat = 0.0 if start.thermostat is None else float(start.thermostat[0])

    def kick(self, operation: Kick) -> None:
        assert self.forces is not None
        self.v = self.v + (operation.fraction * self.dt) * (self.forces * self.system.inverse_masses)

    def pieces(self, operation: Fly) -> list[tuple[float, float]]:
        begin, end, count = self.now, self.frame.at(operation.ends[-1]), len(operation.flights)
        h, time = operation.fraction * self.dt / count, end - begin
        return [*((h, begin + k * time / count) for k in range(1, count)), (h, end)]

    def exchange(self, operation: Exchange) -> None:
        """Friction and noise in the tangent plane, and the heat they bring."""
        system, motion, thermostat = self.system, self.system.motion, self.thermostat
        x, time, dt = self.x, self.now, operation.fraction * self.dt
        v = self.along(self.v)
        before = system.kinetic_energy(v)
        keep = math.exp(-thermostat.friction * dt)
        spread = math.sqrt(-math.expm1(-2 * thermostat.friction * dt) * thermostat.thermal_energy)
        noise = self.noise(v.shape)
        noise *= spread * system.root_weights
        # What friction does not act on: velocities that the targets demand, and of the centre of mass.
        kept = motion.project_velocities(x, np.zeros_like(v), time=time) if motion.plan.driven else None
        if thermostat.conserve_momentum:
            directions = thermostat.directions(system, x, time)
            noise -= drift_velocity(noise, system.masses, directions)
            drift = drift_velocity(v if kept is None else v - kept, system.masses, directions)
            kept = np.broadcast_to(drift, v.shape) if kept is None else kept + drift
        noise += keep * v if kept is None else kept + keep * (v - kept)
        self.v = self.along(noise)
        after = system.kinetic_energy(self.v)
        self.heat += after - before
        if thermostat.friction > 0:
            thermostat.exchanged = self.number, after

    def noise(self, shape: tuple[int, ...]) -> FloatArray:
        """Normal numbers for this exchange."""
        return self.thermostat.drawn(self.number, shape)

    def evaluate(self, operation: Operation) -> None:
        check_finite(self.x, "position", self.number)
        super().evaluate(operation)

    def project(self, operation: Operation) -> None:
        check_finite(self.v, "velocity", self.number)
        self.along(self.v)

    def end(self) -> State:
        return self.frame.closed(self.x, self.v, self.forces, np.array([self.heat]))
