"""Constraint solvers, one shape of cluster each; the Numba kernels live here.

- `kernels`: what compiled kernels are made of
- `cluster_solver`: the contract of a solver, and what it reports
- `rigid_triangles`, `small_clusters`, `chains`, `sparse`: held distances by shape, and rows of mixed kinds
- `distance_clusters`: held distances of every shape behind one contract
- `general_clusters`: any rows whatever
- `fused_distances`: distances of every shape in one call
"""

from kcons.solvers.distance_clusters import DistanceClusters
from kcons.solvers.sparse.distances import SparseDistances

__all__ = ["DistanceClusters", "SparseDistances"]
