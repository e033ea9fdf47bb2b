"""Clusters eight at a time: layout, minimum images, undoing, reporting."""

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH, load_triple, nearest, scatter_points

MAX_ITERATIONS = 50
POSITION_TOLERANCE = 4e-15
"""Accepted ``|r² - d²| / 2d²``; round-off of bond vectors stays below 1e-15."""
TANGENT_TOLERANCE = 1e-15
"""Accepted ``|u·y_ij - c|``, relative to the cluster's own relative motion."""

TINY = 1e-300
"""Smallest scalar product taken for positive."""


NO_POINTS = np.zeros((0, 3))
NO_NUMBERS = np.zeros(0)
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
def dot(ax, ay, az, bx, by, bz):
    """Scalar product of two triples."""
    return ax * bx + ay * by + az * bz


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


SAVED = 3 * WIDTH
"""Doubles that `shift_points` keeps of one point in eight lanes."""


@njit(fastmath=FASTMATH)
def restore_points(points, table, undo, groups, n_local, stride, first):
    """Write back what `keep_points` kept of the first `groups` groups."""
    for group in range(groups):
        for k in range(n_local):
            saved = (group * stride + first + k) * SAVED
            x, y, z = load_triple(undo, saved)
            scatter_points(points, table, (group * n_local + k) * WIDTH, x, y, z)


def lane_tables(atoms: NDArray[np.int64], n_rows: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Offsets of rows by (group, lane), and of points by (group, local atom, lane).

    The last group is filled up with the last cluster: its lanes compute and
    write the same numbers twice, which needs no special code.
    """
    n_groups = -(-len(atoms) // WIDTH)
    slots = np.minimum(np.arange(n_groups * WIDTH), len(atoms) - 1)
    by_lane = atoms[slots].reshape(n_groups, WIDTH, -1).transpose(0, 2, 1)
    return (n_rows * slots).astype(np.uint32), (3 * by_lane).astype(np.uint32).reshape(-1)


@njit(fastmath=FASTMATH, error_model="numpy")
def worst_row(errors, sizes, n_rows):
    """Largest ``error / size`` of a group and its row ``n_rows * lane + k``."""
    worst, row = -1.0, 0
    for lane in range(WIDTH):
        for k in range(n_rows):
            error, size = abs(errors[k * WIDTH + lane]), sizes[k * WIDTH + lane]
            ratio = 0.0 if error == 0.0 else error / size
            if not ratio <= worst:
                worst, row = ratio, n_rows * lane + k
                if worst != worst:
                    return worst, row
    return worst, row
