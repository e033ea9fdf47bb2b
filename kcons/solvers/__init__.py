"""Constraint solvers, one shape of cluster each; the Numba kernels live here.

- `kernels`: what compiled kernels are made of
- `cluster_solver`: the contract of a solver: what it is asked, and what it reports
- `called_solvers`: what those of other rows share, which other kernels call by address
- `distance_clusters`: what the solvers of held distances share
- `rigid_triangles`, `small_clusters`, `chains`, `sparse`: held distances by shape, and rows of mixed kinds
- `single_rows`: functions that share no atom
- `rank_revealing`: which rows are independent
- `general_clusters`: any rows whatever
- `fused_distances`: rows of every shape in one call
"""

from kcons.solvers.distance_clusters import DistanceClusters
from kcons.solvers.sparse.distances import SparseDistances

__all__ = ["DistanceClusters", "SparseDistances"]
