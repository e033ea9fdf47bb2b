"""Cells, shortest images, and what hangs together in one piece."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints.periodic.one_piece import (
    follow_parents,
    lattice_of,
    make_whole,
    minimum_image,
    spanning_tree,
)
from kcons.errors import InputError

CELL = np.array([[7.0, 0, 0], [2.0, 8.0, 0], [-1.0, 3.0, 9.0]])


@pytest.mark.parametrize("pbc", [(True, False, False), (True, True, False), (False, True, True)])
def test_directions_without_periodicity_never_count(pbc):
    cell = CELL.copy()
    cell[~np.array(pbc)] = 0.0  # as engines write it
    full, inverse = lattice_of(cell, pbc)
    open_vectors = full[~np.array(pbc)]
    np.testing.assert_allclose(open_vectors @ full[np.array(pbc)].T, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(open_vectors, axis=1), 1.0)
    assert not inverse[:, ~np.array(pbc)].any()
    np.testing.assert_array_equal(
        minimum_image(0.4 * open_vectors + 50 * open_vectors, np.stack([full, inverse])),
        0.4 * open_vectors + 50 * open_vectors,
    )


def test_cells_that_are_none_are_refused():
    with pytest.raises(InputError, match="zero or not independent"):
        lattice_of(np.ones((3, 3)), True)


def test_a_tree_is_walked_breadth_first_from_its_roots():
    pairs = np.array([[0, 1], [1, 2], [2, 3], [5, 4]])
    atoms, parents = spanning_tree(pairs, 7, np.array([2, 6, 5, 0, 1, 3, 4]))
    assert dict(zip(atoms.tolist(), parents.tolist(), strict=True)) == {2: 2, 1: 2, 3: 2, 0: 1, 6: 6, 5: 5, 4: 5}
    place = np.argsort(atoms)
    assert np.all(place[parents] <= place[atoms])
    assert spanning_tree(np.zeros((0, 2), np.int64), 2)[0].tolist() == [0, 1]


def test_whole_pieces_are_rounded_once():
    """An atom that need not move keeps its coordinates to the last digit, and so does the root."""
    lattice = lattice_of(CELL, True)
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.normal(size=(30, 3)), axis=0)
    pairs = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    cells = rng.integers(-2, 3, size=(30, 3)) * (np.arange(30) % 3 == 1)[:, None]
    stored = x + cells @ CELL
    atoms, parents = spanning_tree(pairs, 30)
    y = make_whole(stored, atoms, parents, lattice)
    np.testing.assert_array_equal(y[cells.any(axis=1) == 0], x[cells.any(axis=1) == 0])
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-14 * 60)
    np.testing.assert_array_equal(make_whole(stored, atoms, parents, None), stored)
    compiled = stored.copy()
    follow_parents(compiled, atoms, parents, lattice)
    np.testing.assert_array_equal(compiled, y)
