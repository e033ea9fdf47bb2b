"""The table: which solver serves which shape."""

from __future__ import annotations

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.target import FloatArray
from kcons.plan.clusters import Shape
from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.cluster_solver import ClusterSolver
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.rigid_triangles import RigidTriangles
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.small_clusters import SmallClusters
from kcons.solvers.sparse.distances import SparseDistances
from kcons.solvers.sparse.mixed_rows import SparseRows


def solver_of(
    shape: Shape,
    constraint_set: ConstraintSet,
    inverse_masses: FloatArray,
    labels: IntArray,
    time: float,
    late: BoolArray | None = None,
) -> ClusterSolver:
    """The table: which solver serves which shape."""
    rows = shape.rows
    if shape.kind == "general":
        return GeneralClusters(constraint_set, rows, labels[rows], inverse_masses)
    if shape.kind == "single":
        return SingleRows(constraint_set, rows, inverse_masses)
    if shape.kind == "mixed":
        return SparseRows(constraint_set, rows, inverse_masses, None if late is None else late[rows])
    targets = constraint_set.target(time)[rows]
    if shape.kind == "water":
        return RigidTriangles(rows, shape.atoms, targets, inverse_masses[shape.atoms[0]])
    if shape.kind == "lanes":
        return SmallClusters(rows, shape.atoms, shape.pairs, targets, inverse_masses[shape.atoms[0]])
    if shape.kind == "chain":
        return Chains(rows, shape.starts, shape.atoms, targets, inverse_masses[shape.atoms])
    return SparseDistances(rows, shape.pairs, targets, inverse_masses, None if late is None else late[rows])
