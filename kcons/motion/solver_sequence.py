"""All solvers of a plan, one after another on local arrays; if one of them fails, nothing is changed."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, KconsError
from kcons.motion.failures import Failures
from kcons.motion.restoring.nearest_point import DampedFallback, FarStart, IterationBudget
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import Request, resume
from kcons.solvers.tolerances import MANY_ITERATIONS


class SolverSequence:
    """Projections of the atoms that a plan knows.

    Parameters
    ----------
    rows : ConstraintSet
        The rows on local atoms.
    plan : Plan
    numbers : ndarray of int or None
        Global numbers of the local atoms, for messages; None where they are the same.

    Attributes
    ----------
    iterations : list of int
        What each solver took the last time, for reports.
    failures : Failures
    unchecked : ndarray or None
        A cell before the present one, until positions have shown that no row has another image for it.
    """

    def __init__(self, rows: ConstraintSet, plan: Plan, numbers: IntArray | None) -> None:
        self.rows, self.plan, self.numbers = rows, plan, numbers
        self.unchecked: FloatArray | None = None
        # Plain attributes: a step of one bond takes microseconds, and looking these up would show.
        self._moving = rows.moving
        self._velocity_rows: IntArray = np.flatnonzero(~rows.holonomic)
        self._placed = rows.placed
        self._several = len(plan.solvers) > 1 or len(plan.pinned) > 0
        self.iterations = [0] * len(plan.solvers)
        self.failures = Failures(rows, plan, numbers)
        self._fallback = DampedFallback(rows, plan, self.failures)

    def positions(
        self,
        x: FloatArray,
        ref: FloatArray,
        time: float,
        reference_time: float,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        flight: float = 0.0,
    ) -> None:
        """Run all solvers in place; restore what they changed and raise if one fails.

        Rows of velocities hold at the middle of a `flight` of that length from `ref` to `x`; if it is 0, they do not
        count.
        """
        plan, rows = self.plan, self.rows
        lattice = rows.lattice
        images = None if lattice is None else rows.images
        targets = rows.target(time) if self._moving else None
        if len(self._velocity_rows):
            targets = rows.target(time) if targets is None else targets
            middle = rows.target(0.5 * (reference_time + time)) if flight else targets
            targets[self._velocity_rows] = flight * middle[self._velocity_rows]
        # One solver alone restores what it changed; several need a copy to go back to.
        several = self._several or images is not None
        saved = (x.copy(), None if velocities is None else velocities.copy()) if several else None
        found: list[FloatArray | None] = []
        moved: FloatArray | None = None
        try:
            if len(plan.pinned):
                x[plan.pinned] = plan.pinned_targets(targets)
                if plan.loose is not None:
                    plan.check_loose_rows(x, time)
            if images is not None and lattice is not None:
                if self.unchecked is not None:
                    rows.refuse_other_images(ref, self.unchecked, reference_time, self.numbers)
                    self.unchecked = None
                stored, ref = ref, images.make_whole(ref, lattice)
                shifts = images.follow(x, stored, ref, lattice)
                places = None if self._placed is None else x[self._placed]
                x[images.atoms] += shifts
                moved = None if places is None else rows.moved_places(places, x)
            given = (x, ref, targets, lattice, time, reference_time, velocities, inv_dt, flight != 0, moved)
            request = tuple.__new__(Request, given)  # as `Request(*given)`, in a third of its time
            for k, solver in enumerate(plan.solvers):
                lam = None if multipliers is None else np.empty(len(solver.rows))
                asked = request if lattice is None else plan.asked_of(k, request)
                outcome = solver.positions(asked, lam)
                if not outcome.converged:
                    outcome = self._fallback.solve(solver, outcome, asked, lam)
                if outcome.iterations > MANY_ITERATIONS:
                    # A far start leaves the rounding of its size; once more from the near end removes it.
                    resume(solver.positions, asked, lam)
                self.iterations[k] = outcome.iterations
                found.append(lam)
            if images is not None:
                rows.refuse_loose_links(x, self.numbers)
                x[images.atoms] -= shifts
                if len(plan.pinned):
                    x[plan.pinned] = plan.pinned_targets(targets)  # without the rounding of there and back
        except KconsError as error:
            tried = x.copy() if images is not None else x
            if saved is not None:
                np.copyto(x, saved[0])
                if velocities is not None and saved[1] is not None:
                    np.copyto(velocities, saved[1])
            if isinstance(error, ConvergenceError):
                # Atoms that have reached half the cell are the cause, and no step size a remedy.
                rows.refuse_loose_links(tried, self.numbers)
            raise
        if multipliers is not None:
            self._collect(found, multipliers)

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        time: float,
        multipliers: FloatArray | None,
        what: str,
    ) -> None:
        """A y = rates at `x`, in place; `what` y is, for messages."""
        plan = self.plan
        lattice = self.rows.lattice
        saved = y.copy() if self._several else None
        if len(plan.pinned):
            y[plan.pinned] = 0.0 if rates is None else rates[plan.pinned_rows].reshape(-1, 3)
            if plan.loose is not None:
                try:
                    plan.check_loose_rates(x, y, rates, time, what)
                except KconsError:
                    if saved is not None:
                        np.copyto(y, saved)
                    raise
        found: list[FloatArray | None] = []
        moved: FloatArray | None = None
        if lattice is not None:
            places = None if self._placed is None else x[self._placed]
            x = self.rows.whole(x)
            moved = None if places is None else self.rows.moved_places(places, x)
        request = tuple.__new__(Request, (y, x, rates, lattice, time, time, None, 0.0, False, moved))
        for k, solver in enumerate(plan.solvers):
            lam = None if multipliers is None else np.empty(len(solver.rows))
            outcome = solver.tangents(request if lattice is None else plan.asked_of(k, request), lam)
            if not outcome.converged:
                if saved is not None:
                    np.copyto(y, saved)
                raise self.failures.tangents(x, y, outcome, solver, what)
            found.append(lam)
        if multipliers is not None:
            self._collect(found, multipliers)

    def _collect(self, found: list[FloatArray | None], multipliers: FloatArray) -> None:
        """Multipliers of all solvers by row; 0 for rows that none of them has."""
        if (self.plan.labels < 0).any():
            multipliers[:] = 0.0
        for solver, lam in zip(self.plan.solvers, found, strict=True):
            multipliers[solver.rows] = lam

    def rates(self, x: FloatArray, time: float) -> FloatArray | None:
        """c of A v = c at local positions; None if it is 0."""
        return self.rows.velocity_target(x, time) if self.plan.driven else None

    def nearest(self, x: FloatArray, time: float, budget: IterationBudget) -> float:
        """Bring `x` to the nearest point on the constraints in the mass metric, in place, for no more than `budget`.

        What it returns is said at `FarStart.restore`.
        """
        if len(self.plan.pinned):
            x[self.plan.pinned] = self.plan.pinned_targets(self.rows.target(time) if self._moving else None)
        self._fallback.budget = budget
        try:
            return FarStart(self, budget, time).restore(x)
        finally:
            self._fallback.budget = None
