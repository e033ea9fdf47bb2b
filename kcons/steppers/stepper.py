"""What a stepper is, and how to run one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from kcons.errors import ConvergenceError, InputError, ReversibilityError, UnsupportedError
from kcons.motion.certificate import checked_every
from kcons.steppers.state import KICK_ROUNDING, State, System


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


class ReversibilityCheck:
    """A stepper that takes every step back again and compares; for finding solves that fail silently.

    Projections have more than one solution when a step is large; a step that lands on another branch than the
    one it came from is no longer reversible, and long runs with such steps are wrong without any other sign.

    Parameters
    ----------
    stepper : Stepper
        The scheme; must be reversible.
    tolerance : float
        Largest allowed difference after a step forward and back: of positions relative to the distance travelled
        or the size of the system, whichever is larger, and of velocities relative to the fastest one. What rounding
        leaves of positions, and of the kick of a step, is allowed besides: at rest there is nothing else.

    Raises
    ------
    UnsupportedError
        The scheme is not reversible at all.
    """

    def __init__(self, stepper: Stepper, tolerance: float = 1e-9) -> None:
        if not stepper.reversible:
            raise UnsupportedError(
                f"{stepper!r} is not reversible, so there is nothing to check; use Rattle, Geodesic, a Composition "
                "or a RungeKuttaNystrom stepper"
            )
        if not tolerance > 0:
            raise InputError(f"tolerance is {tolerance}; give a positive number", item="tolerance")
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
        if dt == 0:
            return after
        try:
            back = self.stepper.step(system, after, -dt)
        except ConvergenceError as error:
            raise ReversibilityError(
                f"step {after.step} cannot be taken back: {error}",
                residual=error.residual,
                tolerance=error.tolerance,
                iterations=error.iterations,
                row=error.row,
                atoms=error.atoms,
                cluster=error.cluster,
                step=after.step,
            ) from error
        speed = max(_largest(state.velocities), _largest(after.velocities))
        length = max(_largest(np.ptp(state.positions, axis=0)), speed * abs(dt))
        rounding = 8 * float(np.spacing(_largest(state.positions)))
        forces = system.with_forces(after).forces
        assert forces is not None
        kick = abs(dt) * _largest(forces * system.inverse_masses)
        moved = np.maximum(np.abs(back.positions - state.positions) - rounding, 0.0)
        turned = np.maximum(np.abs(back.velocities - state.velocities) - KICK_ROUNDING * kick, 0.0)
        # A speed of zero both before and after leaves nothing to compare with.
        off = np.maximum(moved / (length or 1.0), turned / (speed or 1.0))
        residual = float(off.max(initial=0.0))
        if not residual <= self.tolerance:
            atom = int(np.argmax(off.max(axis=1)))
            raise ReversibilityError(
                f"step {after.step} is not reversible: taken back, atom {atom} misses its start by {residual:.3g} "
                f"(relative; allowed {self.tolerance:.3g}); use a smaller time step than {dt:g}",
                residual=residual,
                tolerance=self.tolerance,
                atoms=[atom],
                step=after.step,
            )
        return after


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
        Negative `steps` or `check_every`, or `every` below 1.
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
    if stepper is None:
        from kcons.steppers.rattle import Rattle  # which imports this module

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
    elif error.singular:
        cause = "a held dihedral becomes undefined"
    else:
        cause = f"time step too large (dt = {dt:g})"
    return type(error)(
        f"step {number}: {cause}. {error}",
        residual=error.residual,
        tolerance=error.tolerance,
        iterations=error.iterations,
        row=error.row,
        atoms=error.atoms,
        cluster=error.cluster,
        step=number,
        singular=error.singular,
    )


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))
