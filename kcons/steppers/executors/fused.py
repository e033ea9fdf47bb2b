"""Kicks and drifts in few compiled calls, each of which costs as much as its work on a few molecules."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from weakref import ref

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError
from kcons.steppers.operations import Fly
from kcons.steppers.stages.compensated_steps import NO_WORK, check_finite
from kcons.steppers.stages.fused_stages import BOTH, END, FLY, NO_FRACTIONS, UNENDED, Flights
from kcons.steppers.state import State, System
from kcons.steppers.stepper import explained

_FLOAT = np.dtype(np.float64)


def fused_steps(
    system: System, start: State, dt: float, steps: int, flights: Flights, kicks: Sequence[float], drifts: Sequence[Fly]
) -> tuple[State, int]:
    """As many steps K D K ... D K as can be joined: the state after them, and their number, which may be 0.

    The end of a step and the beginning of the next are one call. Where that call cannot end the step, it and those
    after it are left to the caller; one step alone is always made.

    Parameters
    ----------
    start : State
        With its forces.
    steps : int
        1 if the state has a remainder: the atom that positions are relative to moves.
    kicks : sequence of float
    drifts : sequence of Fly
        One less, neither along great circles nor with friction.

    Raises
    ------
    ConvergenceError, NonFiniteError, InputError
        With `step`; the last as of the force function.
    """
    # A step of few atoms takes a microsecond in the kernel: each line here can be seen in the time of a run.
    force, number, stage = system.force, start.step, drifts[0]
    x, v, f = system.taken(start)
    shape, shift, cells = x.shape, None, start.barostat
    if (remainder := system.remainder_of(start)) is not None:
        shift = x[system.anchor]
        x = (x - shift) + remainder
    if force is None or f is None:
        kicks, f = (0.0,) * len(kicks), system.weights  # any finite numbers
    first, last, fractions = kicks[0] * dt, kicks[-1] * dt, stage.lengths
    later, work = None, NO_WORK
    if len(drifts) * len(stage.flights) > 1:
        later, work = list(zip(kicks[1:], drifts, drifts[1:], strict=False)), np.empty((3, *shape))
    time, left_over, what, found, made = start.time, start.time_remainder, FLY, 0, 0
    new, array, double, landed, out = np.empty, np.ndarray, _FLOAT, flights.landed, x
    # Where this step begins and where the last one did. Nobody else knows their velocities, so that the arrays are
    # used again.
    here = before = x, v, time, left_over
    u = new(shape)
    spare, next_spare = (new(shape), new(shape)) if steps > 1 else (u, u)
    tables, (given, held) = flights.tables(), system.motion.sources
    cell = held.lattice
    one = many = flights.one if later is None else flights.many
    try:
        for made in range(steps):
            if held.lattice is not cell or given.lattice is not cell:  # the force function is a barostat, too
                tables, cell = flights.tables(), held.lattice
            out = new(shape)
            if later is None:
                found = one(what, dt, x, v, u, last, first, f, out, tables)
            else:
                found = many(what, fractions, dt, 0, x, v, u, work, last, first, f, True, out, tables)
            if found == UNENDED:
                flights.refuse()
                return _at(before, start, made - 1), made - 1
            here = x, v, time, left_over
            if found < 0:
                # The engine's kernels are compiled for arrays that can be written to.
                found = landed(found, fractions, dt, x.copy(), u, work, f, out, time, number + made + 1, tables)
            if later is not None:
                begun = number + made + 1, time, left_over
                x, out, f, found = _further(system, flights, later, dt, begun, x, u, f, out, work, shift, tables)
            # As State.later.
            change = dt + left_over
            then = time + change
            part = then - time
            time, left_over = then, (time - (then - part)) + (change - part)
            if force is not None:
                # The function can neither write to it nor will anybody else: it may keep what it sees.
                out.setflags(False)  # type: ignore[call-arg]
                raw: Any = force(out if shift is None else out + shift, time)
                # What System.accepted finds most often.
                usual = type(raw) is array and raw.dtype is double and raw.shape == shape and raw.flags.carray
                f = raw if usual else system.accepted(raw, number + made + 1, False)
            x, v, u, spare, next_spare, before, what = out, u, spare, next_spare, u, here, BOTH
        if force is not None:
            x = x.copy()  # other kernels are compiled for arrays that can be written to
            if held.lattice is not cell or given.lattice is not cell:
                tables = flights.tables()
        if later is None:
            status = one(END, dt, x, v, v, last, 0.0, f, x, tables)
        else:
            status = many(END, NO_FRACTIONS, dt, 0, x, v, v, work, last, 0.0, f, False, x, tables)
        far = status and flights.ended(status, x, v, f, time, number + steps, tables)
    except ConvergenceError as error:
        raise explained(error, system, _at(here, start, made), dt, number + made + 1) from error
    except InputError:
        for numbers, item in ((out, "position"), (u, "velocity"), (work[1] if len(work) else u, "velocity")):
            check_finite(numbers, item, number + made + 1)
        raise
    if found != flights.took:
        flights.took = found
        flights.motion.took(found)
    x, remainder = _relative(x, shift, work) if shift is not None or far else (x, None)
    forces, origin = start.forces if force is None else f.copy(), (ref(system), x, v, time)
    state = system.last = State(x, v, time, forces, number + steps, remainder, left_over, None, cells, origin)
    return state, steps


def _further(
    system: System,
    flights: Flights,
    later: Sequence[tuple[float, Fly, Fly]],
    dt: float,
    begun: tuple[int, float, float],
    x: FloatArray,
    *arrays: Any,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """The kicks and drifts of a step after its first drift: where the last begins and ends, forces, what happened.

    Parameters
    ----------
    later : sequence of (kick, drift before it, drift after it)
    begun : tuple of (number of the step, time, its remainder)
        Of its beginning.
    x, *arrays
        As in `fused_steps`: x, u, f, out, work, shift, tables.
    """
    (number, time, left_over), (u, f, out, work, shift, tables), found = begun, arrays, 0
    for kick, passed, stage in later:
        if system.force is not None:
            out.setflags(False)
            now = time + (passed.ends[-1] * dt + left_over)
            f = system.accepted(system.force(out if shift is None else out + shift, now), number, False)
        x, out = out, np.empty(x.shape)
        found = flights.many(FLY, stage.lengths, dt, 0, x, u, u, work, 0.0, kick * dt, f, False, out, tables)
        if found < 0:
            now = time + (stage.ends[-1] * dt + left_over)
            found = flights.landed(found, stage.lengths, dt, x.copy(), u, work, f, out, now, number, tables)
    return x, out, f, found


def _relative(x: FloatArray, shift: FloatArray | None, work: Any) -> tuple[FloatArray, FloatArray]:
    """Positions relative to one atom, as positions and what rounding takes from them."""
    if shift is None:  # by now: from here on
        return x, work[0].copy() if len(work) else np.zeros(x.shape)
    out = x + shift
    return out, x - (out - shift)


def _at(begin: tuple[FloatArray, FloatArray, float, float], start: State, made: int) -> State:
    """Where a step began, `made` steps after `start`; its forces have been forgotten since."""
    x, v, time, left_over = begin
    return State(x, v.copy(), time, None, start.step + made, None, left_over, None, start.barostat) if made else start
