"""Constraint solvers, one shape of cluster each; the Numba kernels live here.

- `tolerances`: every number of Newton's method and of rank, and why
- `kernels`: what compiled kernels are made of
- `cluster_solver`: the contract of a solver: what it is asked, and what it reports
- `addressable_solvers`: solvers as data, which kernels call by address, alone or several in one call
- `distance_clusters`: what the solvers of held distances share
- `rigid_triangles`, `small_clusters`, `chains`, `sparse`: held distances by shape, and rows of mixed kinds
- `single_rows`: functions that share no atom
- `rank_revealing`: clusters as dense matrices, and which of their rows are independent
- `general_clusters`: any rows whatever
"""

from kcons.solvers.sparse.distances import SparseDistances

__all__ = ["SparseDistances"]
