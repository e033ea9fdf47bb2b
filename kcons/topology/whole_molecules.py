"""Groups and molecules of a snapshot made whole across the faces of the cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected, lined_up, make_whole, minimum_image, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.topology.topology import Snapshot

#: No two images of an atom are that close, in angstrom.
_ROUNDING = 1e-3


def whole_groups(snapshot: Snapshot, atoms: IntArray) -> FloatArray:
    """Positions of groups, each made whole, shape (n, width, 3).

    By minimum images from atom to atom; atoms of one molecule, whose neighbors in the group may be farther away than
    half the cell, lie where its bonds say.
    """
    r = lined_up(snapshot.positions[atoms], snapshot.lattice)
    if snapshot.lattice is None or not len(snapshot.topology.bonds):
        return r
    y, molecule = _in_molecules(snapshot)
    for k in range(1, atoms.shape[1]):
        same = molecule[atoms[:, :k]] == molecule[atoms[:, k, None]]
        first = np.argmax(same, axis=1)
        bonded = same.any(axis=1)
        row = np.arange(len(atoms))
        meant = r[row, first] + y[atoms[:, k]] - y[atoms[row, first]]
        moved = bonded & (np.abs(meant - r[:, k]).max(axis=1) > _ROUNDING * snapshot.angstrom)
        # What comes after goes along.
        r[moved, k:] += (meant - r[:, k])[moved, None]
    return r


def _in_molecules(snapshot: Snapshot) -> tuple[FloatArray, IntArray]:
    """Positions of whole molecules, and a number for each; atoms of endless ones have a number each."""
    bonds, n = snapshot.topology.bonds, snapshot.topology.n_atoms
    y = whole_molecules(snapshot).positions
    molecule, count = connected(bonds, n)
    d = y[bonds[:, 0]] - y[bonds[:, 1]]
    around = np.abs(d - minimum_image(d, snapshot.lattice)).max(axis=1) > _ROUNDING * snapshot.angstrom
    endless = np.isin(molecule, molecule[bonds[around, 0]])
    return y, np.where(endless, count + np.arange(n), molecule)


def whole_molecules(snapshot: Snapshot, links: IntArray | None = None) -> Snapshot:
    """Every molecule in one piece: bonded atoms moved to their nearest images, from the first atom on.

    Parameters
    ----------
    links : ndarray of int, shape (n, 2), optional
        What counts as bonded; by default the bonds of the topology.
    """
    if snapshot.lattice is None:
        return snapshot
    tree = spanning_tree(snapshot.topology.bonds if links is None else links, snapshot.topology.n_atoms)
    x = make_whole(snapshot.positions, *tree, snapshot.lattice)
    return snapshot if np.array_equal(x, snapshot.positions) else replace(snapshot, positions=x)
