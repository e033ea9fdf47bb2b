"""All solvers of a plan, one after another on local arrays; if one of them fails, nothing is changed."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InfeasibleError, InputError, KconsError, SingularGeometryError
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import ClusterSolver, Outcome, Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.tolerances import MANY_ITERATIONS, ROUNDING

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
            if images is not None and lattice is not None:
                if self.unchecked is not None:
                    rows.refuse_other_images(ref, self.unchecked, self.numbers)
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
                    more = None if lam is None else np.empty(len(lam))
                    if solver.positions(asked, more).converged and lam is not None and more is not None:
                        lam += more
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
        found: list[FloatArray | None] = []
        moved: FloatArray | None = None
        if lattice is not None and self.rows.images is not None:
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


class Failures:
    """The errors of one plan's solvers.

    Parameters
    ----------
    rows : ConstraintSet
        The rows on local atoms.
    plan : Plan
    numbers : ndarray of int or None
        Global numbers of the local atoms; None where they are the same.
    """

    def __init__(self, rows: ConstraintSet, plan: Plan, numbers: IntArray | None) -> None:
        self._rows, self._plan, self._numbers = rows, plan, numbers

    def _named(self, atoms: IntArray) -> list[int]:
        return [int(a) for a in (atoms if self._numbers is None else self._numbers[atoms])]

    def _label(self, row: int) -> tuple[str, list[int]]:
        item, k = self._rows.locate(row)
        atoms = self._named(item.atoms[k])
        shown = ", ".join(str(a) for a in atoms[:6]) + (", ..." if len(atoms) > 6 else "")
        return f"#{row} {item.family}({shown})", atoms

    def not_finite(self, **arrays: FloatArray) -> KconsError | None:
        """The error for a NaN or infinity at an atom that a row touches; None if there is none."""
        touched = self._rows.touched
        for item, array in arrays.items():
            bad = ~np.isfinite(array[touched]).all(axis=1)
            if bad.any():
                atom = int(touched[np.argmax(bad)])
                (number,) = self._named(np.array([atom]))
                return InputError(f"{item} of atom {number} is not finite: {array[atom]}", item=item, atoms=[number])
        return None

    def unusable(self, row: int, **arrays: FloatArray) -> KconsError | None:
        """The error for input that no solver can work on: NaN or infinity, coincident atoms; None if it is sound.

        `row` is where a solver failed, -1 if that is not known; the last of `arrays` holds positions.
        """
        error = self.not_finite(**arrays)
        if error is not None or row < 0:
            return error
        item, k = self._rows.locate(row)
        if not item.holds_length or np.linalg.norm(self._legs(item, k, list(arrays.values())[-1])) > 0:
            return None
        i, j = self._named(item.atoms[k])
        return SingularGeometryError(
            f"atoms {i} and {j} coincide: distance gradient undefined; move them apart", rows=[row], atoms=[i, j]
        )

    def undefined(self, row: int, **arrays: FloatArray) -> KconsError:
        """The error for a right-hand side b that is not finite; the last of `arrays` holds positions."""
        name, atoms = self._label(row)
        return self.unusable(row, **arrays) or SingularGeometryError(
            f"the curvature of row {name} is undefined at these positions", rows=[row], atoms=atoms
        )

    def positions(self, request: Request, outcome: Outcome, solver: ClusterSolver) -> KconsError:
        """The error for a position projection without solution."""
        row = global_row(outcome, solver)
        if row < 0:
            return ConvergenceError("the position projection did not converge", residual=outcome.residual)
        name, atoms = self._label(row)
        straight = self._straightened(
            request.reference, request.changed, np.flatnonzero(self._plan.labels == self._plan.labels[row])
        )
        return ConvergenceError(
            f"no positions near the given ones fulfil row {name}: relative residual {outcome.residual:.3g} after "
            f"{outcome.iterations} iterations. The displacement is too large for this geometry; use a smaller time "
            f"step (or optimizer step), or restore_positions for a start that is far off{straight}",
            residual=outcome.residual,
            tolerance=ROUNDING,
            iterations=outcome.iterations,
            row=row,
            atoms=atoms,
            cluster=int(self._plan.labels[row]),
        )

    def tangents(self, x: FloatArray, y: FloatArray, outcome: Outcome, solver: ClusterSolver, what: str) -> KconsError:
        """The error for a velocity or force projection without solution."""
        row = global_row(outcome, solver)
        error = self.unusable(row, **{what: y, "position": x})
        if error is not None:
            return error
        if row < 0:
            return ConvergenceError(f"the {what} projection did not converge", residual=outcome.residual)
        name, atoms = self._label(row)
        with np.errstate(all="ignore"):
            undefined = not np.isfinite(self._rows.jacobian(x)[[row]].data).all()
        if undefined:
            return SingularGeometryError(
                f"the gradient of row {name} is undefined at these positions; move its atoms off the singular point",
                rows=[row],
                atoms=atoms,
            )
        return ConvergenceError(
            f"the {what} projection leaves a residual of {outcome.residual:.3g} in row {name}: the rows contradict "
            "each other at these positions (A A+ b differs from b). Remove or change one of the rows",
            residual=outcome.residual,
            iterations=outcome.iterations,
            row=row,
            atoms=atoms,
            cluster=int(self._plan.labels[row]),
        )

    def start(
        self, x: FloatArray, start: FloatArray, row: int, residual: float, iterations: int, time: float
    ) -> KconsError:
        """The error for start positions that cannot be brought onto the constraints; the search ended at `x`."""
        error = self.unusable(row, positions=start)
        if error is not None:
            return error
        name, atoms = self._label(row)
        sum_of_squares = float(np.sum(self._rows.value(x, time) ** 2))
        return InfeasibleError(
            f"infeasible: residual cannot go below {sum_of_squares:.6g} (sum of squares) from these positions; "
            f"worst row {name}. Check its target against its neighbors', or start nearer to a solution",
            residual=residual,
            iterations=iterations,
            row=row,
            atoms=atoms,
        )

    # -- dihedrals that lose their meaning ------------------------------------------------------------------

    def _straightened(self, before: FloatArray, after: FloatArray, rows: IntArray) -> str:
        """What to say of three atoms of a held dihedral that pass through one line from `before` to `after`, or ''."""
        least, found = np.inf, ""
        for row in rows.tolist():
            item, k = self._rows.locate(row)
            if item.family != "Dihedral":
                continue
            legs, then = self._legs(item, k, before), self._legs(item, k, after)
            for first in (0, 1):
                side = _beside(legs[first], legs[first + 1])
                bend = float(np.arctan2(np.linalg.norm(side), abs(legs[first] @ legs[first + 1])))
                if side @ _beside(then[first], then[first + 1]) <= 0.0 and bend < least:
                    least, three = bend, ", ".join(str(a) for a in self._named(item.atoms[k][first : first + 3]))
                    found = (
                        f". Atoms {three} of row {self._label(row)[0]} come onto one line, {np.degrees(bend):.2g} "
                        "degrees away, where a dihedral angle is undefined; if the motion goes through it, no time "
                        "step helps: hold their angle too, or leave this dihedral free"
                    )
        return found

    def _legs(self, item: Constraint, k: int, x: FloatArray) -> FloatArray:
        """Differences of the atoms of row k of an object, one after another."""
        return np.diff(self._rows.gather(item.select([k]), x)[0], axis=0)


def global_row(outcome: Outcome, solver: ClusterSolver) -> int:
    """The worst row by its number in the set; -1 if there is none."""
    return int(solver.rows[outcome.worst_row]) if outcome.worst_row >= 0 else -1


def _beside(u: FloatArray, w: FloatArray) -> FloatArray:
    """The part of w at right angles to u, times |u|."""
    length = float(np.linalg.norm(u))
    return length * w - (w @ u / length) * u if length > 0 else u
