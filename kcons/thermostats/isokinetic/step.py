"""One step of the isokinetic thermostat, and the atoms that it acts on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import lent
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.steppers import State, System
from kcons.steppers.splitting import Stage
from kcons.steppers.stages.compensated_steps import Point
from kcons.steppers.state import check_finite
from kcons.thermostats.freedom import atom_numbers
from kcons.thermostats.isokinetic import kick as closed_form
from kcons.thermostats.isokinetic.fused_step import (
    DONE,
    ENGINE,
    FORCE,
    KICK,
    MANY,
    POSITION,
    VELOCITY,
    IsokineticStages,
)

#: Kinetic energy below which v.f/2K may overflow.
SMALLEST = 1e-290
_MAX_ITERATIONS = 50
_WHAT = {FORCE: "force", POSITION: "position", VELOCITY: "velocity"}


def split(system: System, x: FloatArray, v: FloatArray, time: float) -> tuple[FloatArray | None, FloatArray]:
    """v, projected, as the slowest velocities that the targets demand (None where they rest) and the rest."""
    motion = system.motion
    whole = motion.project_velocities(x, v, time=time)
    if not motion.plan.driven:
        return None, whole
    drive = motion.project_velocities(x, np.zeros_like(v), time=time)
    return drive, whole - drive


def left_for(twice: float, driven: float, step: int) -> float:
    """What moving targets leave of 2K."""
    left = twice - driven
    if not left > SMALLEST:
        raise InputError(
            f"moving targets alone have more kinetic energy than the thermostat allows at step {step}: raise the "
            "temperature, or move them slower",
            item="kinetic_energy",
        )
    return left


class Share:
    """The thermostatted atoms."""

    def __init__(self, system: System, atoms: ArrayLike | None) -> None:
        inside = system.inverse_masses[:, 0] > 0
        if atoms is not None:
            chosen = np.zeros(system.n_atoms, dtype=bool)
            chosen[atom_numbers(atoms, system.n_atoms)] = True
            inside = inside & chosen
        self.n_moving = int(inside.sum())
        #: Masses of the thermostatted atoms for each coordinate; 0 for the others.
        self.masses: FloatArray = np.repeat(np.where(inside, system.masses, 0.0)[:, None], 3, axis=1)
        #: Coordinates of other atoms that move, None if there are none.
        others = (self.masses == 0) & (system.weights > 0)
        self.others = others if others.any() else None
        #: Halves of a step in one call each, None where the engine and the closed form are called one by one.
        self.stages = IsokineticStages.of(system, self.masses, self.others is not None)

    def square(self, v: FloatArray) -> float:
        """v^T M v."""
        return float(closed_form.square_sum(v, self.masses))

    def scaled(self, v: FloatArray, square: float) -> FloatArray:
        """v with the length that v^T M v = `square` demands, other atoms as they are."""
        has = self.square(v)
        factor = math.sqrt(square / has) if has > 0 else math.nan
        return np.where(self.masses > 0, v * factor, v)

    def push_square(self, system: System, state: State) -> float:
        """f . M_par^+ f at the state."""
        assert state.forces is not None
        x = state.positions
        if state.remainder is not None:
            x = (x - x[system.anchor]) + state.remainder
        pace = paced(system, x, state.forces, state.time)
        return float(closed_form.square_sum(pace, self.masses))


def paced(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    """M_par^+ f."""
    with np.errstate(over="ignore"):  # velocities are checked
        return _paced(system, x, forces, time)


def _paced(system: System, x: FloatArray, forces: FloatArray, time: float) -> FloatArray:
    motion = system.motion
    if motion.plan.driven:
        return np.asarray(motion.project_forces(x, forces, time=time) * system.inverse_masses)
    pace = forces * system.weights
    return motion.project_velocities(x, pace, time=time, out=pace) if motion.rank else pace


# As a decorator this costs half of a `with`. What overflows is looked for, and named with the step's number.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def compiled_step(
    system: System, share: Share, start: State, dt: float, kicks: tuple[float, ...], stage: Stage
) -> State | None:
    """A step of order 2 in two compiled calls; None, with nothing done, where the first of them cannot do its half."""
    stages, force = share.stages, system.force
    assert stages is not None and force is not None and start.forces is not None and start.thermostat is not None
    x, u, f = system.taken(start)
    assert f is not None
    shift: FloatArray | None = None
    if start.remainder is not None:
        shift = x[system.anchor]
        x = (x - shift) + start.remainder
    twice, integral, square, count = start.thermostat.tolist()
    time, time_remainder = start.later(dt)
    number, tables = start.step + 1, stages.tables()
    status, there, speed, first_growth = stages.before(
        x, u, f, square, twice, kicks[0] * dt, stage.fractions[0] * dt, tables
    )
    if status == POSITION:
        check_finite(there, "position", number)
    if status != DONE:
        return None
    f = system.accepted(force(lent(there if shift is None else there + shift), time), number, True)
    status, after, _, square, _, growth = stages.after(there, speed, f, twice, kicks[1] * dt, tables)
    if status != DONE:
        run = IsokineticStep(system, share, start, dt)
        run.x, run.u, run.forces, run.now, run.integral = there, speed, f, time, integral + first_growth
        run.last_kick(kicks[1] * dt)
        return run.ended()
    positions, remainder = there, None
    if shift is not None:
        positions = there + shift
        remainder = there - (positions - shift)
    thermostat = np.array([twice, integral + first_growth + growth, square, count])
    return State(positions, after, time, f, number, remainder, time_remainder, thermostat)


class IsokineticStep:
    """The arrays of one step on its way: velocities v = drive + u, the drive None where targets rest."""

    def __init__(self, system: System, share: Share, start: State, dt: float) -> None:
        self.system, self.share, self.dt = system, share, dt
        self.stages = share.stages if system.force is not None else None
        self.tables: tuple[Any, ...] = () if self.stages is None else self.stages.tables()
        self.begin = start
        self.number = start.step + 1
        self.time, self.time_remainder = start.later(dt)
        self.now = start.time
        self.shift = None
        x, self.u, forces = system.taken(start)
        assert start.thermostat is not None and forces is not None
        self.forces: FloatArray = forces
        if start.remainder is not None:
            self.shift = x[system.anchor]
            x = (x - self.shift) + start.remainder
        self.twice, self.integral, self.push_square, self.count = start.thermostat.tolist()
        self.x = x
        self.drive: FloatArray | None = None
        self.left = self.twice
        if system.motion.plan.driven:
            self.drive, self.u = split(system, x, self.u, self.now)
            self._settle()

    def through(self, kicks: tuple[float, ...], stages: list[Stage]) -> State:
        self.first_kick(kicks[0] * self.dt)
        for fraction, stage in zip(kicks[1:], stages, strict=True):
            if self.drive is None:
                self.drift(stage)
            else:
                for piece in zip(stage.fractions, stage.ends, strict=True):
                    self.driven_drift(piece)
            if self.system.force is not None:
                self.forces = self.system.forces(
                    self.positions, self.velocities, self.now, self.number, finite=self.stages is None
                )
            self.last_kick(fraction * self.dt)
        return self.ended()

    def last_kick(self, t: float) -> None:
        """Velocities projected, and a kick that leaves them on the constraints."""
        if self.stages is None or not self._project_and_kick(self.stages, t):
            self.project()
            self.kick(t)
            check_finite(self.u, "velocity", self.number)

    def ended(self) -> State:
        v = self.velocities
        positions, remainder = self.positions, None
        if self.shift is not None:
            remainder = self.x - (positions - self.shift)
        thermostat = np.array([self.twice, self.integral, self.push_square, self.count])
        return State(positions, v, self.time, self.forces, self.number, remainder, self.time_remainder, thermostat)

    @property
    def positions(self) -> FloatArray:
        return self.x if self.shift is None else self.x + self.shift

    @property
    def velocities(self) -> FloatArray:
        return self.u if self.drive is None else self.drive + self.u

    def _settle(self) -> None:
        """How long u must be."""
        assert self.drive is not None
        self.left = left_for(self.twice, self.share.square(self.drive), self.number)

    # -- kicks ----------------------------------------------------------------------------------

    def first_kick(self, t: float) -> None:
        """The kick before the first drift, which takes out what the forces would do across the constraints."""
        system, share = self.system, self.share
        if system.force is None:
            return
        u = np.empty_like(self.u)
        log_growth, done = closed_form.before_drift(
            self.u, self.forces, system.weights, share.masses, self.push_square, self.left, t, MANY, u
        )
        if not done:
            self.kick(t)
            return
        if share.others is not None:
            u = np.where(share.others, self.u + t * system.weights * self.forces, u)
        self.u = u
        self.integral += log_growth

    def kick(self, t: float) -> None:
        """Bring u, projected, to its length, and follow the closed form."""
        system, share = self.system, self.share
        if system.force is None:
            factor = math.sqrt(self.left / share.square(self.u))
            self.u = self.u * factor if share.others is None else np.where(share.others, self.u, self.u * factor)
            self.integral -= math.log(factor)
            return
        pace = _paced(system, self.x, self.forces, self.now)
        u = np.empty_like(pace)
        self.push_square, factor, log_growth, done = closed_form.after_drift(
            self.u, pace, share.masses, self.left, t, u
        )
        self.integral += log_growth
        if not done:
            self._turn(pace, factor, t)
            return
        if share.others is not None:
            u = np.where(share.others, self.u + t * pace, u)
        self.u = u

    def _turn(self, pace: FloatArray, factor: float, t: float) -> None:
        share = self.share
        u, growth = closed_form.turned(factor * self.u, pace, share.masses, self.left, t)
        if share.others is not None:
            u = np.where(share.others, self.u + t * pace, u)
        self.u = u
        self.integral += growth

    # -- drifts ---------------------------------------------------------------------------------

    def drift(self, stage: Stage) -> None:
        system = self.system
        point = Point(self.x, self.u, system.weights, exact=len(stage.ends) > 1)
        for fraction, end in zip(stage.fractions, stage.ends, strict=True):
            then, self.now = self.now, self._time_at(end)
            system.drift.move(point, np.empty_like(self.x), then, self.now, fraction * self.dt)
        point.land()
        check_finite(point.x, "position", self.number)
        self.x, self.u = point.x, point.v

    def project(self) -> None:
        """Bring u onto the constraints after `drift`; where targets move it is there."""
        if self.drive is None:
            self.u = self.system.motion.project_velocities(self.x, self.u, time=self.now, out=self.u)

    # -- both, in one call ----------------------------------------------------------------------

    def _project_and_kick(self, stages: IsokineticStages, t: float) -> bool:
        """What `project` and `kick` do; whether it was done."""
        assert self.forces is not None
        status, u, pace, square, factor, log_growth = stages.after(
            self.x, self.u, self.forces, self.left, t, self.tables
        )
        if status == ENGINE:
            return False
        if status in _WHAT:
            check_finite({FORCE: self.forces, POSITION: self.x, VELOCITY: u}[status], _WHAT[status], self.number)
        self.push_square = square
        self.integral += log_growth
        if status == KICK:
            self._turn(pace, factor, t)
            check_finite(self.u, "velocity", self.number)
        else:
            self.u = u
        return True

    def driven_drift(self, piece: tuple[float, float]) -> None:
        """Moving targets do work: u is scaled by one factor before and after the flight, that which keeps K.

        So it is symmetric, of order 2 (Hairer, BIT 40, 726 (2000)).
        """
        system, share = self.system, self.share
        assert self.drive is not None
        fraction, end = piece
        then, now = self.now, self._time_at(end)
        log_factor, last = 0.0, math.inf
        for _ in range(_MAX_ITERATIONS):
            point = Point(self.x, self.drive + self._times(math.exp(log_factor), self.u), system.weights, exact=False)
            system.drift.move(point, np.empty_like(self.x), then, now, fraction * self.dt)
            check_finite(point.x, "position", self.number)
            drive, u = split(system, point.x, point.v, now)
            assert drive is not None
            left = left_for(self.twice, share.square(drive), self.number)
            u = self._times(math.exp(log_factor), u)
            miss = 0.5 * math.log(left / share.square(u))
            if abs(miss) <= 1e-15 or (abs(miss) < 1e-12 and abs(miss) >= last):
                break
            last = abs(miss)
            log_factor += 0.5 * miss
        else:
            raise ConvergenceError(
                "kinetic energy and moving targets cannot be kept together; time step too large",
                residual=last,
                tolerance=1e-12,
                iterations=_MAX_ITERATIONS,
            )
        self.x, self.now, self.drive, self.u, self.left = point.x, now, drive, u, left
        self.integral -= 2 * log_factor

    def _times(self, factor: float, u: FloatArray) -> FloatArray:
        return u * factor if self.share.others is None else np.where(self.share.others, u, u * factor)

    def _time_at(self, end: float) -> float:
        start = self.begin
        return self.time if end == 1.0 else start.time + (end * self.dt + start.time_remainder)
