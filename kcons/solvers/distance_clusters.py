"""Held distances, eight clusters at a time: what the solvers of rigid triangles, small clusters and chains share.

Their kernels take ``(tangent, changed, references, velocities, inv_dt, given, lattice, kind, tables, multipliers)``.
`tangent` is None for positions, to be brought to the lengths `given`, and () for vectors to be brought to these rates:
a kernel is compiled for each of the two. They write at once what they find, and put it back where they fail.
"""

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.any_width import arithmetic
from kcons.solvers.kernels.eight_wide import FASTMATH, TRIPLE, WIDTH, lanes_type, load_triple, scatter_points
from kcons.solvers.kernels.lattices import OPEN, TRICLINIC, lattice_numbers, minimum_image
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import EPS, ROUNDING


@njit(cache=True, fastmath=FAST, error_model="numpy")
def resolved(x, pairs, lengths, lattice, kind):
    """Whether each |sigma| at `x` is within what rounding leaves of it, see `kcons.solvers.tolerances`."""
    cell = lattice_numbers(lattice)
    for k in range(len(lengths)):
        i, j = pairs[2 * k], pairs[2 * k + 1]
        ax, ay, az = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        if kind != OPEN:
            ax, ay, az = minimum_image((ax, ay, az), cell, TRICLINIC)
        d = lengths[k]
        miss = abs(ax * ax + ay * ay + az * az - d * d) / (2.0 * d)
        if not (miss <= ROUNDING * d):
            reach = np.sqrt(x[i, 0] ** 2 + x[i, 1] ** 2 + x[i, 2] ** 2)
            reach += np.sqrt(x[j, 0] ** 2 + x[j, 1] ** 2 + x[j, 2] ** 2)
            if not (miss <= 2 * EPS * reach):
                return False
    return True


def product(a, b):
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def difference(a, b):
    """Of two triples."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


# Compiled into kernels; within formulas their functions are called.
dot, minus = arithmetic(lanes_type)(product), arithmetic(TRIPLE)(difference)
plus = arithmetic(TRIPLE)(lambda a, b, factor: tuple(x + y * factor for x, y in zip(a, b, strict=True)))
times = arithmetic(TRIPLE)(lambda a, factor: tuple(x * factor for x in a))


SAVED = 3 * WIDTH
"""Doubles that `shift_points` keeps of one point in eight lanes."""


@njit(fastmath=FASTMATH)
def restore_points(points, table, undo, groups, n_local, stride, first):
    """Write back what `keep_points` kept of the first `groups` groups."""
    for group in range(groups):
        for k in range(n_local):
            saved = (group * stride + first + k) * SAVED
            scatter_points(points, table, (group * n_local + k) * WIDTH, load_triple(undo, saved))


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
def worst_row(errors, sizes, n_rows, slots, first):
    """Largest ``error / size`` of a group, and its row ``slots[first + lane] + k``."""
    worst, row = -1.0, 0
    for lane in range(WIDTH):
        for k in range(n_rows):
            error, size = abs(errors[k * WIDTH + lane]), sizes[k * WIDTH + lane]
            ratio = 0.0 if error == 0.0 else error / size
            if not ratio <= worst:
                worst, row = ratio, slots[first + lane] + k
                if worst != worst:
                    return worst, row
    return worst, row
