"""Periodic cells: shortest images, and what hangs together moved into one piece.

The one place in which atoms are moved by whole cells: for rows (`kcons.constraints.images`), for molecules of files
(`kcons.topology.whole_molecules`) and for molecules that are restored (`kcons.motion.restoring`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kcons.constraints.arguments import FloatArray, IntArray
from kcons.errors import InputError

BoolArray = NDArray[np.bool_]


def lattice_of(cell: FloatArray | None, pbc: bool | Sequence[bool] | BoolArray) -> FloatArray | None:
    """Cell vectors as rows, and the inverse with zeros for directions without periodicity, shape (2, 3, 3).

    Directions without periodicity get a unit vector normal to the others. None without a periodic direction.

    Raises
    ------
    InputError
        Periodic cell vectors that are zero or not independent.
    """
    periodic = np.broadcast_to(np.asarray(pbc, dtype=bool), (3,))
    if cell is None or not periodic.any():
        return None
    full = cell.copy()
    basis = cell[periodic]
    _, singular, vh = np.linalg.svd(basis)
    if singular.min() < 1e-10 * max(singular.max(), np.finfo(float).tiny):
        raise InputError("the periodic cell vectors are zero or not independent", item="cell")
    full[~periodic] = vh[len(basis) :]
    inverse = np.linalg.inv(full)
    inverse[:, ~periodic] = 0.0
    return np.ascontiguousarray(np.stack([full, inverse]))


def minimum_image(d: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Shortest periodic images of difference vectors, shape (..., 3); `d` itself without a lattice."""
    return d if lattice is None else d - np.round(d @ lattice[1]) @ lattice[0]


def lined_up(r: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Lists of atoms, shape (n, width, 3), each atom in the image nearest to the one before it; in place."""
    if lattice is not None:
        steps = minimum_image(np.diff(r, axis=1), lattice)
        r[:, 1:] = r[:, :1] + np.cumsum(steps, axis=1)
    return r


def neighbour_lists(pairs: IntArray, n_atoms: int) -> tuple[IntArray, IntArray, IntArray]:
    """Where the neighbours of each atom begin, shape (n_atoms + 1,); these, ascending; the pair each comes from."""
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    start = np.concatenate([[0], np.cumsum(np.bincount(ends[:, 0], minlength=n_atoms))])
    return start, ends[order, 1], order % max(len(pairs), 1)


def spanning_tree(pairs: IntArray, n_atoms: int, roots: IntArray | None = None) -> tuple[IntArray, IntArray, IntArray]:
    """All atoms breadth first along pairs, their parents, and the pair between the two, -1 for roots.

    Parameters
    ----------
    roots : ndarray of int, optional
        In which order atoms are taken as roots, if nothing before reached them. A root is its own parent.
    """
    start, neighbours, through = neighbour_lists(pairs, n_atoms)
    return _breadth_first(np.arange(n_atoms) if roots is None else roots, start, neighbours, through, n_atoms)


def make_whole(x: FloatArray, atoms: IntArray, parents: IntArray, lattice: FloatArray | None) -> FloatArray:
    """Copy of `x`, shape (n_atoms, 3), with `atoms` moved by whole cells next to their parents, which come before them.

    Each atom is rounded once, wherever it is stored.
    """
    y = x.copy()
    if lattice is not None:
        _make_whole(y, atoms, parents, lattice)
    return y


@nb.njit(cache=True)
def _breadth_first(roots, start, neighbours, through, n_atoms):  # type: ignore[no-untyped-def]
    """Atoms in breadth-first order from `roots`, their parents, and the pair by which they were reached."""
    seen = np.zeros(n_atoms, np.bool_)
    atoms, parents = np.empty(n_atoms, np.int64), np.empty(n_atoms, np.int64)
    by = np.full(n_atoms, -1, np.int64)
    used = 0
    for root in roots:
        if seen[root]:
            continue
        seen[root] = True
        atoms[used] = parents[used] = root
        head = used
        used += 1
        while head < used:
            a = atoms[head]
            head += 1
            for p in range(start[a], start[a + 1]):
                b = neighbours[p]
                if not seen[b]:
                    seen[b] = True
                    atoms[used], parents[used], by[used] = b, a, through[p]
                    used += 1
    return atoms, parents, by


@nb.njit(cache=True)
def _make_whole(y, atoms, parents, lattice):  # type: ignore[no-untyped-def]
    """Move atoms by whole cells next to their parents, in place."""
    cell, inverse = lattice[0], lattice[1]
    for k in range(len(atoms)):
        a, b = atoms[k], parents[k]
        if a == b:
            continue
        dx, dy, dz = y[a, 0] - y[b, 0], y[a, 1] - y[b, 1], y[a, 2] - y[b, 2]
        na = np.rint(dx * inverse[0, 0] + dy * inverse[1, 0] + dz * inverse[2, 0])
        nb_ = np.rint(dx * inverse[0, 1] + dy * inverse[1, 1] + dz * inverse[2, 1])
        nc = np.rint(dx * inverse[0, 2] + dy * inverse[1, 2] + dz * inverse[2, 2])
        if na != 0.0 or nb_ != 0.0 or nc != 0.0:
            for i in range(3):
                y[a, i] -= na * cell[0, i] + nb_ * cell[1, i] + nc * cell[2, i]
