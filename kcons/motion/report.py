"""What is held at given positions, how well, and how well posed it is: condition numbers of clusters.

The condition of a cluster is the largest over the smallest non-zero singular value of its mass-weighted
A M^-1/2 with rows of unit length. Dependent rows do not count: singular values of zero are left out. Forces
and multipliers lose about as many digits as the condition has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import row_norms
from kcons.plan.clusters import fixed_atoms
from kcons.plan.plan import ClusterKind, Plan
from kcons.solvers.rank_revealing import independent, stacks

#: Conversions that a printed report names.
SHOWN = 4
#: Largest cluster, in rows, that goes through dense singular values.
DENSE_ROWS = 300
#: With dependent rows, for which the sparse way has no cheap answer, dense ones go this far.
DENSE_DEPENDENT_ROWS = 1500
#: Numbers in the dense matrices of one portion of clusters.
PORTION = 4_000_000


@dataclass(frozen=True)
class KindReport(ClusterKind):
    """Clusters of one kind at given positions.

    Attributes
    ----------
    condition : float
        Of the worst cluster; NaN where it was not asked for or is out of reach.
    iterations : int
        Newton iterations of the worst cluster in the last position projection; 0 before the first.
    """

    condition: float
    iterations: int


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
        lines.append(f"{'solver':<16}{titles}  for example")
        for k in self.kinds:
            condition = "-" if np.isnan(k.condition) else f"{k.condition:.3g}"
            iterations = k.iterations or "-"
            numbers = f"{k.clusters:>9}{k.rows:>9}{k.rank:>9}{condition:>11}{iterations:>12}"
            lines.append(f"{k.solver:<16}{numbers}  {k.example}")
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
    with np.errstate(divide="ignore", invalid="ignore"):
        found = constraint_set.residuals(x, v, time)
    sigma = np.abs(found.sigma)
    worst = int(np.argmax(sigma / constraint_set.scale)) if len(sigma) else -1
    speed = float("nan")
    if found.rates is not None:
        speed = float(np.max(np.abs(found.rates) / np.where(found.norms > 0, found.norms, 1.0), initial=0.0))
    conditions = [float("nan")] * len(plan.kinds)
    if condition:
        with np.errstate(divide="ignore", invalid="ignore"):
            jacobian = constraint_set.jacobian(x, time)
        movable = np.setdiff1d(constraint_set.touched, fixed_atoms(constraint_set))
        inverse_masses = np.zeros(constraint_set.n_atoms)
        inverse_masses[movable] = 1.0 / constraint_set.masses[movable]
        conditions = [
            worst_condition(jacobian, inverse_masses, solver.rows, plan.labels, deficiency=kind.rows - kind.rank)
            for solver, kind in zip(plan.solvers, plan.kinds, strict=True)
        ]
    kinds = [
        KindReport(**vars(k), condition=ratio, iterations=count)
        for k, ratio, count in zip(plan.kinds, conditions, iterations, strict=True)
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


def worst_condition(
    jacobian: sp.csr_array, inverse_masses: FloatArray, rows: IntArray, labels: IntArray, *, deficiency: int
) -> float:
    """Largest condition among the clusters that `rows` form.

    Parameters
    ----------
    jacobian : csr_array, shape (n_rows, 3 n_atoms)
        A of the whole set.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    rows : ndarray of int
        Whole clusters.
    labels : ndarray of int, shape (n_rows,)
        Cluster of every row of the set.
    deficiency : int
        Rows of these clusters that depend on others.

    Returns
    -------
    float
        NaN where a gradient vanishes, or a cluster is too large for dense algebra and has dependent rows.
    """
    unit = sp.csr_array(jacobian[rows])
    unit.data = unit.data * np.repeat(np.sqrt(inverse_masses), 3)[unit.indices]
    norms = row_norms(unit)
    if not np.all(np.isfinite(norms) & (norms > 0)):
        return float("nan")
    unit.data *= np.repeat(1.0 / norms, np.diff(unit.indptr))
    number = np.unique(labels[rows], return_inverse=True)[1]
    sizes = np.bincount(number)
    dense = (sizes <= (DENSE_DEPENDENT_ROWS if deficiency else DENSE_ROWS))[number]
    if deficiency and not dense.all():
        return float("nan")
    worst = float(np.max([1.0, *(_sparse(unit[number == k]) for k in np.unique(number[~dense]))]))
    small = unit[dense]
    for stack in stacks(small, number[dense], PORTION):
        s = np.linalg.svd(stack.dense(small.data), compute_uv=False)
        smallest = np.min(np.where(independent(s), s, np.inf), axis=1)
        worst = max(worst, float(np.max(s[:, 0] / smallest)))
    return worst


def _sparse(unit: sp.csr_array) -> float:
    """One large cluster of independent rows: Lanczos for both ends of the spectrum of B B^T."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, splu

    gram = sp.csc_array(unit @ unit.T)
    n = gram.shape[0]
    start = np.random.default_rng(0).normal(size=n)
    try:
        factor = splu(gram, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        inverse = LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
        largest = eigsh(gram, k=1, v0=start, tol=1e-4, return_eigenvectors=False)[0]
        slowest = eigsh(inverse, k=1, v0=start, tol=1e-4, return_eigenvectors=False)[0]
    except (RuntimeError, ArpackNoConvergence):  # singular to the last bit
        return float("nan")
    return float(np.sqrt(largest * slowest))
