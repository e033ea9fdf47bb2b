"""Periodic cells: shortest images, and what hangs together moved into one piece.

The one place in which atoms are moved by whole cells: for rows (`images`), for molecules of files
(`kcons.topology.whole_molecules`) and for molecules that are restored (`kcons.motion.restoring`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from kcons.constraints.arguments import FloatArray, IntArray
from kcons.constraints.compilation import njit, plain_if_small
from kcons.errors import InputError

BoolArray = NDArray[np.bool_]


def lattice_of(cell: FloatArray | None, pbc: bool | Sequence[bool] | BoolArray) -> FloatArray | None:
    """Cell vectors as rows, and the inverse with zeros for directions without periodicity, shape (2, 3, 3).

    Directions without periodicity get a unit vector normal to the others. None without a periodic direction.
    """
    periodic = np.zeros(3, dtype=bool) | np.asarray(pbc, dtype=bool)
    if cell is None or not periodic.any():
        return None
    full, basis = cell.copy(), cell[periodic]
    if len(basis) < 3:
        full[~periodic] = np.linalg.svd(basis)[2][len(basis) :]
    singular = InputError("the periodic cell vectors are zero or not independent", item="cell")
    try:
        inverse = np.linalg.inv(full)
    except np.linalg.LinAlgError:
        raise singular from None
    inverse[:, ~periodic] = 0.0
    if not np.vdot(basis, basis) * np.vdot(inverse, inverse) < 1e20:
        raise singular
    return np.array([full, inverse])


def minimum_image(d: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Shortest periodic images of difference vectors, shape (..., 3); `d` itself without a lattice."""
    return d if lattice is None else d - np.round(d @ lattice[1]) @ lattice[0]


def lined_up(r: FloatArray, lattice: FloatArray | None) -> FloatArray:
    """Lists of atoms, shape (n, width, 3), each atom in the image nearest to the one before it; in place."""
    if lattice is not None:
        steps = minimum_image(np.diff(r, axis=1), lattice)
        r[:, 1:] = r[:, :1] + np.cumsum(steps, axis=1)
    return r


def neighbor_lists(pairs: IntArray, n_atoms: int) -> tuple[IntArray, IntArray]:
    """Where the neighbors of each atom begin, shape (n_atoms + 1,), and all of them, those of one atom ascending."""
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    start = np.concatenate([[0], np.cumsum(np.bincount(ends[:, 0], minlength=n_atoms))])
    return start, ends[order, 1]


def connected(pairs: IntArray, n_atoms: int) -> tuple[IntArray, int]:
    """Number of the piece of each atom, counted from 0 in the order of their first atoms, and how many."""
    from scipy.sparse.csgraph import connected_components  # slow to import

    count, label = connected_components(_links(pairs, n_atoms), directed=False)
    return label.astype(np.int64), int(count)


def _links(pairs: IntArray, n: int) -> sp.csr_array:
    return sp.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsr()


def spanning_tree(pairs: IntArray, n_atoms: int, roots: IntArray | None = None) -> tuple[IntArray, IntArray]:
    """All atoms breadth first along pairs, and their parents, which come before them.

    The first of `roots`, which are all atoms, in a piece is its root and its own parent; by default the lowest number.
    """
    if not len(pairs):
        return np.arange(n_atoms), np.arange(n_atoms)
    from scipy.sparse.csgraph import breadth_first_order, connected_components  # slow to import

    links = _links(pairs, n_atoms + 1)
    label = connected_components(links, directed=False)[1]
    order = np.arange(n_atoms) if roots is None else roots
    first = np.sort(order[np.unique(label[order], return_index=True)[1]])
    # One more node, from which all pieces hang.
    ends, starts = np.concatenate([links.indices, first]), links.indptr
    starts[-1] += len(first)
    tree = sp.csr_array((np.ones(len(ends)), ends, starts), shape=links.shape)
    found, parent_of = breadth_first_order(tree, n_atoms, directed=False)
    atoms = found[1:].astype(np.int64)
    parents = parent_of[atoms].astype(np.int64)
    return atoms, np.where(parents == n_atoms, atoms, parents)


def make_whole(x: FloatArray, atoms: IntArray, parents: IntArray, lattice: FloatArray | None) -> FloatArray:
    """Copy of `x`, shape (n_atoms, 3), with `atoms` moved by whole cells next to their parents, which come before them.

    Each atom is rounded once, wherever it is stored.
    """
    y = x.copy()
    if lattice is not None:
        plain_if_small(follow_parents, 30 * len(atoms))(y, atoms, parents, lattice)
    return y


@njit(cache=True)
def follow_parents(y, atoms, parents, lattice):  # type: ignore[no-untyped-def]
    """Move atoms in place; see `make_whole`."""
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
