"""Groups and molecules of a snapshot made whole across the faces of the cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import lined_up, make_whole, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.topology.topology import Snapshot


def whole_groups(snapshot: Snapshot, atoms: IntArray) -> FloatArray:
    """Positions of groups, each made whole by minimum images from atom to atom, shape (n, width, 3)."""
    return lined_up(snapshot.positions[atoms], snapshot.lattice)


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
