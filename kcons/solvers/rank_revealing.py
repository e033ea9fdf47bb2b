"""Which rows of a matrix are independent, and solutions that leave out what is not: dense, for stacks of clusters.

Rows are taken in the mass metric and scaled to unit length: what counts is the angle between rows, and neither their
units nor the masses.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.tolerances import RANK_TOLERANCE


def independent(singular: NDArray[np.floating[Any]]) -> NDArray[np.bool_]:
    """Which singular values, largest first, belong to independent rows."""
    return np.asarray(singular > RANK_TOLERANCE * singular[..., :1])


def rank(rows: FloatArray) -> int:
    """Independent rows of a stack of matrices, shape (n, K, C), in all; the rows need not be scaled."""
    size = np.linalg.norm(rows, axis=2, keepdims=True)
    unit = np.divide(rows, size, out=np.zeros_like(rows), where=size > 0)
    return int(np.sum(independent(np.linalg.svd(unit, compute_uv=False))))


def independent_rows(rows: FloatArray) -> NDArray[np.bool_]:
    """Which rows of one matrix, shape (K, C), are the best conditioned that all others depend on."""
    from scipy.linalg import qr  # slow to import

    size = np.linalg.norm(rows, axis=1, keepdims=True)
    triangle, order = qr((rows / np.where(size > 0, size, 1.0)).T, mode="r", pivoting=True)
    # The diagonal of the triangle stands for the singular values: it does not grow, and is their size.
    diagonal, found = np.abs(np.diagonal(triangle)), np.zeros(len(rows), np.bool_)
    found[order[: len(diagonal)]] = independent(diagonal)
    return found


def least_norm(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm, least-squares solutions of a stack of systems, singular directions cut."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    inverse = np.where(independent(s), 1 / np.where(s > 0, s, 1.0), 0.0)
    return np.asarray(np.einsum("nrk,nr->nk", vt, inverse * np.einsum("nkr,nk->nr", u, right)))


class Stack(NamedTuple):
    """Clusters of n_rows rows with n_columns columns of a sparse matrix: rows, shape (n, n_rows), columns, shape
    (n, n_columns), and which of the matrix's numbers go where in the flat dense array of all.
    """

    rows: IntArray
    columns: IntArray
    entries: IntArray
    places: IntArray

    def dense(self, data: FloatArray) -> FloatArray:
        """The clusters of a matrix with these numbers, shape (n, n_rows, n_columns)."""
        found = np.zeros((*self.rows.shape, self.columns.shape[1]))
        found.reshape(-1)[self.places] = data[self.entries]
        return found


def stacks(matrix: sp.csr_array, labels: IntArray, most: float = np.inf) -> Iterator[Stack]:
    """The rows of a matrix by clusters, those with equal numbers of rows and columns together.

    Parameters
    ----------
    matrix : csr_array
    labels : ndarray of int, shape (n_rows,)
        Cluster of each row, from 0 on.
    most : float
        Numbers of a dense stack; clusters that need more are parted.
    """
    order = np.argsort(labels, kind="stable")
    heights = np.bincount(labels)
    begins = np.cumsum(heights) - heights
    line = np.empty(len(labels), np.int64)
    line[order] = np.arange(len(labels)) - np.repeat(begins, heights)
    row = np.repeat(np.arange(len(labels)), np.diff(matrix.indptr))
    cluster = labels[row]
    used, place = np.unique(cluster * matrix.shape[1] + matrix.indices, return_inverse=True)
    widths = np.bincount(used // matrix.shape[1], minlength=len(heights))
    starts = np.cumsum(widths) - widths
    number = np.full(len(heights), -1)
    for height, width in np.unique(np.column_stack((heights, widths))[heights > 0], axis=0).tolist():
        members = np.flatnonzero((heights == height) & (widths == width))
        portions = np.clip(np.ceil(len(members) * height * width / most), 1, len(members))
        for part in np.array_split(members, int(portions)):
            number[part] = np.arange(len(part))
            mine = np.flatnonzero(number[cluster] >= 0)
            at = cluster[mine]
            yield Stack(
                order[begins[part][:, None] + np.arange(height)],
                used[starts[part][:, None] + np.arange(width)] % matrix.shape[1],
                mine,
                (number[at] * height + line[row[mine]]) * width + place[mine] - starts[at],
            )
            number[part] = -1
