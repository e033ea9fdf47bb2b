"""What to tell the user where a solve failed."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InfeasibleError, InputError, KconsError, SingularGeometryError
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import ClusterSolver, Outcome, Request
from kcons.solvers.tolerances import ROUNDING


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
