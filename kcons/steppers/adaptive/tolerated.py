"""What schemes share that choose their own steps: tolerance, scales, and what is said where there is no step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Protocol

import numpy as np

from kcons.constraints.arguments import finite_number, positive
from kcons.constraints.target import FloatArray
from kcons.errors import (
    ConvergenceError,
    InputError,
    NonFiniteError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.steppers.state import State, System
from kcons.steppers.stepper import retold

#: After a failure, such as no solution at so large a step; most show before any force, or after one.
FAILED = 0.5
EPS = float(np.finfo(float).eps)
#: What an attempt at a step may raise that a shorter one mends.
MENDED = ConvergenceError, NonFiniteError, SingularGeometryError


class Attempts(Protocol):
    """How one run makes its steps.

    Attributes
    ----------
    size : float
        Of the next step, positive.
    error : float
        Estimate for the last attempt, in units of the tolerance.
    """

    @property
    def size(self) -> float: ...
    @property
    def error(self) -> float: ...

    def made(self, start: State, size: float, until: float | None) -> State | None:
        """The state after a step of `size`, which ends at `until` if that is given; None if its error is too large.

        `size` is then shorter, and otherwise for the step after this one.
        """
        ...

    def failed(self, size: float) -> None:
        """The attempt at a step of `size` has raised one of `MENDED`: try a shorter one."""
        ...


class ToTolerance:
    """Base of the schemes whose steps choose their own size.

    Parameters
    ----------
    tolerance : float
    length, speed : float, optional
        As for `Extrapolation`.
    """

    def __init__(self, tolerance: float, length: float, speed: float | None) -> None:
        if finite_number(tolerance, "tolerance") < 1e-14:
            raise InputError(f"tolerance is {tolerance}; give a number of 1e-14 or more", item="tolerance")
        self.tolerance, self.length = float(tolerance), positive(length, "length")
        self.speed = None if speed is None else positive(speed, "speed")

    @property
    def first(self) -> float:
        """Size of the first step, relative to the time in which the start changes."""
        return 0.1

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the scheme may not be used: here, nowhere."""

    def attempts(self, system: System, start: State, size: float, speed: float) -> Attempts:
        """How steps are made from `start` on, the first of `size`; `speed` is what velocities are measured against."""
        raise NotImplementedError

    def states(self, system: System, state: State, until: float, *, first_step: float | None = None) -> Iterator[State]:
        """The states at the ends of the steps, the last one at `until`; none if that is the time of the start.

        Parameters
        ----------
        system : System
        state : State
            Where to start, for example from `System.initial_state`.
        until : float
            Time of the last state; may be earlier than that of the first.
        first_step : float, optional
            Size of the first attempt; by default from velocities and accelerations.

        Yields
        ------
        state : State
            `step` counts the steps that were accepted.

        Raises
        ------
        InputError
            `until` or `first_step` is not finite; the force function returned a wrong shape.
        UnsupportedError
            A thermostat's state; the scheme may not be used with this system.
        ConvergenceError, NonFiniteError, SingularGeometryError
            What a step raised, or an error above the tolerance, at steps too small to be made smaller. The last
            state that came is intact; the first two carry `step`.
        """
        until = finite_number(until, "until")
        first_step = None if first_step is None else positive(first_step, "first_step")
        if state.thermostat is not None:
            raise UnsupportedError(f"{type(self).__name__} knows no thermostats; use a stepper with equal steps")
        self.check(system)
        return self._states(system, state, until, first_step)

    def _states(self, system: System, state: State, until: float, first_step: float | None) -> Iterator[State]:
        if state.time == until:
            return
        state = system.with_forces(state)
        speed, rate = self._speed_and_rate(system, state)
        left = abs(until - state.time)
        first = first_step or (min(self.first / rate, left) if rate > 0 else left)
        attempts = self.attempts(system, state, first, speed)
        while state.time != until:
            state = self._advanced(attempts, state, until)
            yield state.shown()

    @np.errstate(over="ignore", invalid="ignore")
    def _speed_and_rate(self, system: System, state: State) -> tuple[float, float]:
        """What velocities are measured against, and how fast the start changes, in units of its scales."""
        assert state.forces is not None
        v = state.velocities
        speed = rms(v, system)
        forces = system.resisted(state.forces, v)
        a = rms(system.motion.acceleration(state.positions, v, forces, state.time), system)
        scale = self.speed or max(speed, math.sqrt(a * self.length)) or 1.0
        return scale, speed / self.length + a / scale

    @np.errstate(over="ignore", invalid="ignore")
    def _advanced(self, attempts: Attempts, start: State, until: float) -> State:
        """The state after one step."""
        smallest = 16 * float(np.spacing(max(abs(start.time), abs(until))))
        left = (until - start.time) - start.time_remainder
        while True:
            last = attempts.size >= abs(left)
            size = left if last else math.copysign(attempts.size, left)
            if not last and 2 * attempts.size > abs(left):
                size = 0.5 * left  # two equal steps rather than a long and a tiny one
            try:
                state = attempts.made(start, size, until if last else None)
            except MENDED as error:
                if abs(size) <= smallest:
                    raise given_up(error, start, size) from error
                attempts.failed(size)
                continue
            if state is not None:
                return state
            if abs(size) <= smallest:
                raise ConvergenceError(
                    f"step {start.step + 1}, from time {start.time:g}: the error stays above the tolerance "
                    f"{self.tolerance:g} at steps of {abs(size):.3g}. Forces that jump or are noisy: make them "
                    "smooth, give a larger tolerance, or use Rattle with equal steps",
                    residual=attempts.error * self.tolerance,
                    tolerance=self.tolerance,
                    step=start.step + 1,
                )


def landed(
    system: System, start: State, size: float, until: float | None, change: FloatArray, *, forces: bool
) -> State:
    """The state after a step of `size` by which positions and velocities change so, brought onto the constraints.

    Parameters
    ----------
    until : float or None
        The time to be taken, in place of that of rounding.
    change : ndarray, shape (2, n_atoms, 3)
    forces : bool
        Whether to evaluate them there.
    """
    (x, shift), number = system.near_origin(start), start.step + 1
    time, left_over = start.later(size) if until is None else (until, 0.0)
    x, v = x + change[0], system.taken(start)[1] + change[1]
    check_finite(x, "position", number)
    check_finite(v, "velocity", number)
    motion = system.motion
    x = motion.project_positions(x, x, time=time, reference_time=time)
    v = motion.project_velocities(x, v, time=time)
    f = system.forces(x if shift is None else x + shift, v, time, number) if forces else None
    return system.ended(start, number, (time, left_over), (x, v, f), shift, None, shift is None and system.is_far(x))


def rms(values: FloatArray, system: System) -> float:
    """Root mean square over the coordinates of atoms that are not fixed; 0 without any."""
    moving = values[system.inverse_masses[:, 0] > 0]
    return math.sqrt(float(np.mean(moving * moving))) if moving.size else 0.0


def given_up(
    error: ConvergenceError | NonFiniteError | SingularGeometryError, start: State, size: float
) -> ConvergenceError | NonFiniteError | SingularGeometryError:
    """What goes wrong however small the step, with the step's number: the base counts its own."""
    number = start.step + 1
    where = f"step {number}, from time {start.time:g}, at steps down to {abs(size):.3g}"
    if isinstance(error, NonFiniteError):
        return NonFiniteError(
            f"{where}: non-finite {error.item} on atom {error.atom}. The state before this step is intact; check the "
            "geometry and the force function there",
            item=error.item,
            atom=error.atom,
            step=number,
        )
    if isinstance(error, ConvergenceError):
        message = (
            f"{where}: no solution. Targets that jump or cannot be met, or a start off the constraints (use "
            f"System.initial_state): {error.__cause__ or error}"
        )
        return retold(error, message, type(error), number)
    return SingularGeometryError(f"{where}: {error}", rows=error.rows, atoms=error.atoms)
