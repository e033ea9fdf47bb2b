"""Points of a scan, and what is next to what."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Dihedral, Distance, Formula
from kcons.free_energy.scans.scan_result import Grid

TURN, LENGTH = Dihedral([[0, 1, 2, 3]]), Distance([[0, 1]])


def test_a_whole_turn_is_a_ring():
    grid = Grid([TURN], [np.radians(np.arange(-180, 181, 30))])
    assert grid.shape == (12,) and grid.rings == [True]
    assert grid.neighbors((0,)) == [(1,), (11,)]
    assert grid.apart((0,), [np.pi]) == pytest.approx(0) and grid.apart((0,), [np.radians(150)]) == pytest.approx(1)
    assert grid.shown((1,)) == pytest.approx([-150]) and grid.said((1,)) == "Dihedral(0, 1, 2, 3) = -150"
    part = Grid([TURN], [np.radians([0, 30, 60])])
    assert part.rings == [False] and part.neighbors((2,)) == [(1,)]


def test_values_that_descend_stay_in_their_order():
    """Energies of a scan belong to the values as they were given."""
    values = np.radians(np.arange(180, -181, -30))
    grid = Grid([TURN], [values])
    np.testing.assert_array_equal(grid.values[0], values[:-1])
    assert grid.rings == [True] and grid.neighbors((0,)) == [(1,), (11,)]
    assert grid.apart((0,), [np.radians(150)]) == pytest.approx(1)
    assert Grid([TURN], [values[2:5]]).rings == [False]


def test_two_coordinates():
    grid = Grid([TURN, LENGTH], [np.radians(np.arange(0, 360, 120)), [1.4, 1.2]])
    assert grid.shape == (3, 2) and len(grid.points) == 6 and grid.rings == [True, False]
    assert grid.neighbors((0, 0)) == [(1, 0), (2, 0), (0, 1)]
    assert grid.at((0, 0)) == [0.0, 1.4]  # in the order given
    held = grid.held_at((2, 1))
    assert held[0].target == pytest.approx([np.radians(240)]) and held[1].target == pytest.approx([1.2])
    assert grid.names == ["Dihedral(0, 1, 2, 3)", "Distance(0, 1)"] and grid.in_degrees == [True, False]
    assert grid.units == ["degrees", "angstrom"]
    assert Grid([Formula("x1 * x2", [[0, 1]]), TURN], [[0.1], [0.2]]).units == ["own unit", "degrees"]
