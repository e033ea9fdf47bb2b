"""What a stepper is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from kcons.errors import ConvergenceError, InputError, KconsError
from kcons.steppers.operations import Operation
from kcons.steppers.state import State, System

Error = TypeVar("Error", bound=KconsError)


class Stepper(Protocol):
    """A scheme that advances states.

    Attributes
    ----------
    order : int
        Global order of the error in positions and velocities.
    reversible : bool
        Whether a step with -dt undoes a step with dt (to the tolerance of the solves).
    symplectic : bool
        Whether it is symplectic for position rows and forces that derive from a potential.
    force_evaluations : int
        Evaluations of the force a step, for forces that depend on positions and time only. The first step of a
        run may need one more.
    """

    @property
    def order(self) -> int: ...
    @property
    def reversible(self) -> bool: ...
    @property
    def symplectic(self) -> bool: ...
    @property
    def force_evaluations(self) -> int: ...

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used."""
        ...

    def step(self, system: System, state: State, dt: float) -> State:
        """The state after `dt`; pure."""
        ...


def require_stepper(stepper: Any, item: str = "stepper") -> None:
    """Refuse a class, or a name.

    Raises
    ------
    InputError
    """
    if isinstance(stepper, type) or not hasattr(stepper, "step"):
        raise InputError(f"{item} is {stepper!r}; give an object, such as kcons.Rattle()", item=item)


class DropsSystemCaches:
    """Base of those that remember what they found for a System: copies and other processes find it anew."""

    #: What is known of a System; what the last step ended in, by which a state that goes on is known.
    _known: Any = None
    _left: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: None if name in ("_known", "_left") else value for name, value in vars(self).items()}


class Listed(DropsSystemCaches):
    """Base of those whose step is a list of operations."""

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        """What a step consists of.

        Parameters
        ----------
        system : System, optional
            What it makes of the step: great circles, friction, forces that depend on velocities. Without it, what
            the step consists of where forces depend on positions and time only.
        """
        raise NotImplementedError

    def parts(self, system: System | None = None) -> tuple[Operation, ...]:
        """What is run: the operations, with what is done between them."""
        return self.operations(system)

    def listing(self, system: System | None = None) -> str:
        """What is run in words, a line for each operation, with fractions of the step; `system` as for `operations`."""
        return "\n".join([f"a step of {self!r}", *(f"  {operation}" for operation in self.parts(system))])


def stays(state: State, dt: float) -> State | None:
    """The state after a step of zero, None for any other step.

    Raises
    ------
    InputError
        `dt` is not finite.
    """
    if not math.isfinite(dt):
        raise InputError(f"the time step is {dt}", item="dt")
    return replace(state, step=state.step + 1) if dt == 0 else None


def explained(error: ConvergenceError, system: System, state: State, dt: float, number: int) -> ConvergenceError:
    """The engine's error with the step's number and its likely cause."""
    held = system.motion.constraint_set
    miss = np.abs(held.value(state.positions, state.time))
    allowed = np.maximum(1e-6 * held.scale, 4 * held.tolerance(state.positions, state.time))
    off = np.flatnonzero(~(miss <= allowed))
    if len(off):
        row = int(off[np.argmax(miss[off])])
        cause = (
            f"the state before it was already off row {held.row_name(row)} by {miss[row]:.3g}; "
            "start from System.initial_state(..., project=True)"
        )
    else:
        cause = f"time step too large (dt = {system.shown_time(dt)})"
    return retold(error, f"step {number}: {cause}. {error}", type(error), number)


def retold(error: Error, message: str, kind: type[Error], step: int) -> Error:
    """The same in other words."""
    told = kind(message)
    vars(told).update(vars(error), step=step)
    return told
