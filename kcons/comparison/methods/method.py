"""The contract of a method: what it is, what it cannot run, and a run that advances step by step.

`methods.methods` and `methods.openmm` fulfil it; `work_precision.measure` knows nothing else of them.
"""

from __future__ import annotations

import signal
import textwrap
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.linalg import qr

from kcons.comparison.test_systems import TestSystem
from kcons.constraints.compilation import announcer, clock
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

#: What the engine is asked for in the course of a step.
ENGINE_CALLS = (
    "project_positions",
    "project_velocities",
    "project_forces",
    "restore_positions",
    "acceleration",
    "multipliers",
    "constraint_force",
)

#: Short steps are timed so many at a stretch.
STRETCH = 100


class Stopwatch:
    """Wall time spent inside some methods of one object; calls within calls count once."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth = 0
        self._watched: list[tuple[Any, str, Any]] = []

    def watch(self, target: Any, names: Iterable[str]) -> None:
        """Replace the methods of this one object by timed ones."""
        for name in names:
            if hasattr(target, name):
                self._watched.append((target, name, vars(target).get(name)))
                setattr(target, name, self._timed(getattr(target, name)))

    def release(self) -> None:
        """Give the objects their methods back: to be timed costs half a microsecond a call."""
        while self._watched:
            target, name, own = self._watched.pop()
            if own is None:
                delattr(target, name)  # that of the class shows again
            else:
                setattr(target, name, own)

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **options: Any) -> Any:
            if self._depth:
                return method(*args, **options)
            self._depth += 1
            start = clock()
            try:
                return method(*args, **options)
            finally:
                self.seconds += clock() - start
                self._depth -= 1

        return timed


class Run(ABC):
    """A trajectory in the making.

    Attributes
    ----------
    steps : int
        Steps that the last `advance` made.
    constraints : Stopwatch
        Wall time of the constraints.
    divided : bool
        Whether that time can be told from the rest of a step.
    grows : bool
        Whether steps begin far shorter than they become, so that the first ones do not tell how long it will take.
    """

    steps: int = 1
    divided: bool = True
    grows: bool = False

    def __init__(self) -> None:
        self.constraints = Stopwatch()

    @property
    def time(self) -> float:
        """How far it has come."""
        raise NotImplementedError

    @abstractmethod
    def advance(self) -> None:
        """One step, or as many as `steps` then says."""

    def march(self, steps: int) -> None:
        """Make `steps` steps as `advance` does, without recording anything between them."""
        for _ in range(steps):
            self.advance()

    def rewind(self) -> None:
        """Go back to the start, forces known, while time and steps go on counting."""
        raise NotImplementedError

    def settle(self) -> None:
        """After `rewind`: make the first steps, which set up what is set up lazily."""

    def stretch(self, step_seconds: float, pass_seconds: float) -> int:
        """How many steps to time in one call; they may lead beyond the horizon.

        Parameters
        ----------
        step_seconds : float
            About what a step takes.
        pass_seconds : float
            What is to be timed in all.
        """
        return min(STRETCH, int(pass_seconds / step_seconds))

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether the horizon is reached."""

    @property
    @abstractmethod
    def positions(self) -> FloatArray: ...

    @property
    @abstractmethod
    def velocities(self) -> FloatArray: ...

    def observe(self) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities."""
        return self.positions, self.velocities

    def put(self, x: FloatArray) -> None:
        """Other positions, such as those wrapped into a cell, and the velocities as they are."""
        raise NotImplementedError

    # -- what only an MD engine knows that runs by itself ----------------------------------------------

    def own_energy(self) -> float | None:
        """Total energy as the MD engine states it; None where it follows from positions and velocities."""
        return None

    def own_evaluations(self) -> int | None:
        """Force evaluations so far; None where the test system's potential counts them."""
        return None

    def own_step_seconds(self) -> float | None:
        """Time of a step, where single steps are too short to be timed by the caller.

        Asked for at the end: the state may be spoilt by it.
        """
        return None


class Steps(Run):
    """A run of so many steps of one length; what advances it counts those that are done."""

    def __init__(self, dt: float, steps: int) -> None:
        super().__init__()
        self._dt, self._done, self._planned = dt, 0, steps

    @property
    def time(self) -> float:
        return self._done * self._dt

    @property
    def finished(self) -> bool:
        return self._done >= self._planned


@dataclass(frozen=True)
class Method(ABC):
    """A way to run a test system.

    Attributes
    ----------
    name, title : str
    holds : bool
        False for the baseline, which holds nothing: its cost is the least there is. It makes the first step
        again and again, since with nothing held the system would soon fly apart.
    adaptive : bool
        Whether its setting is a tolerance instead of a time step.
    usual : bool
        Whether it runs unless methods are named.
    md_engine : str
        Whose it is: 'kcons', 'ase', 'scipy', 'openmm' or 'peer'.
    guest : bool
        Whether it also runs, unless methods are named, with test systems of other MD engines. Where it cannot
        run, tables leave it out.
    follows : bool
        Whether it is to follow the reference trajectory. A thermostat does not: no error can be stated.
    remark : str
        What a reader of its numbers should know.
    damps : bool
        Whether it can run test systems with friction.
    marches : bool
        Of the class: whether its runs can `march` and `rewind`, so that steps can be timed without observation.
        Otherwise whole runs are timed.
    """

    marches: ClassVar[bool] = False

    name: str
    title: str
    holds: bool = True
    adaptive: bool = False
    usual: bool = True
    md_engine: str = "kcons"
    guest: bool = False
    follows: bool = True
    remark: str = ""
    damps: bool = False

    def refuses(self, test_system: TestSystem) -> str | None:
        """Why this method cannot run the test system, or None."""
        if test_system.friction and self.holds and not self.damps:
            return "it has no friction"
        return test_system.refusals.get(self.name)

    def settings(self, test_system: TestSystem) -> tuple[float, ...]:
        """Time steps or tolerances to run, the cheapest first."""
        return tuple(test_system.tolerances if self.adaptive else test_system.time_steps)

    def warm_up(self, test_system: TestSystem) -> None:
        """Compile or load what the first step would wait for."""

    @abstractmethod
    def start(self, test_system: TestSystem, setting: float) -> Run:
        """Everything up to the first step."""


def matched_steps(test_system: TestSystem, evaluations: int) -> tuple[float, ...]:
    """Time steps that cost as many force evaluations as the test system's steps cost RATTLE."""
    steps = test_system.time_steps
    first = max(test_system.horizon / steps[0] / evaluations, 1.0 if evaluations == 1 else 2.0)
    counts = dict.fromkeys(max(1, round(first * steps[0] / dt)) for dt in steps)
    return tuple(test_system.horizon / count for count in counts)


def independent_rows(test_system: TestSystem, held: ConstraintSet | None = None) -> ConstraintSet:
    """The constraint set, or an equivalent one, without rows that others imply at the start (last in a pivoted QR)."""
    if held is None:
        held = test_system.constraint_set
    if test_system.motion.rank == held.n_rows:
        return held
    weighted = held.jacobian(test_system.positions).toarray() / np.sqrt(np.repeat(held.masses, 3))
    kept = np.sort(qr(weighted.T, mode="r", pivoting=True)[1][: test_system.motion.rank])
    pieces = []
    for item, start in zip(held.constraints, held.starts, strict=False):
        mine = kept[(kept >= start) & (kept < start + item.n_rows)] - start
        if len(mine):
            pieces.append(item.select(mine))
    return ConstraintSet(pieces, test_system.positions, held.masses, cell=test_system.cell)


def exponent(tolerance: float) -> str:
    """'1e-5', as it is in names and titles."""
    return f"{tolerance:.0e}".replace("e-0", "e-")


# -- what goes wrong --------------------------------------------------------------------------------


#: Seconds until it is seen again whether a kernel is still being compiled.
WAIT = 0.05


class OverBudgetError(Exception):
    """The time is up."""


@contextmanager
def interrupted_after(seconds: float) -> Iterator[None]:
    """Raise OverBudgetError in the body after `seconds`, where the system can do that (Unix, main thread).

    Not while a kernel is being compiled: then as soon as that is done.

    Raises
    ------
    OverBudgetError
        Once: a body that handles it is not interrupted again.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(*_: Any) -> None:
        if announcer.compiling:  # that happens once, and must not begin again and again
            signal.setitimer(signal.ITIMER_REAL, WAIT)
            return
        raise OverBudgetError(f"not done after {seconds:.3g} s")

    previous = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


def first_line(error: Exception) -> str:
    """Kind and first line of an error."""
    first = (str(error).strip().splitlines() or [""])[0]
    return textwrap.shorten(f"{type(error).__name__}: {first}", 280)
