"""Kicks and drifts in turn: what RATTLE, its compositions and the Runge-Kutta-Nystrom splittings share.

A kick changes velocities by h M^-1 f(x, t), a drift flies h along the constraints. What a step consists of is data
(`kcons.steppers.operations`), which `kcons.steppers.interpreter` goes through.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from kcons.errors import InputError
from kcons.steppers.interpreter import Interpreted, Interpreter
from kcons.steppers.operations import Operation, splitting
from kcons.steppers.program import Program
from kcons.steppers.state import State, System


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


class Splitting(Interpreted):
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
        self._made: dict[tuple[bool, ...], tuple[tuple[Operation, ...], Program]] = {}
        self._known: tuple[System, bool, tuple[tuple[Operation, ...], Program]] | None = None

    @property
    def force_evaluations(self) -> int:
        return min(len(self.kicks), len(self.drifts))

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        return self._listed(system)[0]

    def program(self, system: System) -> Program:
        """The operations as the interpreter goes through them."""
        return self._listed(system)[1]

    def _listed(self, system: System | None) -> tuple[tuple[Operation, ...], Program]:
        known = self._known
        if known is not None and known[0] is system and known[1] is system.velocity_dependent:
            return known[2]
        exact = whole = settled = damped = False
        if system is not None:
            settled, friction = system.velocity_dependent, system.friction
            exact, damped = self.exact_flight and system.great_circles is not None, friction is not None
            # With rates of its own for each atom, friction and flight are only composed as RATTLE flights are.
            whole = exact and (friction is None or friction.uniform)
        kind = exact, whole, settled, damped
        found = self._made.get(kind)
        if found is None:
            flight = (1.0,) if whole else self.flight
            listed = splitting(self.kicks, self.drifts, flight, exact=exact, settled=settled, damped=damped)
            found = self._made[kind] = listed, Program(listed)
        if system is not None:
            self._known = system, settled, found
        return found

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used: here, nowhere."""

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        start = state
        if (state is not system.last or state.forces is None) and (self.kick_first or system.velocity_dependent):
            start = system.with_forces(state)
        return Interpreter(system, start, dt, self._listed(system)[1], steps)
