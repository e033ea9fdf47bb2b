"""Sums that keep what rounding takes away."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from kcons.models.growth.model import FloatArray


def two_sum(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """a + b and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def compensated_sum(terms: Iterable[FloatArray]) -> FloatArray:
    """The sum of arrays as if added with twice the digits and then rounded.

    References
    ----------
    Ogita, Rump & Oishi, SIAM J. Sci. Comput. 26, 1955 (2005), algorithm 4.4.
    """
    total: FloatArray = np.zeros(())
    lost: FloatArray = np.zeros(())
    for term in terms:
        total, error = two_sum(total, term)
        lost = lost + error
    return np.asarray(total + lost)
