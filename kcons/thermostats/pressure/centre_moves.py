"""Pieces moved by their centres, and the work of it: compiled, since every trial of a barostat asks for both."""

from __future__ import annotations

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.periodic.one_piece import follow_parents


@njit(cache=True, nogil=True)
def displacements(x, label, weight, opened, atoms, parents, lattice, change, d):  # type: ignore[no-untyped-def]
    """By how much atoms move where the cell becomes cell (1 + `change`), each in the image that it is stored in.

    Parameters
    ----------
    x : ndarray, shape (n_atoms, 3)
    label, weight, opened, atoms, parents
        Of `Pieces`; the last two are its tree.
    lattice : ndarray, shape (2, 3, 3)
    change : ndarray, shape (3, 3)
    d : ndarray, shape (n_atoms, 3)
        Written to.

    Returns
    -------
    int
        An atom that stays in its place along an axis in which its image moves; -1 without one.
    """
    y = x.copy()
    follow_parents(y, atoms, parents, lattice)
    moved = np.zeros((len(opened), 3))
    for i in range(len(x)):
        for k in range(3):
            moved[label[i], k] += weight[i] * y[i, k]
    for p in range(len(opened)):
        a, b, c = moved[p, 0], moved[p, 1], moved[p, 2]
        for k in range(3):
            moved[p, k] = a * change[0, k] + b * change[1, k] + c * change[2, k] if opened[p, k] else 0.0
    cell, inverse, torn = lattice[0], lattice[1], -1
    for i in range(len(x)):
        p = label[i]
        for k in range(3):
            d[i, k] = moved[p, k]
        u, v, w = y[i, 0] - x[i, 0], y[i, 1] - x[i, 1], y[i, 2] - x[i, 2]
        if u == 0.0 and v == 0.0 and w == 0.0:
            continue
        for m in range(3):
            cells = np.rint(u * inverse[0, m] + v * inverse[1, m] + w * inverse[2, m])
            if cells == 0.0:
                continue
            for k in range(3):
                image = cells * (cell[m, 0] * change[0, k] + cell[m, 1] * change[1, k] + cell[m, 2] * change[2, k])
                if image != 0.0 and not opened[p, k] and torn < 0:
                    torn = i
                d[i, k] -= image
    return torn


@njit(cache=True, nogil=True)
def work_of_shapes(x, f, label, weight, opened, atoms, parents, lattice):  # type: ignore[no-untyped-def]
    """Sum of (r_i - R) (x) f_i over atoms, R the centre of their piece or zero where it stays, shape (3, 3)."""
    y = x.copy()
    follow_parents(y, atoms, parents, lattice)
    centres = np.zeros((len(opened), 3))
    for i in range(len(x)):
        for k in range(3):
            centres[label[i], k] += weight[i] * y[i, k]
    work = np.zeros((3, 3))
    for i in range(len(x)):
        p = label[i]
        for j in range(3):
            for k in range(3):
                work[j, k] += (y[i, j] - centres[p, j] if opened[p, k] else y[i, j]) * f[i, k]
    return work
