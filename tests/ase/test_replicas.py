"""Rows of slices and of repeated cells."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms

from kcons.ase.replicas import led_across, tiled, within
from kcons.constraints import Distance, FixedAtoms, Sphere
from kcons.errors import UnsupportedError


def test_rows_within_a_slice_are_renumbered():
    rows = [Distance([[0, 1], [1, 2]], [1.0, 2.0]), FixedAtoms([3])]
    (kept,) = within(rows, np.array([2, 1]), 4)
    assert kept.atoms.tolist() == [[1, 0]]
    assert kept.target.tolist() == [2.0]
    assert within(rows, np.array([0]), 4) == ()


def test_rows_of_replicas():
    pair, fixed = tiled([Distance([[0, 1]], 1.5), FixedAtoms([1])], (2, 1, 1), 2)
    assert pair.atoms.tolist() == [[0, 1], [2, 3]]
    assert pair.target.tolist() == [1.5, 1.5]
    assert fixed.atoms.ravel().tolist() == [1, 1, 1, 3, 3, 3] and fixed.target is None
    with pytest.raises(UnsupportedError, match="has a place in space and cannot be repeated"):
        tiled([Sphere([0], [0.0, 0.0, 0.0], 1.0)], (2, 1, 1), 2)


def test_a_row_across_the_boundary_leads_to_the_next_replica():
    cell = Atoms("H2", [[0.5, 1, 1], [9.5, 1, 1]], cell=[10, 10, 10], pbc=True)
    atoms = cell.repeat((3, 1, 1))
    (row,) = led_across(tiled([Distance([[0, 1]], 1.0)], (3, 1, 1), 2), atoms, (3, 1, 1), 2)
    assert row.atoms.tolist() == [[0, 5], [2, 1], [4, 3]]
    assert np.allclose(atoms.get_distances(2, [1]), 1.0)
    atoms.pbc = False
    (row,) = led_across(tiled([Distance([[0, 1]], 1.0)], (3, 1, 1), 2), atoms, (3, 1, 1), 2)
    assert row.atoms.tolist() == [[0, 1], [2, 3], [4, 5]]
