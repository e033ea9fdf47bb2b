"""Minimum images inside compiled kernels."""

from __future__ import annotations

import numpy as np

from kcons.constraints.compilation import njit

#: Stands for 'no periodicity' where a kernel needs an array of the right type.
NO_LATTICE = np.zeros((2, 3, 3))


@njit(cache=True, inline="always")
def nearest_image(x, y, z, lattice):  # type: ignore[no-untyped-def]
    """Shortest image of a difference; `lattice` holds the cell (rows) and its inverse, both (3, 3)."""
    inverse = lattice[1]
    a = np.rint(x * inverse[0, 0] + y * inverse[1, 0] + z * inverse[2, 0])
    b = np.rint(x * inverse[0, 1] + y * inverse[1, 1] + z * inverse[2, 1])
    c = np.rint(x * inverse[0, 2] + y * inverse[1, 2] + z * inverse[2, 2])
    cell = lattice[0]
    return (
        x - (a * cell[0, 0] + b * cell[1, 0] + c * cell[2, 0]),
        y - (a * cell[0, 1] + b * cell[1, 1] + c * cell[2, 1]),
        z - (a * cell[0, 2] + b * cell[1, 2] + c * cell[2, 2]),
    )
