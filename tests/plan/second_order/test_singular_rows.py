"""Rows that are singular at second order, one block at a time."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Angle, Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan.second_order.singular_rows import LocalRows, extent_of, unsolvable

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
ALL = [[i, j] for i in range(4) for j in range(i)]


def local(x, *rows, fixed=()):
    given = [*rows, *([FixedAtoms(list(fixed))] if fixed else [])]
    held = ConstraintSet(given, x, np.ones(len(x)))
    return LocalRows(held, np.arange(sum(item.n_rows for item in rows)), x, 0.0)


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


def test_a_straight_molecule_held_by_three_distances():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [2.5, 0, 0]])
    rows = local(x, Distance([[0, 1], [1, 2], [0, 2]]))
    assert rows.singular(rows.x) and rows.rank(rows.x) == 2
    bent = local(x + np.outer([0.0, 0.3, 0.0], [0, 1, 0]), Distance([[0, 1], [1, 2], [0, 2]]))
    assert not bent.singular(bent.x) and bent.rank(bent.x) == 3


def test_rows_of_some_atoms():
    rows = local(SQUARE, Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]]), Distance([[2, 3]]))
    assert rows.inside(np.array([0, 1, 2])).tolist() == [0, 1, 2]
    assert rows.inside(np.array([2, 3])).tolist() == [3]


def test_fixed_atoms_have_no_columns():
    rows = local(SQUARE, Distance([[0, 1], [1, 2]]), fixed=[0])
    unit, norms = rows.unit_jacobian(rows.x)
    place = int(np.flatnonzero(rows.atoms == 0)[0])
    assert not unit[:, 3 * place : 3 * place + 3].any()
    assert norms == pytest.approx([1.0, np.sqrt(2.0)])
    assert np.linalg.norm(unit, axis=1) == pytest.approx([1.0, 1.0])


def test_positions_that_fulfil_the_targets():
    lengths = np.linalg.norm(TETRAHEDRON[[i for i, _ in ALL]] - TETRAHEDRON[[j for _, j in ALL]], axis=1)
    x = TETRAHEDRON + 0.05 * np.random.default_rng(3).normal(size=(4, 3))
    rows = local(x, Distance(ALL, lengths))
    found = rows.restored()
    assert np.abs(found.part.value(found.x)).max() < 1e-13
    assert np.array_equal(rows.x, x)


def test_pairs_that_keep_their_distance_nearby():
    """Two triangles that share a side, flat as a square: only the pair across may come nearer."""
    rows = local(SQUARE, Distance([[0, 1], [1, 2], [0, 2], [2, 3], [0, 3]]))
    rigid, rank = rows.rigid_pairs()
    assert rank == 5
    assert sorted(map(tuple, np.argwhere(~rigid).tolist())) == [(1, 3), (3, 1)]


def test_the_size_of_a_group():
    assert extent_of(SQUARE * 3.0) == 3.0
    assert extent_of(np.array([[0.0, -7.0, 2.0]])) == 7.0 and extent_of(np.zeros((1, 3))) == 1.0
