"""Per-cluster solvers: one shape a file; all Numba kernels live here."""
