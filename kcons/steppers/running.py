"""Steps made one after another, with observers, and what is kept of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypedDict, Unpack, overload

import numpy as np

from kcons.constraints.arguments import check_call, finite_array, finite_number, refuse_other, whole_number
from kcons.constraints.target import FloatArray
from kcons.motion.certificate import checked_every
from kcons.steppers.files import refuse_clock
from kcons.steppers.splitting import Rattle
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper, require_stepper

Observer: TypeAlias = Callable[[State], Any]


@dataclass(eq=False, repr=False)
class Trajectory:
    """States of a run, from the first on, as ``run(system, state, 0.01, 1000, record=10)`` returns 101 of them.

    Attributes
    ----------
    frames : list of State
    last : State
        Where the run ended, or the last frame of a run that stopped; a run can go on from here.
    times : ndarray, shape (n_frames,)
    positions, velocities : ndarray, shape (n_frames, n_atoms, 3)
        In the caller's units.
    """

    frames: list[State]
    last: State

    @property
    def times(self) -> FloatArray:
        return np.array([state.time for state in self.frames])

    @property
    def positions(self) -> FloatArray:
        return np.array([state.positions for state in self.frames])

    @property
    def velocities(self) -> FloatArray:
        return np.array([state.velocities for state in self.frames])


class _Options(TypedDict, total=False):
    stepper: Stepper | None
    observers: Iterable[Observer]
    every: int
    check_every: int | None


@overload
def run(
    system: System, state: State, dt: float, steps: int, *, record: None = None, **options: Unpack[_Options]
) -> State: ...
@overload
def run(
    system: System, state: State, dt: float, steps: int, *, record: int, **options: Unpack[_Options]
) -> Trajectory: ...


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
    record: int | None = None,
) -> State | Trajectory:
    """Make `steps` steps of `dt` and return the last state, or the trajectory.

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
        Each is called with the state at the start and after every `every` steps; it can keep the state.
    every : int
    check_every : int, optional
        The first state, and one in so many, is certified: sigma and A v evaluated by the constraint set itself, beside
        the solvers. The count goes on from one run of a `System` to the next. 0: never. By default one in 1000, or in
        a multiple of that where certificates would take more than 1 % of the time.
    record : int, optional
        Keep the first state and one in so many, and return a `Trajectory`, whose `last` is the last state.

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
        last one less than `every` steps before. Whatever is raised, `error.trajectory` has what was recorded.
    """
    steps, every = whole_number(steps, "steps", 0), whole_number(every, "every")
    record = None if record is None else whole_number(record, "record")
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
    kept: list[State] = []
    rhythms = [(observer, every) for observer in observers] + ([(kept.append, record)] if record is not None else [])
    march = getattr(stepper, "march", None)
    done = 0
    try:
        for observer, _ in rhythms:
            observer(state.read_only())
        while done < steps:
            # Until somebody looks.
            n = min([steps - done, *(rhythm - done % rhythm for _, rhythm in rhythms)])
            n = schedule.within(n, check_every)
            if march is not None:
                state = march(system, state, dt, n)
            else:
                for _ in range(n):
                    state = stepper.step(system, state, dt)
            done += n
            schedule.made(n, check_every, state, dt, spare=spare)
            for observer, rhythm in rhythms:
                if done % rhythm == 0:
                    observer(state.read_only())
    except BaseException as error:  # also one of the forces, or of the keyboard: nothing recorded is lost
        if record is not None:
            error.trajectory = Trajectory(kept, kept[-1] if kept else state)  # type: ignore[attr-defined]
        raise
    state = state.read_only() if steps else state
    return state if record is None else Trajectory(kept, state)
