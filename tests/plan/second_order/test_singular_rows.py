"""Rows that are singular at second order, one block at a time."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan.second_order.singular_rows import LocalRows, unsolvable

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
ALL = [[i, j] for i in range(4) for j in range(i)]


def local(x, rows):
    held = ConstraintSet(rows, x, np.ones(len(x)))
    return LocalRows(held, np.arange(held.n_rows), x, 0.0)


def test_a_row_without_gradient_that_bends_is_unsolvable():
    """sigma = y^2/2 where A = 0; with A = (1, 0) there is always an acceleration along x."""
    bent = lambda v: v[:, 1:] ** 2  # noqa: E731
    assert unsolvable(np.zeros((1, 1, 2)), bent, np.ones(1)).tolist() == [True]
    assert unsolvable(np.array([[[1.0, 0.0]]]), bent, np.ones(1)).tolist() == [False]
    # Dependent rows that bend alike: any acceleration does for both, or for none.
    twice = np.array([[[1.0, 0.0], [1.0, 0.0]]])
    assert unsolvable(twice, lambda v: np.repeat(v[:, 1:] ** 2, 2, axis=1), np.ones(1)).tolist() == [False]
    assert unsolvable(twice, lambda v: v[:, 1:] ** 2 * [1.0, 2.0], np.ones(1)).tolist() == [True]


@pytest.mark.parametrize(("x", "singular", "rank"), [(TETRAHEDRON, False, 6), (SQUARE, True, 5)])
def test_all_distances_of_four_atoms(x, singular, rank):
    rows = local(x, Distance(ALL))
    assert rows.singular(rows.x) is singular and rows.rank(rows.x) == rank
    assert len(rows.stressed(rows.x)) == (6 if singular else 0)
    # Without a diagonal the square may fold: its five rows are independent.
    assert not rows.singular(rows.x, np.array([0, 1, 2, 3, 5]))


def test_pairs_that_keep_their_distance_nearby():
    """Two triangles that share a side, flat as a square: only the pair across may come nearer."""
    rows = local(SQUARE, Distance([[0, 1], [1, 2], [0, 2], [2, 3], [0, 3]]))
    rigid, rank = rows.rigid_pairs()
    assert rank == 5
    assert sorted(map(tuple, np.argwhere(~rigid).tolist())) == [(1, 3), (3, 1)]
