"""Kicks and drifts in turn: what RATTLE, its compositions and the Runge-Kutta-Nystrom splittings share.

A kick changes velocities by h M^-1 f(x, t), a drift flies h along the constraints (`kcons.steppers.stages.drifts`).
What a step consists of is data (`kcons.steppers.operations`), which executors run piece by piece or in compiled calls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kcons.errors import InputError
from kcons.motion.certificate import checked_every
from kcons.steppers.executors.fused import fused_steps
from kcons.steppers.executors.piecewise import SplittingStep
from kcons.steppers.operations import Operation, drifts_of, splitting
from kcons.steppers.stages.fused_stages import Flights
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Listed, stays


def fractions_of(values: Sequence[float], item: str) -> tuple[float, ...]:
    """Fractions of a step: a palindrome with the sum 1.

    Raises
    ------
    InputError
    """
    g = tuple(float(x) for x in values)
    if not g or any(abs(a - b) > 1e-15 for a, b in zip(g, reversed(g), strict=True)):
        raise InputError(f"{item} {g} are no palindrome; give them so that steps can be taken back", item=item)
    if abs(math.fsum(g) - 1.0) > 1e-14:
        raise InputError(f"{item} {g} add up to {math.fsum(g):g}, not to 1; divide them by their sum", item=item)
    return g


class Splitting(Listed):
    """Base of the steppers made of kicks and drifts.

    Parameters
    ----------
    kicks, drifts : sequence of float
        Palindromes of fractions of the step. One kick more than drifts: the step begins and ends with a kick, and
        the last force is the first of the next step. One drift more than kicks: it begins and ends with a drift.
    flight : sequence of float
        Each drift is this symmetric composition of RATTLE drifts.
    exact_flight : bool
        Whether to fly along great circles instead where every row allows it.

    Raises
    ------
    InputError
        What is no palindrome with the sum 1; kicks and drifts that are not in turn.
    """

    order: int = 2
    reversible = True
    symplectic = True

    def __init__(
        self,
        kicks: Sequence[float],
        drifts: Sequence[float],
        flight: Sequence[float] = (1.0,),
        exact_flight: bool = False,
    ) -> None:
        self.kicks = fractions_of(kicks, "kicks")
        self.drifts = fractions_of(drifts, "drifts")
        self.flight = fractions_of(flight, "flight")
        if abs(len(self.kicks) - len(self.drifts)) != 1:
            raise InputError(
                f"{len(self.kicks)} kicks and {len(self.drifts)} drifts do not come in turn; give one more of one",
                item="kicks",
            )
        self.exact_flight = exact_flight
        self.kick_first = len(self.kicks) > len(self.drifts)
        self._stages = drifts_of(self.drifts, self.flight)
        self._many = len(self.drifts) * len(self.flight) > 1
        self._made: dict[tuple[bool, ...], tuple[Operation, ...]] = {}

    @property
    def force_evaluations(self) -> int:
        return min(len(self.kicks), len(self.drifts))

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        exact = whole = settled = damped = False
        if system is not None:
            exact, settled, friction = self._circles(system), system.velocity_dependent, system.friction
            damped = friction is not None
            # With rates of its own for each atom, friction and flight are only composed as RATTLE flights are.
            whole = exact and (friction is None or friction.uniform)
        kind = exact, whole, settled, damped
        if kind not in self._made:
            flight = (1.0,) if whole else self.flight
            self._made[kind] = splitting(self.kicks, self.drifts, flight, exact=exact, settled=settled, damped=damped)
        return self._made[kind]

    def _circles(self, system: System) -> bool:
        """Whether drifts follow great circles."""
        return self.exact_flight and system.great_circles is not None

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used: here, nowhere."""

    # As a decorator this costs half of a `with`. What overflows is looked for, and named with the step's number.
    @np.errstate(over="ignore", invalid="ignore")
    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; negative steps go back, 0 changes nothing.

        Raises
        ------
        ConvergenceError
            No solution (the step is too large); carries `step`.
        NonFiniteError
            A force, position or velocity became NaN or infinite; carries `step`.
        InputError
            `dt` is not finite; the force function returned a wrong shape.
        UnsupportedError
            The stepper may not be used with this system.
        """
        self.check(system)
        still = stays(state, dt) if dt == 0 or not math.isfinite(dt) else None
        if still is not None:
            return still
        flights = self._flights(system)
        if flights is not None:
            start = state if state is system.last and state.forces is not None else system.with_forces(state)
            return fused_steps(system, start, dt, 1, flights, self.kicks, self._stages)[0]
        operations = self.operations(system)
        start = system.with_forces(state) if operations[0].verb == "kick" else state
        step = SplittingStep(system, start, dt, exact=self._circles(system), many=self._many)
        return step.through(operations)

    @np.errstate(over="ignore", invalid="ignore")
    def march(self, system: System, state: State, dt: float, steps: int, *, check_every: int | None = None) -> State:
        """The state after so many steps, the same to the last bit as by `step`.

        Nobody looks at the states between: where all is compiled, the end of a step and the beginning of the next are
        one call. `check_every` is as for `run`.

        Raises
        ------
        KconsError
            As `step`; `error.step` says which one.
        CertificateError
            As `run`.
        """
        self.check(system)
        check_every, spare = checked_every(check_every if dt != 0 else 0)
        while steps > 0:
            n = system.schedule.within(steps, check_every)
            state = self._unseen(system, state, dt, n)
            system.schedule.made(n, check_every, state, dt, spare=spare)
            steps -= n
        return state

    def _unseen(self, system: System, state: State, dt: float, steps: int) -> State:
        flights = None
        if type(self).step is Splitting.step and dt != 0 and math.isfinite(dt):
            flights = self._flights(system)
        while steps > 0:
            if flights is not None and steps > 1 and state.remainder is None:
                start = system.with_forces(state)
                state, made = fused_steps(system, start, dt, steps, flights, self.kicks, self._stages)
                steps -= made
            if steps > 0:
                # What is out of the ordinary: here it is done, or said what it is.
                state = self.step(system, state, dt)
                steps -= 1
        return state

    def _flights(self, system: System) -> Flights | None:
        """Compiled stages, where steps are made of them."""
        flights = system.flights
        if flights is None or system.velocity_dependent or system.friction is not None or not self.kick_first:
            return None
        return None if self._circles(system) else flights
