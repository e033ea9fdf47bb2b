"""Clusters of rows, and the table that picks each one's solver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.target import FloatArray
from kcons.errors import ContradictionError
from kcons.plan.clusters import Shape, classify, cluster_labels, fixed_rows
from kcons.plan.second_order import Blocks
from kcons.solvers.chains import Chains
from kcons.solvers.cluster_solver import ClusterSolver, Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.rank_revealing import independent, independent_rows, rank
from kcons.solvers.rigid_triangles import RigidTriangles
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.small_clusters import SmallClusters
from kcons.solvers.sparse.distances import SparseDistances
from kcons.solvers.sparse.mixed_rows import SparseRows

#: Largest cluster, in rows, whose multipliers of least norm are found by dense algebra.
DENSE_ROWS = 1500
#: Largest cluster, in rows, in which dependent rows are looked for one by one, to be eliminated last.
ORDERED_ROWS = 400
#: Rows of clusters of one kind among which that is done.
ORDERED_IN_ALL = 20_000


@dataclass(frozen=True)
class ClusterKind:
    """One line of the plan: clusters of the same kind and their solver; `example` is the name of one row."""

    solver: str
    clusters: int
    rows: int
    rank: int
    example: str


@dataclass
class Plan:
    """Who solves what.

    Attributes
    ----------
    constraint_set : ConstraintSet
        What the solvers work on.
    named : ConstraintSet
        The same rows with the atom numbers that the user knows, for messages.
    solvers : list of ClusterSolver
    labels : ndarray of int, shape (n_rows,)
        Cluster of each row; -1 for rows that hold fixed atoms or lie between fixed atoms only.
    pinned, pinned_rows : ndarray of int
        Fixed atoms and their rows, three an atom.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    rank : int
        Independent rows, those of fixed atoms included.
    driven : bool
        Whether admissible velocities solve A v = c with c other than 0.
    kinds : list of ClusterKind
    dependent : list of ndarray of int
        Rows of each cluster in which rows may depend on each other.
    resting : tuple of ndarray of int, of positions and of time, or None
        Rows between fixed atoms, and the set-up.
    eliminate_last : ndarray of bool, shape (n_rows,)
        Rows that depend on others of their cluster, eliminated after these.
    whole : list of bool
        For each solver, whether it takes positions that were made whole, without a cell (see `periodic.images`).
    """

    constraint_set: ConstraintSet
    named: ConstraintSet
    solvers: list[ClusterSolver]
    labels: IntArray
    pinned: IntArray
    pinned_rows: IntArray
    inverse_masses: FloatArray
    rank: int
    driven: bool
    kinds: list[ClusterKind] = field(default_factory=list)
    dependent: list[IntArray] = field(default_factory=list)
    resting: tuple[IntArray, FloatArray, float] | None = None
    whole: list[bool] = field(default_factory=list)
    eliminate_last: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))
    _places: FloatArray | None = None

    def asked_of(self, solver: int, request: Request) -> Request:
        """What a solver is asked: no cell where positions come whole and every image is as they say."""
        return request._replace(lattice=None) if self.whole[solver] else request

    def pinned_targets(self, targets: FloatArray | None) -> FloatArray:
        """Where fixed atoms are held, shape (len(pinned), 3)."""
        if targets is not None:
            return targets[self.pinned_rows].reshape(-1, 3)
        if self._places is None:
            self._places = self.constraint_set.target(0.0)[self.pinned_rows].reshape(-1, 3)
        return self._places

    def check_cell(self) -> None:
        """Raise `ContradictionError` for rows between fixed atoms that are off in this cell, or that move."""
        if self.resting is None:
            return
        rows, x, time = self.resting
        held = self.constraint_set
        moves = np.concatenate([np.full(item.n_rows, item.moving) for item in held.constraints])
        carried = np.zeros(held.n_atoms)
        carried[self.pinned] = moves[self.pinned_rows[::3]]
        with np.errstate(invalid="ignore"):
            found = held.residuals(x, None, time)
        miss = np.maximum(np.abs(found.sigma), np.abs(held.velocity_target(x, time)))
        moving = moves[rows] | (held.incidence[rows] @ carried > 0)
        bad = np.flatnonzero(moving | ~(miss[rows] <= found.allowed[rows]))
        if len(bad):
            row = int(rows[bad[0]])
            name, atoms = self.named.row_name(row), self.named.row_atoms(row)
            said = "moves;" if moving[bad[0]] else f"is off by {miss[row]:g}; fix them where it holds,"
            message = f"row {name} lies between fixed atoms and {said} remove it or free one of its atoms"
            raise ContradictionError(message, rows=[row], atoms=atoms)

    def least_norm(self, x: FloatArray, lam: FloatArray, time: float) -> FloatArray:
        """Multipliers of least norm with the same constraint force, where rows depend on each other."""
        if not self.dependent:
            return lam
        jacobian = self.constraint_set.jacobian(x, time)
        movable = np.repeat(self.inverse_masses > 0, 3)
        for rows in self.dependent:
            part = jacobian[rows]
            transposed = part.T.tocsr()
            used = np.flatnonzero((np.diff(transposed.indptr) > 0) & movable)
            transposed = transposed[used]
            if len(rows) <= DENSE_ROWS:
                # What no force shows: the combinations of unit rows that vanish, in the units of the rows.
                dense = np.zeros((max(transposed.shape), len(rows)))
                dense[: transposed.shape[0]] = transposed.toarray()
                size = np.linalg.norm(dense, axis=0)
                size[size == 0] = 1.0
                singular, directions = np.linalg.svd(dense / size, full_matrices=False)[1:]
                hidden = directions[int(independent(singular).sum()) :].T
                hidden = np.where(np.abs(hidden) > 1e-12, hidden, 0.0) / size[:, None]
                lam[rows] -= hidden @ np.linalg.lstsq(hidden, lam[rows], rcond=None)[0]
            else:
                force = transposed @ lam[rows]
                from scipy.sparse.linalg import lsqr  # slow to import, rarely needed

                lam[rows] = lsqr(transposed, force, atol=1e-15, btol=1e-15, iter_lim=20 * len(rows))[0]
        return lam


def make_plan(
    constraint_set: ConstraintSet, positions: FloatArray, time: float, named: ConstraintSet | None = None
) -> Plan:
    """Find the clusters, their rank, and a solver for each.

    `named` has the same rows on the atom numbers of the whole system, for messages.
    """
    named = constraint_set if named is None else named
    pinned, pinned_rows = fixed_rows(constraint_set)
    inverse_masses = np.zeros(constraint_set.n_atoms)
    touched = constraint_set.touched
    inverse_masses[touched] = 1.0
    with np.errstate(divide="ignore"):
        inverse_masses[touched] /= constraint_set.masses[touched]
    inverse_masses[pinned] = 0.0
    labels = cluster_labels(constraint_set, pinned)
    driven = constraint_set.moving or not bool(constraint_set.holonomic.all())
    plan = Plan(constraint_set, named, [], labels, pinned, pinned_rows, inverse_masses, len(pinned_rows), driven)
    plan.eliminate_last = np.zeros(constraint_set.n_rows, np.bool_)
    loose = labels < 0
    loose[pinned_rows] = False
    if loose.any():
        in_place = positions.copy()
        in_place[pinned] = plan.pinned_targets(constraint_set.target(time))
        plan.resting = np.flatnonzero(loose), in_place, time
        plan.check_cell()
    whole_positions, placed = constraint_set.whole(positions), constraint_set.placed
    moved = None if placed is None else constraint_set.moved_places(positions[placed], whole_positions)
    here = Request(np.zeros_like(positions), whole_positions, None, constraint_set.lattice, time, moved=moved)
    for shape, whole in _shapes(constraint_set, labels, inverse_masses):
        solver, rank = _solver(plan, shape, time), shape.rows.size
        if not shape.independent:
            rank = _rank(plan, shape, solver, positions, here._replace(lattice=None) if whole else here)
        if shape.kind == "SingleRows" and rank < shape.rows.size:
            shape = replace(shape, kind="SparseRows")
        alone = shape.independent or shape.kind == "SingleRows"
        sparse = shape.kind in ("SparseDistances", "SparseRows")
        asked = not alone and (sparse or rank < shape.rows.size)
        clusters = _by_cluster(shape.rows.ravel(), labels) if asked else []
        sizes = [len(rows) for rows in clusters] or [0]
        if asked and max(sizes) <= ORDERED_ROWS and sum(sizes) <= ORDERED_IN_ALL:
            found = _mark_dependent_rows(plan, clusters, positions, time)
            if rank < found and shape.kind == "SparseRows":
                # Rows so nearly parallel that elimination, which sees squares, takes them for dependent.
                solver = GeneralClusters(constraint_set, shape.rows, labels[shape.rows], inverse_masses)
            # The pivots of an order that knows nothing of dependence say less.
            rank = found if sparse else rank
        if rank < shape.rows.size:
            plan.dependent += clusters
            if shape.kind in ("RigidTriangles", "SmallClusters"):
                # The lanes have no cut for dependent rows; sparse elimination has.
                flat = shape.rows.ravel()
                ends = shape.atoms[:, shape.pairs].reshape(-1, 2)
                shape = Shape("SparseDistances", flat, shape.clusters, False, pairs=ends)
            if not isinstance(solver, GeneralClusters):
                solver = _solver(plan, shape, time)
        plan.solvers.append(solver)
        plan.whole.append(whole and not (isinstance(solver, GeneralClusters) and solver.winds))
        plan.rank += rank
        numbers = shape.clusters, shape.rows.size, rank
        plan.kinds.append(ClusterKind(solver.name, *numbers, named.row_name(int(shape.rows.ravel()[0]))))
    return plan


def _solver(plan: Plan, shape: Shape, time: float) -> ClusterSolver:
    """The table: which solver serves which shape."""
    rows, inverse_masses = shape.rows, plan.inverse_masses
    if shape.kind == "GeneralClusters":
        return GeneralClusters(plan.constraint_set, rows, plan.labels[rows], inverse_masses)
    if shape.kind == "SingleRows":
        return SingleRows(plan.constraint_set, rows, inverse_masses)
    if shape.kind == "SparseRows":
        return SparseRows(plan.constraint_set, rows, inverse_masses, plan.eliminate_last[rows])
    targets = plan.constraint_set.target(time)[rows]
    if shape.kind == "RigidTriangles":
        return RigidTriangles(rows, shape.atoms, targets, inverse_masses[shape.atoms[0]])
    if shape.kind == "SmallClusters":
        return SmallClusters(rows, shape.atoms, shape.pairs, targets, inverse_masses[shape.atoms[0]])
    if shape.kind == "Chains":
        return Chains(rows, shape.starts, shape.atoms, targets, inverse_masses[shape.atoms])
    return SparseDistances(rows, shape.pairs, targets, inverse_masses, plan.eliminate_last[rows])


def _shapes(
    constraint_set: ConstraintSet, labels: IntArray, inverse_masses: FloatArray
) -> Iterator[tuple[Shape, bool]]:
    """The shapes of clusters, and whether these have whole rows: such clusters have solvers of their own."""
    marks = [np.zeros(c.n_rows, bool) if c.whole is None else c.whole for c in constraint_set.constraints]
    whole_rows = np.concatenate([*marks, np.zeros(0, bool)]) & (labels >= 0)
    wholes = np.zeros(int(labels.max(initial=-1)) + 1, bool)
    wholes[labels[whole_rows]] = True
    for kind in (False, True):
        number = np.where(wholes == kind, np.cumsum(wholes == kind) - 1, -1)
        chosen = np.append(number, -1)[labels]
        for shape in classify(constraint_set, chosen, inverse_masses):
            yield shape, kind


def _rank(plan: Plan, shape: Shape, solver: ClusterSolver, positions: FloatArray, here: Request) -> int:
    """Independent rows at `positions`: of many small clusters at once, of others as their solver sees them `here`."""
    if shape.rows.ndim == 1:
        return solver.rank(here)
    unit = Blocks(plan.constraint_set, here.time, shape.rows, shape.atoms, plan.pinned).dense(positions)[0]
    return rank(np.nan_to_num(unit) * np.repeat(np.sqrt(plan.inverse_masses[shape.atoms[0]]), 3))


def _mark_dependent_rows(plan: Plan, clusters: list[IntArray], positions: FloatArray, time: float) -> int:
    """Independent rows of small clusters; marks those that the best conditioned rows leave over."""
    jacobian = plan.constraint_set.jacobian(positions, time)
    jacobian.data *= np.repeat(np.sqrt(plan.inverse_masses), 3)[jacobian.indices]
    for rows in clusters:
        part = jacobian[rows]
        plan.eliminate_last[rows] = ~independent_rows(part[:, np.unique(part.indices)].toarray())
    return sum(int(np.sum(~plan.eliminate_last[rows])) for rows in clusters)


def _by_cluster(rows: IntArray, labels: IntArray) -> list[IntArray]:
    rows = np.sort(rows)
    order = np.argsort(labels[rows], kind="stable")
    cuts = np.flatnonzero(np.diff(labels[rows[order]])) + 1
    return [np.sort(part) for part in np.split(rows[order], cuts)]
