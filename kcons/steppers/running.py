"""Steps made one after another, with observers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

from kcons.constraints.arguments import check_call, finite_array, finite_number, refuse_other, whole_number
from kcons.motion.certificate import checked_every
from kcons.steppers.files import refuse_clock
from kcons.steppers.splitting import Rattle
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper, require_stepper

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

    Arrays of states cannot be written to: `dataclasses.replace` makes another state, whose forces are found anew.

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
        Each is called with the state at the start and after every `every` steps, and can keep it: `frames.append`.
    every : int
    check_every : int, optional
        The first state, and one in so many, is certified: sigma and A v evaluated by the constraint set itself, beside
        the solvers. The count goes on from one run of a `System` to the next. 0: never. By default one in 1000, or in
        a multiple of that where certificates would take more than 1 % of the time.

    Raises
    ------
    InputError
        A start off the constraints; what is no system, state, stepper or observer; a state whose time is no finite
        number, or whose step no count.
    CertificateError
        A state is off its constraints though its solver said nothing; `error.state` is the last certified one.
    UnsupportedError
        The stepper may not be used with this system.
    KconsError
        Whatever a step raises; `error.step` is its number. Observers have then seen all states that they were due, the
        last one less than `every` steps before.
    """
    steps, every = whole_number(steps, "steps", 0), whole_number(every, "every")
    dt = finite_number(dt, "dt")
    refuse_other(system, System, "system", "a kcons.System")
    refuse_other(state, State, "state", "a kcons.State, such as system.initial_state(positions, velocities)")
    refuse_clock(state.time, state.step, state.time_remainder)
    stepper = Rattle() if stepper is None else stepper
    require_stepper(stepper)
    refuse_other(observers, Iterable, "observers", "a list of functions of a state")
    observers = list(observers)
    for observer in observers:
        check_call("observers", observer, ("state",))
    stepper.check(system)
    check_every, spare = checked_every(check_every)
    holds = getattr(stepper, "holds", True)  # or lets constraints drift
    if dt == 0 or not holds:
        check_every = 0
    schedule = system.schedule
    if hasattr(stepper, "barostat"):
        state = stepper.start(system, state)  # type: ignore[attr-defined]  # the first state shown has a cell
    if steps and holds and state is not system.last:
        x = finite_array(system.kernel_arrays(state)[0], system.n_atoms, "positions")
        system.require_on_rows(x, state.time)
    march = getattr(stepper, "march", None)
    done = 0
    for observer in observers:
        observer(state.read_only())
    while done < steps:
        # Until somebody looks.
        n = schedule.within(min(steps - done, every - done % every) if observers else steps - done, check_every)
        if march is not None:
            state = march(system, state, dt, n)
        else:
            for _ in range(n):
                state = stepper.step(system, state, dt)
        done += n
        schedule.made(n, check_every, state, dt, spare=spare)
        if done % every == 0:
            for observer in observers:
                observer(state.read_only())
    return state.read_only() if steps else state
