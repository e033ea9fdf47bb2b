"""Minimum images of a snapshot: groups and molecules made whole across the faces of the cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.topology.topology import Snapshot, connected


def minimum_image(snapshot: Snapshot, d: FloatArray) -> FloatArray:
    """Shortest images of difference vectors, shape (..., 3)."""
    if snapshot.cell is None or not snapshot.pbc.any():
        return d
    cell = snapshot.cell.copy()
    axes = np.flatnonzero(snapshot.pbc)
    if len(axes) < 3:
        cell[~snapshot.pbc] = np.linalg.svd(cell[axes])[2][len(axes) :]
    inverse = np.linalg.inv(cell)
    inverse[:, ~snapshot.pbc] = 0.0
    return d - np.round(d @ inverse) @ cell


def whole_groups(snapshot: Snapshot, atoms: IntArray) -> FloatArray:
    """Positions of groups, each made whole by minimum images from atom to atom, shape (n, width, 3)."""
    r = snapshot.positions[atoms]
    if snapshot.cell is None or not snapshot.pbc.any():
        return r
    steps = minimum_image(snapshot, np.diff(r, axis=1))
    r[:, 1:] = r[:, :1] + np.cumsum(steps, axis=1)
    return r


def whole_molecules(snapshot: Snapshot, links: IntArray | None = None) -> Snapshot:
    """Every molecule in one piece: bonded atoms moved to their nearest images, from the first atom on.

    Parameters
    ----------
    links : ndarray of int, shape (n, 2), optional
        What counts as bonded; by default the bonds of the topology.
    """
    if snapshot.cell is None or not snapshot.pbc.any():
        return snapshot
    pairs = snapshot.topology.bonds if links is None else links
    apart = snapshot.positions[pairs[:, 1]] - snapshot.positions[pairs[:, 0]]
    if np.abs(apart - minimum_image(snapshot, apart)).max(initial=0.0) < 1e-9 * snapshot.angstrom:
        return snapshot
    n = snapshot.topology.n_atoms
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    degree = np.bincount(both[:, 0], minlength=n)
    starts = np.cumsum(degree) - degree
    x = snapshot.positions.copy()
    molecule, _ = connected(pairs, n)
    first = np.unique(molecule, return_index=True)[1]
    placed = np.zeros(n, dtype=bool)
    placed[first] = True
    front = first[degree[first] > 0]
    # All molecules at once, one bond further in every round.
    while len(front):
        number = degree[front]
        edges = np.repeat(starts[front] - np.cumsum(number) + number, number) + np.arange(number.sum())
        parent, child = both[edges].T
        new = ~placed[child]
        child, kept = np.unique(child[new], return_index=True)
        parent = parent[new][kept]
        x[child] = x[parent] + minimum_image(snapshot, snapshot.positions[child] - x[parent])
        placed[child] = True
        front = child
    return replace(snapshot, positions=x)
