"""What to tell the user where a solve failed."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import minimum_image
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InfeasibleError, InputError, KconsError, SingularGeometryError
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import ClusterSolver, Outcome, Request

#: Equal parts of a displacement, one after another, that tell one that is too long from one that nothing can follow.
PARTS = 16


class HasRows(Protocol):
    """Anything with global row numbers."""

    rows: IntArray


def _named(numbers: IntArray | None, atoms: IntArray) -> list[int]:
    return [int(a) for a in (atoms if numbers is None else numbers[atoms])]


def not_finite(
    constraint_set: ConstraintSet, numbers: IntArray | None, arrays: dict[str, FloatArray]
) -> KconsError | None:
    """The error for a NaN or infinity at an atom that a row touches; None if there is none."""
    touched = constraint_set.touched
    for item, array in arrays.items():
        bad = ~np.isfinite(array[touched]).all(axis=1)
        if bad.any():
            atom = int(touched[np.argmax(bad)])
            (number,) = _named(numbers, np.array([atom]))
            return InputError(f"{item} of atom {number} is not finite: {array[atom]}", item=item, atoms=[number])
    return None


def _row_label(constraint_set: ConstraintSet, numbers: IntArray | None, row: int) -> tuple[str, list[int]]:
    item, k = constraint_set.locate(row)
    atoms = _named(numbers, item.atoms[k])
    shown = ", ".join(str(a) for a in atoms[:6]) + (", ..." if len(atoms) > 6 else "")
    return f"#{row} {item.family}({shown})", atoms


def _global_row(outcome: Outcome, solver: HasRows) -> int:
    return int(solver.rows[outcome.worst_row]) if outcome.worst_row >= 0 else -1


def unusable(
    constraint_set: ConstraintSet,
    numbers: IntArray | None,
    arrays: dict[str, FloatArray],
    outcome: Outcome,
    solver: HasRows,
) -> KconsError | None:
    """The error for input that no solver can work on: NaN or infinity, coincident atoms; None if it is sound."""
    error = not_finite(constraint_set, numbers, arrays)
    row = _global_row(outcome, solver)
    if error is not None or row < 0:
        return error
    return _coincident(constraint_set, numbers, list(arrays.values())[-1], row)


def _coincident(constraint_set: ConstraintSet, numbers: IntArray | None, x: FloatArray, row: int) -> KconsError | None:
    item, k = constraint_set.locate(row)
    if not item.holds_length:
        return None
    r = constraint_set.gather(item.select([k]), x)[0]
    if np.linalg.norm(r[1] - r[0]) > 0:
        return None
    i, j = _named(numbers, item.atoms[k])
    return SingularGeometryError(
        f"atoms {i} and {j} coincide: distance gradient undefined; move them apart", rows=[row], atoms=[i, j]
    )


def undefined_row(
    constraint_set: ConstraintSet, numbers: IntArray | None, arrays: dict[str, FloatArray], row: int
) -> KconsError:
    """The error for a right-hand side b that is not finite; the last of `arrays` holds positions."""
    error = not_finite(constraint_set, numbers, arrays)
    if error is None:
        error = _coincident(constraint_set, numbers, list(arrays.values())[-1], row)
    name, atoms = _row_label(constraint_set, numbers, row)
    return error or SingularGeometryError(
        f"the curvature of row {name} is undefined at these positions", rows=[row], atoms=atoms
    )


def positions_failed(
    constraint_set: ConstraintSet,
    numbers: IntArray | None,
    request: Request,
    outcome: Outcome,
    solver: ClusterSolver,
    plan: Plan,
) -> KconsError:
    """The error for a position projection without solution; `request` as it was given to `solver`."""
    row = _global_row(outcome, solver)
    if row < 0:
        return ConvergenceError("the position projection did not converge", residual=outcome.residual)
    name, atoms = _row_label(constraint_set, numbers, row)
    rows = np.flatnonzero(plan.labels == plan.labels[row])
    straight = _becomes_straight(constraint_set, numbers, request, solver, rows)
    return ConvergenceError(
        f"no positions near the given ones fulfil row {name}: relative residual {outcome.residual:.3g} after "
        f"{outcome.iterations} iterations. "
        + (
            straight
            or "The displacement is too large for this geometry; use a smaller time step (or optimiser step), or "
            "restore_positions for a start that is far off"
        ),
        residual=outcome.residual,
        tolerance=1e-14,
        iterations=outcome.iterations,
        row=row,
        atoms=atoms,
        cluster=int(plan.labels[row]),
        singular=bool(straight),
    )


def _becomes_straight(
    constraint_set: ConstraintSet, numbers: IntArray | None, request: Request, solver: ClusterSolver, rows: IntArray
) -> str:
    """What to say where a held dihedral among `rows` loses its meaning, with any time step; '' if none does."""
    here, ahead = request.reference, request.changed
    if not _straightened(constraint_set, numbers, here, ahead, rows):
        return ""
    # As a free flight in small steps: where these pass, the dihedral is not the cause.
    start, step = request.reference_time, minimum_image(ahead - here, request.lattice) / PARTS
    for part in range(1, PARTS + 1):
        time = start + part / PARTS * (request.time - start)
        wanted = None if request.wanted is None else constraint_set.target(time)
        ahead = here + step
        small = Request(ahead, here, wanted, request.lattice, time, start, moved=request.moved)
        if not solver.positions(small).converged:
            return _straightened(constraint_set, numbers, here, ahead, rows)
        here, step = ahead, ahead - here
    return ""


def _straightened(
    constraint_set: ConstraintSet, numbers: IntArray | None, before: FloatArray, after: FloatArray, rows: IntArray
) -> str:
    """What to say of three atoms of a held dihedral that pass through one line from `before` to `after`, or ''."""
    least, found = np.inf, ""
    for row in rows.tolist():
        item, k = constraint_set.locate(row)
        if item.family != "Dihedral":
            continue
        legs, then = (np.diff(constraint_set.gather(item.select([k]), x)[0], axis=0) for x in (before, after))
        for first in (0, 1):
            side = _beside(legs[first], legs[first + 1])
            bend = float(np.arctan2(np.linalg.norm(side), abs(legs[first] @ legs[first + 1])))
            if side @ _beside(then[first], then[first + 1]) <= 0.0 and bend < least:
                least, three = bend, ", ".join(str(a) for a in _named(numbers, item.atoms[k][first : first + 3]))
                found = (
                    f"Atoms {three} of row {_row_label(constraint_set, numbers, row)[0]} come onto one line, "
                    f"{np.degrees(bend):.2g} degrees away, where a dihedral angle is undefined: the motion cannot go "
                    "through it with any time step. Hold their angle too, or leave this dihedral free"
                )
    return found


def _beside(u: FloatArray, w: FloatArray) -> FloatArray:
    """The part of w at right angles to u, times |u|."""
    length = float(np.linalg.norm(u))
    return length * w - (w @ u / length) * u if length > 0 else u


def tangents_failed(
    constraint_set: ConstraintSet,
    numbers: IntArray | None,
    x: FloatArray,
    y: FloatArray,
    outcome: Outcome,
    solver: HasRows,
    what: str,
    plan: Plan,
) -> KconsError:
    """The error for a velocity or force projection without solution."""
    error = unusable(constraint_set, numbers, {what: y, "position": x}, outcome, solver)
    if error is not None:
        return error
    row = _global_row(outcome, solver)
    if row < 0:
        return ConvergenceError(f"the {what} projection did not converge", residual=outcome.residual)
    name, atoms = _row_label(constraint_set, numbers, row)
    return ConvergenceError(
        f"the {what} projection leaves a residual of {outcome.residual:.3g} in row {name}: the rows contradict "
        "each other at these positions (A A+ b differs from b), or a gradient is undefined there. Remove or change "
        "one of the rows, or move its atoms off the singular point",
        residual=outcome.residual,
        iterations=outcome.iterations,
        row=row,
        atoms=atoms,
        cluster=int(plan.labels[row]),
    )


def restore_failed(
    constraint_set: ConstraintSet,
    numbers: IntArray | None,
    x: FloatArray,
    start: FloatArray,
    outcome: Outcome,
    solver: HasRows,
    time: float,
) -> KconsError:
    """The error for start positions that cannot be brought onto the constraints."""
    error = unusable(constraint_set, numbers, {"positions": start}, outcome, solver)
    if error is not None:
        return error
    row = _global_row(outcome, solver)
    name, atoms = _row_label(constraint_set, numbers, row)
    sum_of_squares = float(np.sum(constraint_set.value(x, time) ** 2))
    return InfeasibleError(
        f"infeasible: residual cannot go below {sum_of_squares:.6g} (sum of squares) from these positions; "
        f"worst row {name}. Check its target against its neighbours', or start nearer to a solution",
        residual=outcome.residual,
        iterations=outcome.iterations,
        row=row,
        atoms=atoms,
    )
