"""One step of the isokinetic thermostat, and the atoms that it acts on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import lent
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.steppers import State, System
from kcons.steppers.executors.frame import Frame
from kcons.steppers.executors.piecewise import ArrayStep
from kcons.steppers.operations import Fly, Operation, Project, Turn
from kcons.steppers.stages.compensated_steps import Point, check_finite
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
#: Operations of a step with one drift.
FEWEST = 5
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
        pace = paced(system, Frame(system, state, 0.0).x, state.forces, state.time)
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
def isokinetic_step(system: System, share: Share, start: State, dt: float, operations: Sequence[Operation]) -> State:
    """A step: in two compiled calls where that is possible and it has one flight, else an operation at a time."""
    if share.stages is not None and len(operations) == FEWEST:
        after = _compiled(system, share, share.stages, start, dt, operations)
        if after is not None:
            return after
    return IsokineticStep(system, share, start, dt).through(operations)


def _compiled(
    system: System, share: Share, stages: IsokineticStages, start: State, dt: float, operations: Sequence[Operation]
) -> State | None:
    """A step of order 2 in two compiled calls; None, with nothing done, where the first of them cannot do its half."""
    force = system.force
    assert force is not None and start.thermostat is not None
    frame = Frame(system, start, dt)
    f, number, tables = frame.forces, frame.number, stages.tables()
    assert f is not None
    twice, integral, square, count = start.thermostat.tolist()
    turn, flight, _, _, last = operations
    status, there, speed, first_growth = stages.before(
        frame.x, frame.v, f, square, twice, turn.fraction * dt, flight.fraction * dt, tables
    )
    if status == POSITION:
        check_finite(there, "position", number)
    if status != DONE:
        return None
    f = system.accepted(force(lent(frame.whole(there)), frame.time), number, True)
    status, after, _, square, _, growth = stages.after(there, speed, f, twice, last.fraction * dt, tables)
    if status != DONE:
        rest = IsokineticStep(system, share, start, dt)
        rest.x, rest.v, rest.forces, rest.now, rest.integral = there, speed, f, frame.time, integral + first_growth
        return rest.through(operations[3:])
    return frame.closed(there, after, f, np.array([twice, integral + first_growth + growth, square, count]))


class IsokineticStep(ArrayStep):
    """A step on its way; velocities are drive + v, the drive None where targets rest."""

    def __init__(self, system: System, share: Share, start: State, dt: float) -> None:
        super().__init__(system, start, dt)
        assert start.thermostat is not None
        self.share = share
        self.stages = share.stages if system.force is not None else None
        self.tables = np.empty(0) if self.stages is None else self.stages.tables()
        self.twice, self.integral, self.push_square, self.count = start.thermostat.tolist()
        self.drive: FloatArray | None = None
        #: How long v must be, squared.
        self.left = self.twice
        #: Whether v has to be projected before it turns.
        self.askew = False
        if system.motion.plan.driven:
            drive, self.v = split(system, self.x, self.v, self.now)
            assert drive is not None
            self.drive, self.left = drive, left_for(self.twice, share.square(drive), self.number)

    # -- verbs ----------------------------------------------------------------------------------

    def turn(self, operation: Turn) -> None:
        """The kick: from velocities on the constraints, or projected in the same call."""
        t = operation.fraction * self.dt
        if not self.askew:
            self._turn_before_drift(t)
            return
        self.askew = False
        if self.stages is None or not self._project_and_turn(self.stages, t):
            if self.drive is None:
                self.v = self.system.motion.project_velocities(self.x, self.v, time=self.now, out=self.v)
            self._turn_after_drift(t)
            check_finite(self.v, "velocity", self.number)

    def fly(self, operation: Fly) -> None:
        if self.drive is None:
            super().fly(operation)
            check_finite(self.x, "position", self.number)
            return
        for h, end in self.pieces(operation):
            self._driven_flight(h, end)

    def evaluate(self, operation: Operation) -> None:
        if self.system.force is not None:
            # Compiled projections look for NaN.
            self.forces = self.system.forces(
                self.frame.whole(self.x), self.v, self.now, self.number, finite=self.stages is None
            )

    def project(self, operation: Project) -> None:
        """Left to the turn that follows."""
        self.askew = True

    def end(self) -> State:
        v = self.v if self.drive is None else self.drive + self.v
        thermostat = np.array([self.twice, self.integral, self.push_square, self.count])
        return self.frame.closed(self.x, v, self.forces, thermostat)

    # -- turns ----------------------------------------------------------------------------------

    def _turn_before_drift(self, t: float) -> None:
        """With forces as they are: the drift takes out what they would do across the constraints."""
        system, share = self.system, self.share
        if system.force is None:
            return
        assert self.forces is not None
        u = np.empty_like(self.v)
        log_growth, done = closed_form.before_drift(
            self.v, self.forces, system.weights, share.masses, self.push_square, self.left, t, MANY, u
        )
        if not done:
            self._turn_after_drift(t)
            return
        if share.others is not None:
            u = np.where(share.others, self.v + t * system.weights * self.forces, u)
        self.v = u
        self.integral += log_growth

    def _turn_after_drift(self, t: float) -> None:
        """Bring v, projected, to its length, and follow the closed form."""
        system, share = self.system, self.share
        if system.force is None:
            factor = math.sqrt(self.left / share.square(self.v))
            self.v = self._times(factor, self.v)
            self.integral -= math.log(factor)
            return
        assert self.forces is not None
        pace = _paced(system, self.x, self.forces, self.now)
        u = np.empty_like(pace)
        self.push_square, factor, log_growth, done = closed_form.after_drift(
            self.v, pace, share.masses, self.left, t, u
        )
        self.integral += log_growth
        if not done:
            self._turn_against(pace, factor, t)
            return
        if share.others is not None:
            u = np.where(share.others, self.v + t * pace, u)
        self.v = u

    def _turn_against(self, pace: FloatArray, factor: float, t: float) -> None:
        """Where the force is strong and v runs against it."""
        share = self.share
        u, growth = closed_form.turned(factor * self.v, pace, share.masses, self.left, t)
        if share.others is not None:
            u = np.where(share.others, self.v + t * pace, u)
        self.v = u
        self.integral += growth

    def _project_and_turn(self, stages: IsokineticStages, t: float) -> bool:
        """A projection and the turn after it in one call; whether it was done."""
        assert self.forces is not None
        status, u, pace, square, factor, log_growth = stages.after(
            self.x, self.v, self.forces, self.left, t, self.tables
        )
        if status == ENGINE:
            return False
        if status in _WHAT:
            check_finite({FORCE: self.forces, POSITION: self.x, VELOCITY: u}[status], _WHAT[status], self.number)
        self.push_square = square
        self.integral += log_growth
        if status == KICK:
            self._turn_against(pace, factor, t)
            check_finite(self.v, "velocity", self.number)
        else:
            self.v = u
        return True

    # -- moving targets ------------------------------------------------------------------------

    def _driven_flight(self, h: float, now: float) -> None:
        """Moving targets do work: u is scaled by one factor before and after the flight, that which keeps K.

        So it is symmetric, of order 2 (Hairer, BIT 40, 726 (2000)).
        """
        system, share = self.system, self.share
        assert self.drive is not None
        then = self.now
        log_factor, last = 0.0, math.inf
        for _ in range(_MAX_ITERATIONS):
            point = Point(self.x, self.drive + self._times(math.exp(log_factor), self.v), system.weights, exact=False)
            system.drift.move(point, np.empty_like(self.x), then, now, h)
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
        self.x, self.now, self.drive, self.v, self.left = point.x, now, drive, u, left
        self.integral -= 2 * log_factor

    def _times(self, factor: float, u: FloatArray) -> FloatArray:
        return u * factor if self.share.others is None else np.where(self.share.others, u, u * factor)
