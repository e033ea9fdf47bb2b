"""Peers that are no host: other people's solvers and integrators, each as a method of `kcons compare`.

The packages are optional and imported when a run starts; what is not installed is refused with what to install.
"""

from __future__ import annotations

from kcons.comparison.methods.method import Method
from kcons.comparison.methods.peers.dae import dae_methods
from kcons.comparison.methods.peers.lammps_shake import lammps_methods
from kcons.comparison.methods.peers.mici_leapfrog import mici_methods
from kcons.comparison.methods.peers.shake import shake_methods

PEERS: tuple[Method, ...] = (*shake_methods(), *lammps_methods(), *mici_methods(), *dae_methods())
