"""Which rows of a matrix are independent, and solutions that leave out what is not: dense, for stacks of clusters.

Rows are taken in the mass metric and scaled to unit length: what counts is the angle between rows, and neither their
units nor the masses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def least_norm(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm, least-squares solutions of a stack of systems, singular directions cut."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    return np.asarray(np.einsum("nrk,nr->nk", vt, _inverse(s) * np.einsum("nkr,nk->nr", u, right)))


def _inverse(singular: FloatArray) -> FloatArray:
    return np.where(independent(singular), 1 / np.where(singular > 0, singular, 1.0), 0.0)
