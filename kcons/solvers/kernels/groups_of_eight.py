"""Clusters eight at a time: layout, undoing, reporting."""

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH, load_triple, scatter_points


@njit(fastmath=FASTMATH, forceinline=True)
def dot(ax, ay, az, bx, by, bz):
    """Scalar product of two triples."""
    return ax * bx + ay * by + az * bz


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
