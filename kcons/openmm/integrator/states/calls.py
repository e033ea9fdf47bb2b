"""Calls of `step`: steps made as one, ends of steps that are put off, and failures.

An `app.Simulation` asks for steps in tens and reads the Context only where a reporter does. The operations at the end
of a call that only a reader of the state needs are therefore put off. The next call continues as if it were the same
call; reading the Context makes them first, see `settle`. So steps in tens cost what they cost in one long call.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.errors import KconsError
from kcons.openmm.integrator.guard import Guard
from kcons.openmm.integrator.interface import Integrator

if TYPE_CHECKING:
    from kcons.openmm.integrator.lean_step_writer import LeanStepWriter

#: Integrators that have put something off, by the addresses of their Contexts.
_OWING: WeakValueDictionary[int, Calls] = WeakValueDictionary()


def settle(context: openmm.Context) -> None:
    """Make what the integrator of a Context has put off."""
    if _OWING and (owing := _OWING.get(int(context.this))) is not None:
        if owing.bereft:
            del _OWING[int(context.this)]  # of a Context that is gone and had the same address
        else:
            owing.settle()


class Calls(Integrator):
    """The steps of an integrator."""

    unseen: bool = False
    _owed: int = 0
    _guard: Guard | None
    _plan: LeanStepWriter

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        raise NotImplementedError

    def _failure(self, code: int, step: int) -> KconsError:
        raise NotImplementedError

    def refresh(self) -> None:
        """Compute the forces anew at the next step."""
        raise NotImplementedError

    # -- what is put off ------------------------------------------------------------------------

    @property
    def bereft(self) -> bool:
        """Whether the Context is gone."""
        return self._guard is None or self._guard.alive is None

    def _owe(self, steps: int) -> None:
        self._owed = steps
        if steps:
            assert self._guard is not None
            _OWING[int(self._guard.context.this)] = self

    def _take_owed(self) -> int:
        """The steps that were put off: who takes them makes them."""
        owed, self._owed = self._owed, 0
        if not owed or self._guard is None or self.bereft:
            return 0
        _OWING.pop(int(self._guard.context.this), None)
        return owed

    def settle(self) -> None:
        """Make what was put off."""
        owed = self._take_owed()
        if owed:
            unseen, self.unseen = self.unseen, False
            try:
                self.step(owed)
            finally:
                self.unseen = unseen

    # -- a call ---------------------------------------------------------------------------------

    @contextmanager
    def ending(self) -> Iterator[None]:
        """The program is executed for the last time in a call, and sums squares of velocities."""
        self.program.write("ending", 1.0)
        try:
            yield
        finally:
            self.program.write("ending", 0.0)

    def step(self, steps: int) -> None:
        """Make `steps` steps.

        Raises
        ------
        KconsError
            A solve of one of the parts failed: positions, velocities, time and step count are those before that
            step, `error.step` is its number. (What barostats and CMMotionRemover did at its beginning stays.) Or a
            check failed, or a NaN appeared: they are those of the last check.
        InputError, UnsupportedError
            `steps` is no whole number. At the first step: the System cannot be propagated, or the start is not on the
            constraints.
        """
        steps = whole_number(steps, "steps", 0) + self._take_owed()
        guard = self._watch()
        guard.meet_others()
        if guard.disturbed:
            guard.begin()
        if self._plan.kept and guard.surroundings_changed():
            self.refresh()
        owed = 0
        while steps > 0:
            # At least one: `check_every` may have become less than what was made since the last check.
            block = min(steps, max(self.check_every - guard.since_check, 1)) if self.check_every else steps
            check_is_due = 0 < self.check_every <= guard.since_check + block
            goes_on = self.unseen and block == steps and not check_is_due
            done = self._run_block(guard, block, to_the_end=not goes_on, ends=block == steps)
            guard.count(done)
            owed = block - done
            steps -= block
        guard.leave()
        if self._plan.kept:
            guard.note_surroundings()
        self._owe(owed)

    def _run_block(self, guard: Guard, steps: int, to_the_end: bool, ends: bool) -> int:
        """Make steps, with the shorter program for those after which the state is not read; how many were made."""
        unseen = steps - self._plan.observed if self._plan.lazy and not guard.in_parts else 0
        if self._plan.lean:
            self.program.write("lean", guard.undisturbed)
            self.program.write("moving", guard.moving)
        made = 0
        if unseen > 0 and guard.undisturbed and not (self._plan.joined and guard.moving):
            self.program.write("between", 1.0)
            try:
                self._run(guard, unseen, ends and not to_the_end)
            finally:
                self.program.write("between", 0.0)
            made = unseen
            if not to_the_end:
                return made
        self._run(guard, steps - made, ends)
        return steps

    def _run(self, guard: Guard, steps: int, ends: bool) -> None:
        """Make steps; with the last of them a call may end."""
        context, dt = guard.context, self.getStepSize()._value
        time, first = context.getTime().value_in_unit(unit.picosecond), context.getStepCount()
        before = self.getGlobalVariableByName("good_steps") if self.parts else 0.0
        for part in self.parts:
            part.begin_run()
        try:
            phases = self._plan.phases if guard.in_parts else 1
            summed = ends and guard.sums
            self.program.run(context, steps - summed, phases)
            if summed:
                with self.ending():
                    self.program.run(context, 1, phases)
        except openmm.OpenMMException as error:
            guard.put_back()
            if "NaN" not in str(error):
                raise
            raise guard.explosion(str(error), first) from error
        code = int(self.getGlobalVariableByName("failed")) if self.parts else 0
        done = int(self.getGlobalVariableByName("good_steps") - before) if code else steps
        # OpenMM's clock goes on with the first step size after setStepSize.
        expected = time + done * dt
        if code or abs(context.getTime().value_in_unit(unit.picosecond) - expected) > 1e-6 * dt:
            context.setTime(expected)
        if code:
            context.setStepCount(first + done)
            guard.since_check += done
            failure = self._failure(code, first + done + 1)
            if self._plan.lean and self.getGlobalVariableByName("loose"):
                self.program.write("between", 0.0)
                self.applyVelocityConstraints(context)
            raise failure
        if ends:
            guard.look()
