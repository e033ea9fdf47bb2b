"""Snapshots of few atoms, for the tests of what is derived from topologies."""

from __future__ import annotations

import numpy as np

from kcons.topology.rows_by_name import Holding, rows_of
from kcons.topology.topology import Snapshot, Topology, sorted_pairs

HOH = np.radians(104.52)
#: O, H, H in angstrom.
WATER = np.array([[0.0, 0.0, 0.0], [0.9572, 0.0, 0.0], [0.9572 * np.cos(HOH), 0.9572 * np.sin(HOH), 0.0]])


def snapshot(
    elements,
    positions,
    bonds=(),
    *,
    names=None,
    residues=None,
    residue_names=("MOL",),
    masses=None,
    cell=None,
    **options,
):
    """A snapshot of few atoms, in angstrom."""
    elements = np.array(elements)
    weights = {"H": 1.008, "C": 12.011, "N": 14.007, "O": 15.999, "": 0.0, "Na": 22.99, "S": 32.06, "Zn": 65.4}
    n = len(elements)
    count = len(residue_names)
    return Snapshot(
        Topology(
            names=np.array(names if names is not None else elements),
            elements=elements,
            masses=np.array(masses if masses is not None else [weights[e] for e in elements.tolist()], dtype=float),
            residues=np.array(residues if residues is not None else [0] * n),
            residue_names=np.array(residue_names),
            residue_ids=np.arange(1, count + 1).astype(str),
            chains=np.full(count, ""),
            bonds=sorted_pairs(bonds),
        ),
        np.array(positions, dtype=float),
        cell=None if cell is None else np.array(cell, dtype=float),
        pbc=np.full(3, cell is not None),
        **options,
    )


def held_rows(made, constrain="hbonds", remedy="give a topology with bonds", **options):
    return rows_of(made, Holding(constrain, **options), np.asarray, remedy)


def rotations(count, seed=0):
    """Random rotations, shape (count, 3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    q[:, :, 0] *= np.sign(np.linalg.det(q))[:, None]
    return q
