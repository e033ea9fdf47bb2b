"""The constraint rates z of A G A^T lambda = b - A(Psi + G phi), for one system or many at once.

The rows are made orthogonal in the scalar product <a, a'> = sum_i x_i a_i a'_i, one after another (Gram-Schmidt, each
row twice). This is a QR factorisation of (A G^1/2)^T: it never forms A G A^T, whose condition number is the square.
For the rows 1 and mu it amounts to the centred moment sum x (mu - M1)^2 = M2 - M1^2, computed without cancellation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcons.models.growth.model import FloatArray

#: A row depends on those before it where less than this part of its length is its own: rounding of sums, no rank of a
#: matrix, whose limit is that of `kcons.solvers.rank_revealing`.
LOST = 1e-12
#: A dependent row contradicts the others where its right side is off by more than this part of its terms.
SOLVABILITY_TOLERANCE = 1e-9


class Solution(NamedTuple):
    """z and how it was found; m rows, n species, N systems (or none of this axis).

    Attributes
    ----------
    z : ndarray, shape (n,) or (n, N)
    multipliers : ndarray, shape (m,) or (m, N)
        z = A^T multipliers; 0 for a dependent row.
    dependent : ndarray of bool, shape (m,) or (m, N)
    contradiction : ndarray, shape (m,) or (m, N)
        For dependent rows what is missing in its right side, in parts of the terms that it is made of.
    """

    z: FloatArray
    multipliers: FloatArray
    dependent: NDArray[np.bool_]
    contradiction: FloatArray


def solve(
    x: FloatArray, rows: Sequence[FloatArray], right: Sequence[FloatArray | float], drift: FloatArray
) -> Solution:
    """z with A (drift + G z) = right; z lies in the space of the rows (notes eqs. 137, 138).

    Parameters
    ----------
    x : ndarray, shape (n,) or (n, N)
    rows : sequence of m ndarrays shaped as x
    right : sequence of m numbers or ndarrays of shape (N,)
    drift : ndarray shaped as x
        Psi + G phi.
    """
    m, lanes = len(rows), x.shape[1:]
    units: list[FloatArray] = []
    asked: list[FloatArray | float] = []  # right sides of the unit rows
    along: list[FloatArray] = []
    mixing: dict[tuple[int, int], FloatArray] = {}
    dependent = np.zeros((m, *lanes), dtype=bool)
    contradiction = np.zeros((m, *lanes))
    z = np.zeros_like(x)
    with np.errstate(all="ignore"):
        for k in range(m):
            q = np.array(rows[k])
            b = right[k]
            squared = (x * q * q).sum(axis=0)
            smallest = LOST**2 * squared
            for j in range(k):
                mixing[j, k] = (x * q * units[j]).sum(axis=0)
                q -= mixing[j, k] * units[j]
            for j in range(k):
                again = (x * q * units[j]).sum(axis=0)
                q -= again * units[j]
                mixing[j, k] = mixing[j, k] + again
                b = b - mixing[j, k] * asked[j]
            if k:
                squared = (x * q * q).sum(axis=0)
            lost = ~(squared > smallest)
            missing = b - (q * drift).sum(axis=0)
            if lost.any():
                dependent[k] = lost
                size = np.abs(rows[k] * drift).sum(axis=0) + np.abs(right[k])
                contradiction[k] = np.where(lost, np.abs(missing) / np.where(size > 0, size, 1.0), 0.0)
                length = np.where(lost, np.inf, np.sqrt(squared))
            else:
                length = np.sqrt(squared)
            mixing[k, k] = length
            asked.append(b / length)
            along.append(missing / length)
            units.append(q / length)
            z += along[k] * units[k]
        multipliers = np.zeros((m, *lanes))
        for k in reversed(range(m)):
            rest = along[k]
            for j in range(k + 1, m):
                rest = rest - mixing[k, j] * multipliers[j]
            multipliers[k] = rest / mixing[k, k]
    return Solution(z, multipliers, dependent, contradiction)
