"""Solvers and integrators of others, each a method of `kcons compare` by `add_method`; what is not installed refuses.

- `smallness`: what solvers with dense matrices can run
- `gauss_seidel`, `shake`: SHAKE and RATTLE as the literature has them
- `lammps_shake`: LAMMPS' fix shake and fix rattle
- `mici_leapfrog`: mici's constrained leapfrog
- `dae`: solvers of differential-algebraic equations
"""

from __future__ import annotations

from peers import dae, lammps_shake, mici_leapfrog, shake


def add_all() -> None:
    """Register the methods of all modules."""
    for module in (shake, lammps_shake, mici_leapfrog, dae):
        module.add()
