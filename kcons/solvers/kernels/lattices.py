"""Lattices and minimum images inside compiled kernels, of one vector or of eight at once.

A lattice is the cell (rows) and its inverse, shape (2, 3, 3).
"""

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.any_width import nearest
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


@njit(fastmath=FASTMATH, forceinline=True)
def lattice_numbers(lattice):
    """Cell and inverse as plain numbers.

    An array handed to a function inside a loop costs reference counting,
    and a call there makes every vector register spill.
    """
    return (
        (lattice[0, 0, 0], lattice[0, 0, 1], lattice[0, 0, 2]),
        (lattice[0, 1, 0], lattice[0, 1, 1], lattice[0, 1, 2]),
        (lattice[0, 2, 0], lattice[0, 2, 1], lattice[0, 2, 2]),
        (lattice[1, 0, 0], lattice[1, 0, 1], lattice[1, 0, 2]),
        (lattice[1, 1, 0], lattice[1, 1, 1], lattice[1, 1, 2]),
        (lattice[1, 2, 0], lattice[1, 2, 1], lattice[1, 2, 2]),
    )


@njit(fastmath=FASTMATH, forceinline=True)
def minimum_image(x, y, z, cell, kind):
    """Shortest periodic copy of a bond shorter than half the cell."""
    a, b, c, p, q, r = cell
    if kind == ORTHORHOMBIC:
        x = x - nearest(x * p[0]) * a[0]
        y = y - nearest(y * q[1]) * b[1]
        z = z - nearest(z * r[2]) * c[2]
    elif kind == TRICLINIC:
        i = nearest(x * p[0] + y * q[0] + z * r[0])
        j = nearest(x * p[1] + y * q[1] + z * r[1])
        k = nearest(x * p[2] + y * q[2] + z * r[2])
        x = x - (i * a[0] + j * b[0] + k * c[0])
        y = y - (i * a[1] + j * b[1] + k * c[1])
        z = z - (i * a[2] + j * b[2] + k * c[2])
    return x, y, z
