"""Lattices and minimum images inside compiled kernels, of one vector or of eight at once.

A lattice is the cell (rows) and its inverse, shape (2, 3, 3).
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.any_width import INT64, arithmetic, instruction, place
from kcons.solvers.kernels.eight_wide import FASTMATH

#: Stands for 'no periodicity' where a kernel needs an array of the right type.
NO_LATTICE = np.zeros((2, 3, 3))
OPEN, ORTHORHOMBIC, TRICLINIC = 0, 1, 2


def lattice_kind(lattice: NDArray[np.float64] | None) -> tuple[NDArray[np.float64], int]:
    """The lattice as kernels take it, and which minimum image it needs."""
    if lattice is None:
        return NO_LATTICE, OPEN
    cell, inverse = lattice
    diagonal = np.count_nonzero(cell) + np.count_nonzero(inverse) == (
        np.count_nonzero(cell.diagonal()) + np.count_nonzero(inverse.diagonal())
    )
    return lattice, ORTHORHOMBIC if diagonal else TRICLINIC


@instruction(types.UniTuple(types.float64, 18), None)
def lattice_numbers(builder, lattice):
    """Cell and inverse as plain numbers: an array handed to a function in a loop costs reference counting."""
    return [builder.load(place(builder, lattice, INT64(k))) for k in range(18)]


@arithmetic(lambda r, numbers: r(r, numbers))
def _orthorhombic(r, numbers):
    return tuple(x - (x * numbers[k + 9]).unary("rint") * numbers[k] for x, k in zip(r, (0, 4, 8), strict=True))


@arithmetic(lambda r, numbers: r(r, numbers))
def _triclinic(r, numbers):
    (x, y, z), (a, b, c, p, q, s) = r, (numbers[k : k + 3] for k in range(0, 18, 3))
    i, j, k = ((x * p[n] + y * q[n] + z * s[n]).unary("rint") for n in range(3))
    return tuple(r[n] - (i * a[n] + j * b[n] + k * c[n]) for n in range(3))


@njit(fastmath=FASTMATH, forceinline=True)
def minimum_image(r, numbers, kind):
    """Shortest periodic copy of a bond (x, y, z) shorter than half the cell."""
    if kind == ORTHORHOMBIC:
        r = _orthorhombic(r, numbers)
    elif kind == TRICLINIC:
        r = _triclinic(r, numbers)
    return r
