"""Steps made one after another, with observers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

from kcons.constraints.arguments import refuse_units
from kcons.errors import InputError
from kcons.motion.certificate import checked_every
from kcons.steppers.rattle import Rattle
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper

Observer: TypeAlias = Callable[[State], Any]


def run(
    system: System,
    state: State,
    dt: float,
    steps: int,
    *,
    stepper: Stepper | None = None,
    observers: Iterable[Observer] = (),
    every: int = 1,
    check_every: int | None = None,
) -> State:
    """Make `steps` steps of `dt` and return the last state.

    Parameters
    ----------
    system : System
    state : State
        Where to start, for example from `System.initial_state`.
    dt : float
        Time step; negative to go back.
    steps : int
    stepper : Stepper, optional
        `Rattle` by default.
    observers : iterable of callable
        Each is called with the state at the start and after every `every` steps; it can keep the state, and not
        change its arrays.
    every : int
    check_every : int, optional
        The first state, and one in so many, is certified: sigma and A v evaluated by the constraint set itself, beside
        the solvers. The count goes on from one run of a `System` to the next. 0: never. By default one in 1000, or in
        a multiple of that where certificates would take more than 1 % of the time.

    Raises
    ------
    InputError
        Negative `steps` or `check_every`, or `every` below 1; a `dt` with units.
    CertificateError
        A state is off its constraints though its solver said nothing; `error.state` is the last certified one.
    UnsupportedError
        The stepper may not be used with this system.
    KconsError
        Whatever a step raises; `error.step` is its number. Observers have then seen all states that they were due, the
        last one less than `every` steps before.
    """
    if steps < 0 or every < 1:
        raise InputError(f"steps is {steps} and every {every}; give steps >= 0 and every >= 1", item="steps")
    refuse_units(dt, "dt")
    if stepper is None:
        stepper = Rattle()
    stepper.check(system)
    check_every, spare = checked_every(check_every)
    if dt == 0 or not getattr(stepper, "holds", True):
        check_every = 0
    schedule = system.schedule
    watching = tuple(observers)
    for observer in watching:
        observer(state.shown())
    march = getattr(stepper, "march", None)
    done = 0
    while done < steps:
        # Until somebody looks.
        n = min(every - done % every, steps - done) if watching else steps - done
        n = schedule.within(n, check_every)
        if march is not None:
            state = march(system, state, dt, n, check_every=0)
        else:
            for _ in range(n):
                state = stepper.step(system, state, dt)
        done += n
        schedule.made(n, check_every, state, dt, spare=spare)
        if done % every == 0:
            for observer in watching:
                observer(state.shown())
    return state
