"""What a stepper is, and a check of any of them: every step is reversed and compared with its start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from kcons.constraints.arguments import Positive, checked
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import ConvergenceError, InputError, KconsError, ReversibilityError, UnsupportedError
from kcons.motion.certificate import off_row
from kcons.steppers.operations import Operation
from kcons.steppers.state import KICK_ROUNDING, State, System

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
    """Raise `InputError` for a class, or a name."""
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
            What it makes of the step: great circles, forces that depend on velocities. Without it, what
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
    """The state after a step of zero, None for any other step; `InputError` where `dt` is not finite."""
    if not math.isfinite(dt):
        raise InputError(f"the time step is {dt}", item="dt")
    return replace(state, step=state.step + 1) if dt == 0 else None


def explained(error: ConvergenceError, system: System, state: State, dt: float, number: int) -> ConvergenceError:
    """The engine's error with the step's number and its likely cause."""
    held = system.motion.constraint_set
    miss = np.abs(held.value(state.positions, state.time))
    allowed = np.maximum(1e-6 * held.scale, 4 * held.tolerance(state.positions, state.time))
    row = off_row(miss, allowed)
    if row >= 0:
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


class ReversibilityCheck:
    """A stepper that reverses every step and compares with its start, to find solves that fail silently.

    Projections have more than one solution when a step is large; a step that lands on another branch than the
    one it came from is no longer reversible, and long runs with such steps are wrong without any other sign.

    Parameters
    ----------
    stepper : Stepper
        The scheme; must be reversible.
    tolerance : float
        Largest allowed difference after a step forward and back: of positions relative to the distance traveled
        or the size of the system, whichever is larger, and of velocities relative to the fastest one. What rounding
        leaves of positions, and of the kick of a step, is allowed besides: at rest there is nothing else.

    Raises
    ------
    UnsupportedError
        The scheme is not reversible at all.
    """

    @checked
    def __init__(self, stepper: Stepper, tolerance: Positive = 1e-9) -> None:
        require_stepper(stepper)
        if not stepper.reversible:
            raise UnsupportedError(
                f"{stepper!r} is not reversible, so there is nothing to check; use Rattle, Geodesic, a Composition "
                "or a RungeKuttaNystrom stepper"
            )
        self.stepper = stepper
        self.tolerance = tolerance
        self.order = stepper.order
        self.reversible = True
        self.symplectic = stepper.symplectic
        self.force_evaluations = 2 * stepper.force_evaluations
        self.holds = getattr(stepper, "holds", True)

    def __repr__(self) -> str:
        return f"ReversibilityCheck({self.stepper!r})"

    def check(self, system: System) -> None:
        self.stepper.check(system)

    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`.

        Raises
        ------
        ReversibilityError
            The step back does not end where the step began; carries `step` and `residual`.
        KconsError
            Whatever the stepper raises, forward or back.
        """
        after = self.stepper.step(system, state, dt)
        if dt != 0:
            self.take_back(system, state, after, dt, lambda: [system.with_forces(after).forces])
        return after

    def take_back(
        self, system: System, state: State, after: State, dt: float, forces: Callable[[], list[FloatArray | None]]
    ) -> None:
        """Make the step back from `after` and compare with `state`; `forces` gives those of the step, for rounding.

        Raises
        ------
        ReversibilityError
            As `step`.
        """
        try:
            back = self.stepper.step(system, after, -dt)
        except ConvergenceError as error:
            message = f"step {after.step} cannot be taken back: {error}"
            raise retold(error, message, ReversibilityError, after.step) from error
        acceleration = max((_largest(f * system.inverse_masses) for f in forces() if f is not None), default=0.0)
        # Relative; a speed of zero both before and after leaves nothing to compare with.
        speed, kick = max(_largest(state.velocities), _largest(after.velocities)), abs(dt) * acceleration
        length = max(extent(state.positions), speed * abs(dt))
        rounding = 8 * float(np.spacing(_largest(state.positions)))
        moved = np.maximum(np.abs(back.positions - state.positions) - rounding, 0.0)
        turned = np.maximum(np.abs(back.velocities - state.velocities) - KICK_ROUNDING * kick, 0.0)
        off = np.maximum(moved / (length or 1.0), turned / (speed or 1.0))
        residual = float(off.max(initial=0.0))
        if not residual <= self.tolerance:
            atom = int(np.argmax(off.max(axis=1)))
            raise ReversibilityError(
                f"step {after.step} is not reversible: taken back, atom {atom} misses its start by {residual:.3g} "
                f"(relative; allowed {self.tolerance:.3g}); use a smaller time step than {system.shown_time(dt)}",
                residual=residual,
                tolerance=self.tolerance,
                atoms=[atom],
                step=after.step,
            )


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))
