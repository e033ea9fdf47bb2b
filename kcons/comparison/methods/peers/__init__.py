"""Solvers and integrators of others, each as a method of `kcons compare`.

The packages are optional and imported when a run starts.

- `smallness`: what solvers with dense matrices can run
- `gauss_seidel`, `shake`: SHAKE and RATTLE as the literature has them
- `lammps_shake`: LAMMPS' fix shake and fix rattle
- `mici_leapfrog`: mici's constrained leapfrog
- `dae`: solvers of differential-algebraic equations
"""

from __future__ import annotations

from kcons.comparison.methods.method import Method
from kcons.comparison.methods.peers.dae import dae_methods
from kcons.comparison.methods.peers.lammps_shake import lammps_methods
from kcons.comparison.methods.peers.mici_leapfrog import mici_methods
from kcons.comparison.methods.peers.shake import shake_methods

PEERS: tuple[Method, ...] = (*shake_methods(), *lammps_methods(), *mici_methods(), *dae_methods())
