"""Topologies of the systems of a TorchSim state: elements and positions; bonds are given or guessed."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch_sim import SimState

from kcons.constraints.arguments import check_pairs
from kcons.constraints.constraint import IntArray
from kcons.topology.topology import Snapshot, Topology, sorted_pairs

#: By atomic number.
SYMBOLS = np.array(
    ["", *"""
    H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb Mo Tc
    Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi
    Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og
    """.split()]
)  # fmt: skip


def starts_of(state: SimState) -> IntArray:
    """The first atom of each system, and the number of all atoms, shape (n_systems + 1,)."""
    sizes = state.n_atoms_per_system.cpu().numpy()
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


def snapshot_of(state: SimState, system: int, bonds: Any = None) -> Snapshot:
    """Topology and positions of one system in double precision; its atoms are numbered from 0."""
    start, end = starts_of(state)[system : system + 2].tolist()
    n = end - start
    symbols = SYMBOLS[array_of(state.atomic_numbers[start:end]).astype(np.int64)]
    pairs = np.zeros((0, 2), np.int64) if bonds is None else check_pairs(bonds, n)
    topology = Topology(
        names=symbols,
        elements=symbols,
        masses=array_of(state.masses[start:end]),
        residues=np.zeros(n, np.int64),
        residue_names=np.array([""]),
        residue_ids=np.array(["1"]),
        chains=np.array([""]),
        bonds=sorted_pairs(pairs),
        residues_known=False,
    )
    pbc = state.pbc.cpu().numpy()
    cell = array_of(state.row_vector_cell[system]) if pbc.any() else None
    return Snapshot(topology, array_of(state.positions[start:end]), 1.0, cell, pbc, host="TorchSim state")


def array_of(values: torch.Tensor) -> Any:
    """A contiguous copy in double precision."""
    return np.array(values.detach().cpu(), dtype=np.float64, order="C")
