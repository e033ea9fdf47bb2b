"""Langevin dynamics on constraints: the geodesic BAOAB scheme."""

from __future__ import annotations

import math

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.steppers.stages.compensated_steps import Point
from kcons.steppers.state import check_finite
from kcons.steppers.stepper import explained, stays
from kcons.thermostats.freedom import carried, drift_velocity, open_directions, positive, refuse_friction


class Langevin:
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

    order = 2
    reversible = False
    symplectic = False
    force_evaluations = 1

    def __init__(
        self,
        thermal_energy: float,
        friction: float,
        seed: int,
        *,
        substeps: int = 3,
        conserve_momentum: bool = False,
    ) -> None:
        self.thermal_energy = positive(thermal_energy, "thermal_energy")
        if np.ndim(friction) or not (math.isfinite(friction) and friction >= 0):
            raise InputError(f"friction is {friction}; give one number >= 0", item="friction")
        if int(substeps) != substeps or substeps < 1:
            raise InputError(f"substeps is {substeps}; give a whole number, 1 or more", item="substeps")
        if int(seed) != seed or not 0 <= seed < 2**64:
            raise InputError(f"seed is {seed}; give a whole number from 0 to 2^64 - 1", item="seed")
        self.friction = float(friction)
        self.seed = int(seed)
        self.substeps = int(substeps)
        self.conserve_momentum = bool(conserve_momentum)
        self._bits = np.random.Philox(0)
        self._normal = np.random.Generator(self._bits)
        self._open: tuple[System, FloatArray] | None = None

    def __repr__(self) -> str:
        return f"Langevin({self.thermal_energy!r}, {self.friction!r}, seed={self.seed}, substeps={self.substeps})"

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
            raise InputError(f"the time step is {dt}; noise cannot be taken back", item="dt")
        carried(state, 1, "Langevin")
        start = system.with_forces(state)
        number = state.step + 1
        time, time_remainder = state.later(dt)
        middle = state.time + (0.5 * dt + state.time_remainder)
        motion = system.motion
        shift = None
        x, v, f = system.taken(start)
        if start.remainder is not None:
            shift = x[system.anchor]
            x = (x - shift) + start.remainder
        with np.errstate(over="ignore", invalid="ignore"):  # checked, with the step's number
            try:
                assert f is not None
                v = v + (0.5 * dt) * (f * system.inverse_masses)
                x, v = self._fly(system, x, v, state.time, middle, 0.5 * dt)
                v, heat = self._exchange(system, x, v, middle, dt, number)
                x, v = self._fly(system, x, v, middle, time, 0.5 * dt)
                check_finite(x, "position", number)
                positions = x if shift is None else x + shift
                forces = system.forces(positions, v, time, number)
                v += (0.5 * dt) * (forces * system.inverse_masses)
                check_finite(v, "velocity", number)
                motion.project_velocities(x, v, time=time, out=v)
            except ConvergenceError as error:
                raise explained(error, system, state, dt, number) from error
        before = 0.0 if state.thermostat is None else float(state.thermostat[0])
        remainder = None if shift is None else x - (positions - shift)
        return State(positions, v, time, forces, number, remainder, time_remainder, np.array([before + heat]))

    def _fly(
        self, system: System, x: FloatArray, v: FloatArray, start: float, end: float, h: float
    ) -> tuple[FloatArray, FloatArray]:
        circles = system.great_circles
        flight, count = (system.drift, self.substeps) if circles is None else (circles, 1)
        point = Point(x, v, system.weights, exact=count > 1 or circles is not None)
        now = start
        for k in range(1, count + 1):
            then, now = now, end if k == count else start + k * (end - start) / count
            flight.move(point, np.empty_like(x), then, now, h / count)
        point.land()
        return point.x, point.v

    def _exchange(
        self, system: System, x: FloatArray, v: FloatArray, time: float, dt: float, number: int
    ) -> tuple[FloatArray, float]:
        """Friction and noise in the tangent plane at x, and the heat they bring."""
        motion = system.motion
        v = motion.project_velocities(x, v, time=time, out=v)
        before = system.kinetic_energy(v)
        keep = math.exp(-self.friction * dt)
        spread = math.sqrt(-math.expm1(-2 * self.friction * dt) * self.thermal_energy)
        noise = self._drawn(number, v.shape)
        noise *= spread * np.sqrt(system.inverse_masses)
        # What friction does not act on: velocities that the targets demand, and of the centre of mass.
        kept = motion.project_velocities(x, np.zeros_like(v), time=time) if motion.plan.driven else None
        if self.conserve_momentum:
            directions = self._directions(system, x, time)
            noise -= drift_velocity(noise, system.masses, directions)
            drift = drift_velocity(v if kept is None else v - kept, system.masses, directions)
            kept = np.broadcast_to(drift, v.shape) if kept is None else kept + drift
        noise += keep * v if kept is None else kept + keep * (v - kept)
        after = motion.project_velocities(x, noise, time=time, out=noise)
        return after, system.kinetic_energy(after) - before

    def _drawn(self, number: int, shape: tuple[int, ...]) -> FloatArray:
        """Normal numbers that are a function of the seed and of the number of the step."""
        # A counter-based generator, set to the step's own stretch of the seed's stream.
        bits = self._bits
        bits.state = {
            "bit_generator": "Philox",
            "state": {
                "counter": np.array([0, 0, number, 0], dtype=np.uint64),
                "key": np.array([self.seed, 0], dtype=np.uint64),
            },
            "buffer": np.zeros(4, dtype=np.uint64),
            "buffer_pos": 4,
            "has_uint32": 0,
            "uinteger": 0,
        }
        return self._normal.standard_normal(shape)

    def _directions(self, system: System, x: FloatArray, time: float) -> FloatArray:
        if self._open is None or self._open[0] is not system:
            self._open = (system, open_directions(system.motion, x, time))
        return self._open[1]

    def conserved_energy(self, system: System, state: State) -> float:
        """Total energy less the heat that has flowed in."""
        return system.total_energy(state) - (0.0 if state.thermostat is None else float(state.thermostat[0]))
