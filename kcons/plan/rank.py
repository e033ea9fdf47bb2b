"""Independent rows of clusters, and which rows depend on others."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import BoolArray, minimum_image
from kcons.constraints.target import FloatArray
from kcons.plan.clusters import Shape
from kcons.solvers.rank_revealing import independent, rank, stacks

#: Largest cluster, in rows, in which dependent rows are looked for one by one, to be eliminated last.
ORDERED_ROWS = 400
#: Rows of clusters of one kind among which that is done.
ORDERED_IN_ALL = 20_000


def small_enough(clusters: list[IntArray]) -> bool:
    sizes = [len(rows) for rows in clusters]
    return max(sizes, default=0) <= ORDERED_ROWS and sum(sizes) <= ORDERED_IN_ALL


def mark_dependent_rows(
    constraint_set: ConstraintSet,
    clusters: list[IntArray],
    inverse_masses: FloatArray,
    positions: FloatArray,
    time: float,
    eliminate_last: BoolArray,
) -> int:
    """Independent rows of small clusters, by pivoted QR; marks those that the best conditioned rows leave over."""
    from scipy.linalg import qr  # slow to import

    jacobian = constraint_set.jacobian(positions, time)
    root_w = np.repeat(np.sqrt(inverse_masses), 3)
    found = 0
    for rows in clusters:
        part = jacobian[rows]
        (stack,) = stacks(part, np.zeros(len(rows), np.int64))
        (b,) = stack.dense(part.data * root_w[part.indices])
        size = np.linalg.norm(b, axis=1, keepdims=True)
        triangle, order = qr((b / np.where(size > 0, size, 1.0)).T, mode="r", pivoting=True)
        diagonal = np.zeros(len(rows))
        diagonal[: min(triangle.shape)] = np.abs(np.diagonal(triangle))
        # The diagonal of the triangle stands for the singular values: it does not grow, and is their size.
        left_over = ~independent(diagonal)
        eliminate_last[rows[order]] = left_over
        found += int(np.sum(~left_over))
    return found


def rank_of_small(shape: Shape, inverse_masses: FloatArray, positions: FloatArray, lattice: FloatArray | None) -> int:
    """Rank of many small clusters of distances at once, from the singular values of their B."""
    ends = shape.atoms[:, shape.pairs]  # (n_clusters, K, 2) global atoms
    difference = positions[ends[..., 0]] - positions[ends[..., 1]]
    if lattice is not None:
        difference = minimum_image(difference, lattice)
    n, k = ends.shape[:2]
    b = np.zeros((n, k, shape.atoms.shape[1], 3))
    row = np.arange(k)
    root_w = np.sqrt(inverse_masses[shape.atoms[0]])
    b[:, row, shape.pairs[:, 0]] = difference * root_w[shape.pairs[:, 0], None]
    b[:, row, shape.pairs[:, 1]] = -difference * root_w[shape.pairs[:, 1], None]
    return rank(b.reshape(n, k, -1))
