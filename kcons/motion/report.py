"""What to tell the user: why a solve failed, and the report on a healthy set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InfeasibleError, InputError, KconsError, SingularGeometryError
from kcons.motion.condition import worst_condition
from kcons.plan.plan import Plan
from kcons.solvers.cluster_solver import Outcome

#: Conversions that a printed report names.
SHOWN = 4


@dataclass(frozen=True)
class KindReport:
    """Clusters of one kind at given positions.

    Attributes
    ----------
    solver : str
    clusters, rows, rank : int
    condition : float
        Of the worst cluster, see `kcons.motion.condition`; NaN where it was not asked for or is out of reach.
    iterations : int
        Newton iterations of the worst cluster in the last position projection; 0 before the first.
    example : str
        Name of one row.
    """

    solver: str
    clusters: int
    rows: int
    rank: int
    condition: float
    iterations: int
    example: str


@dataclass(frozen=True)
class Report:
    """State of a constraint set at given positions.

    Attributes
    ----------
    rows, rank, degrees_of_freedom : int
    condition : float
        The largest of the clusters' conditions; NaN if one is not known, 1 without clusters.
    residual : float
        max |sigma|, natural units.
    velocity_residual : float
        max |A v - c| with rows scaled to unit norm; NaN without velocities.
    iterations : int
        Newton iterations of the last position projection.
    worst_row : str
        Name of the row with the largest |sigma| for its scale.
    kinds : sequence of KindReport
    conversions : sequence of str
        Straight and flat groups whose rows were singular at second order, and what holds them instead.
    """

    rows: int
    rank: int
    degrees_of_freedom: int
    condition: float
    residual: float
    velocity_residual: float
    iterations: int
    worst_row: str
    kinds: Sequence[KindReport]
    conversions: Sequence[str] = ()

    def __str__(self) -> str:
        lines = [
            f"rows {self.rows}, rank {self.rank}, degrees of freedom {self.degrees_of_freedom}",
            f"max |sigma| {self.residual:.2e} ({self.worst_row})",
        ]
        if not np.isnan(self.velocity_residual):
            lines.append(f"max |A v - c| {self.velocity_residual:.2e}")
        lines += [f"converted: {what}" for what in self.conversions[:SHOWN]]
        if len(self.conversions) > SHOWN:
            lines.append(f"converted: {len(self.conversions) - SHOWN} more groups")
        titles = f"{'clusters':>9}{'rows':>9}{'rank':>9}{'condition':>11}{'iterations':>12}"
        lines.append(f"{'solver':<12}{titles}  for example")
        for k in self.kinds:
            condition = "-" if np.isnan(k.condition) else f"{k.condition:.3g}"
            iterations = k.iterations or "-"
            numbers = f"{k.clusters:>9}{k.rows:>9}{k.rank:>9}{condition:>11}{iterations:>12}"
            lines.append(f"{k.solver:<12}{numbers}  {k.example}")
        return "\n".join(lines)


def make_report(
    constraint_set: ConstraintSet,
    plan: Plan,
    x: FloatArray,
    v: FloatArray | None,
    time: float,
    iterations: Sequence[int],
    *,
    condition: bool = True,
) -> Report:
    """Evaluate the set at `x` (and `v`); `iterations` by solver of the plan."""
    sigma = np.abs(constraint_set.value(x, time))
    worst = int(np.argmax(sigma / constraint_set.scale)) if len(sigma) else -1
    speed = float("nan")
    with np.errstate(divide="ignore", invalid="ignore"):
        jacobian = constraint_set.jacobian(x, time)
    if v is not None:
        norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=1)).ravel())
        miss = np.abs(jacobian @ v.ravel() - constraint_set.velocity_target(x, time))
        speed = float(np.max(miss / np.where(norms > 0, norms, 1.0), initial=0.0))
    conditions = [float("nan")] * len(plan.kinds)
    if condition:
        inverse_masses = _inverse_masses(constraint_set)
        conditions = [
            worst_condition(jacobian, inverse_masses, solver.rows, plan.labels, deficiency=kind.rows - kind.rank)
            for solver, kind in zip(plan.solvers, plan.kinds, strict=True)
        ]
    kinds = [
        KindReport(k.solver, k.clusters, k.rows, k.rank, found, count, k.example)
        for k, found, count in zip(plan.kinds, conditions, iterations, strict=True)
    ]
    return Report(
        rows=constraint_set.n_rows,
        rank=plan.rank,
        degrees_of_freedom=3 * constraint_set.n_moving - plan.rank,
        condition=float(np.max(conditions, initial=1.0)),
        residual=float(np.max(sigma, initial=0.0)),
        velocity_residual=speed,
        iterations=max(iterations, default=0),
        worst_row=constraint_set.row_name(worst) if worst >= 0 else "no rows",
        kinds=kinds,
        conversions=[str(body) for body in constraint_set.conversions],
    )


def _inverse_masses(constraint_set: ConstraintSet) -> FloatArray:
    """1/m of the atoms that rows touch, 0 for fixed atoms, shape (n_atoms,)."""
    fixed = [c.atoms.ravel() for c in constraint_set.constraints if c.family == "FixedAtoms"]
    movable = np.setdiff1d(constraint_set.touched, np.concatenate(fixed)) if fixed else constraint_set.touched
    inverse = np.zeros(constraint_set.n_atoms)
    inverse[movable] = 1.0 / constraint_set.masses[movable]
    return inverse


#: Radians from a straight line below which a held dihedral is named as the cause of a failure.
STRAIGHT = 0.1


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
    if item.family != "Distance":
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
    x_ref: FloatArray,
    outcome: Outcome,
    solver: HasRows,
    plan: Plan,
) -> KconsError:
    """The error for a position projection without solution."""
    row = _global_row(outcome, solver)
    if row < 0:
        return ConvergenceError("the position projection did not converge", residual=outcome.residual)
    name, atoms = _row_label(constraint_set, numbers, row)
    straight = _nearly_straight(constraint_set, numbers, x_ref, np.flatnonzero(plan.labels == plan.labels[row]))
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


def _nearly_straight(constraint_set: ConstraintSet, numbers: IntArray | None, x: FloatArray, rows: IntArray) -> str:
    """What to say where a held dihedral among `rows` is about to lose its meaning; '' if none is."""
    least, found = STRAIGHT, ""
    for row in rows.tolist():
        item, k = constraint_set.locate(row)
        if item.family != "Dihedral":
            continue
        r = constraint_set.gather(item.select([k]), x)[0]
        legs = np.diff(r, axis=0)
        for first in (0, 1):
            u, w = legs[first], legs[first + 1]
            bend = float(np.arctan2(np.linalg.norm(np.cross(u, w)), abs(u @ w)))
            if bend < least:
                least, three = bend, ", ".join(str(a) for a in _named(numbers, item.atoms[k][first : first + 3]))
                found = (
                    f"Atoms {three} of row {_row_label(constraint_set, numbers, row)[0]} are {np.degrees(bend):.2g} "
                    "degrees from one line, where a dihedral angle is undefined: the motion cannot go through it with "
                    "any time step. Hold their angle too, or leave this dihedral free"
                )
    return found


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
