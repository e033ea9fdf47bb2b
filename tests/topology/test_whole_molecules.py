"""Molecules made whole across the faces of a cell."""

from __future__ import annotations

import numpy as np
import pytest
from snapshots import held_rows, snapshot

from kcons.errors import InputError
from kcons.topology.topology import whole_groups, whole_molecules

CELLS = [np.diag([7.0, 8.0, 9.0]), np.array([[7.0, 0, 0], [2.0, 8.0, 0], [-1.0, 3.0, 9.0]])]


def test_what_is_whole_or_has_no_cell_stays():
    made = snapshot(["C", "C"], [[0.0, 0, 0], [1.5, 0, 0]], [(0, 1)], cell=CELLS[0])
    assert whole_molecules(made) is made
    free = snapshot(["C", "C"], [[0.0, 0, 0], [6.5, 0, 0]], [(0, 1)])
    assert whole_molecules(free) is free


def test_groups_lie_where_the_bonds_of_their_molecule_say():
    """Ends of a chain of 29 angstrom in a cell of 40: their nearest images are 11 angstrom apart."""
    n, side = 24, 40.0
    x = np.array([[1.25 * i, 0.9 * (i % 2), 0.3 * np.sin(i)] for i in range(n)])
    bonds = [(i, i + 1) for i in range(n - 1)]
    atoms = np.array([[0, 1, 22, 23], [0, 22, 1, 23]])
    for positions in (x, (x + 25.0) % side):
        chain = snapshot(["C"] * n, positions, bonds, cell=side * np.eye(3))
        r = whole_groups(chain, atoms)
        np.testing.assert_allclose(r - r[:, :1], x[atoms] - x[atoms][:, :1], atol=1e-10)
        # Rows take nearest images, so that such a body cannot be held.
        with pytest.raises(InputError, match="not shorter than half the box"):
            held_rows(chain, "none", rigid_water=False, rigid_bodies=[[0, 1, 22, 23]])
        assert held_rows(chain, "none", rigid_water=False, rigid_bodies=[list(range(5))])


def test_atoms_of_endless_molecules_are_lined_up():
    """A chain that ends in its own image has no place where it begins."""
    x = np.array([[1.5 * i, 0.0, 0.0] for i in range(8)])
    chain = snapshot(["C"] * 8, x, [(i, (i + 1) % 8) for i in range(8)], cell=12.0 * np.eye(3))
    r = whole_groups(chain, np.array([[0, 7, 6], [3, 4, 5]]))
    np.testing.assert_allclose(r[:, 1:] - r[:, :1], [[[-1.5, 0, 0], [-3, 0, 0]], [[1.5, 0, 0], [3, 0, 0]]], atol=1e-12)
