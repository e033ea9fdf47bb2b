"""All solvers of a plan, one after another on local arrays; if one of them fails, nothing is changed."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, KconsError
from kcons.motion.failures import Failures, global_row
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import ClusterSolver, Outcome, Request, resume
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.tolerances import MANY_ITERATIONS

#: Largest cluster, in rows, that dense damped Newton rescues.
RESCUE_ROWS = 400
#: Rescues of single clusters by the damped solver within one call, before the call fails.
MAX_RESCUES = 20
#: Newton iterations that one restoration may take in all; where algebra is dense, fewer by the square of the rows of a
#: cluster above the second number. The third is what a projection that fails is charged, and the fourth how many
#: clusters the damped solver may try.
MOST_ITERATIONS, SMALL_CLUSTER, FAILED, RESCUED = 600, 25, 40, 4


class IterationBudget:
    """What is left of the Newton iterations and rescues that one restoration may take.

    Parameters
    ----------
    plan : Plan
        Its largest clusters say what an iteration costs.
    """

    def __init__(self, plan: Plan) -> None:
        def share(rows: IntArray) -> float:
            return 1.0 / max(1.0, int(np.bincount(plan.labels[rows]).max(initial=1)) / SMALL_CLUSTER) ** 2

        dense = [share(solver.rows) for solver in plan.solvers if isinstance(solver, GeneralClusters)]
        self.iterations = max(int(MOST_ITERATIONS * min(dense, default=1.0)), 2 * FAILED)
        self.rescues = max(int(RESCUED * share(np.flatnonzero(plan.labels >= 0))), 1)


class DampedFallback:
    """Damped Newton for single clusters on which their own solver did not converge; made when first needed."""

    def __init__(self, rows: ConstraintSet, plan: Plan, failures: Failures) -> None:
        self._rows, self._plan, self._failures = rows, plan, failures
        self._made: dict[int, GeneralClusters | None] = {}
        #: Set during restorations, which try many projections and may do without some of them.
        self.budget: IterationBudget | None = None

    def solve(
        self, solver: ClusterSolver, outcome: Outcome, request: Request, multipliers: FloatArray | None
    ) -> Outcome:
        """Do what `solver` failed at, or raise what says why there is no way.

        Raises
        ------
        ConvergenceError, InputError, SingularGeometryError
            Positions and velocities are as they were.
        """
        x, reference, velocities = request.changed, request.reference, request.velocities
        saved = x.copy(), None if velocities is None else velocities.copy()
        error = self._failures.unusable(global_row(outcome, solver), x_new=x, x_ref=reference)
        if self.budget is not None:
            self.budget.rescues -= 1
        if error is None and (self.budget is None or self.budget.rescues >= 0):
            outcome = self._damped(solver, outcome, request, multipliers)
            if outcome.converged:
                return outcome
        np.copyto(x, saved[0])
        if velocities is not None and saved[1] is not None:
            np.copyto(velocities, saved[1])
        raise error or self._failures.positions(request, outcome, solver)

    def _damped(
        self, solver: ClusterSolver, outcome: Outcome, request: Request, multipliers: FloatArray | None
    ) -> Outcome:
        """Solve the failing clusters by damped Newton, then let the fast solver go on from there."""
        extra = np.zeros(self._rows.n_rows)
        for _ in range(MAX_RESCUES):
            if outcome.worst_row < 0:
                return outcome
            row = int(solver.rows[outcome.worst_row])
            damped = self._solver(row)
            if damped is None:
                return outcome
            part = np.zeros(len(damped.rows))
            found = damped.positions(request, part)
            if not found.converged:
                where = int(damped.rows[found.worst_row]) if found.worst_row >= 0 else row
                index = np.flatnonzero(solver.rows == where)
                return found._replace(worst_row=int(index[0]) if len(index) else outcome.worst_row)
            extra[damped.rows] += part
            outcome = solver.positions(request, multipliers)
            if outcome.converged:
                if multipliers is not None:
                    multipliers += extra[solver.rows]
                return outcome._replace(iterations=outcome.iterations + found.iterations)
        return outcome

    def _solver(self, row: int) -> GeneralClusters | None:
        """A solver with step control for the cluster of `row`; None if it is too large for dense algebra."""
        plan = self._plan
        label = int(plan.labels[row])
        if label not in self._made:
            rows = np.flatnonzero(plan.labels == label)
            self._made[label] = None
            if len(rows) <= RESCUE_ROWS:
                labels = np.zeros(len(rows), dtype=np.int64)
                self._made[label] = GeneralClusters(self._rows, rows, labels, plan.inverse_masses)
        return self._made[label]


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
    fallback : DampedFallback
        Of single clusters whose own solver fails.
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
        self.fallback = DampedFallback(rows, plan, self.failures)

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
                if plan.between_fixed_atoms is not None:
                    plan.check_rows_between_fixed_atoms(x, time)
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
                    outcome = self.fallback.solve(solver, outcome, asked, lam)
                if outcome.iterations > MANY_ITERATIONS:
                    # A far start leaves the rounding of its size; once more from the near end removes it.
                    resume(solver.positions, asked, lam)
                self.iterations[k] = outcome.iterations
                found.append(lam)
            if images is not None:
                rows.refuse_unheld_links(x, self.numbers)
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
                rows.refuse_unheld_links(tried, self.numbers)
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
            if plan.between_fixed_atoms is not None:
                try:
                    plan.check_rates_between_fixed_atoms(x, y, rates, time, what)
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
