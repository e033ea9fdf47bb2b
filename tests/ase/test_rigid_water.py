"""Rigid water in an Atoms object: what is water, and what only looks like it."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk, molecule

from kcons.ase import constraints_of, rigid_water
from kcons.errors import InputError


def test_rigid_water_finds_water_only():
    atoms = molecule("H2O") + molecule("CH3CH2OH") + molecule("OH") + bulk("Cu") + molecule("H2O")
    n = len(atoms)
    atoms.positions[:3] += 20
    atoms.positions[n - 3 :] -= 20
    rows = rigid_water(atoms).atoms
    assert np.array_equal(rows, [[0, 1], [0, 2], [1, 2], [n - 3, n - 2], [n - 3, n - 1], [n - 2, n - 1]])


def test_what_is_no_water():
    hydronium = Atoms("OH3", positions=[[0, 0, 0], [0.98, 0, 0], [-0.49, 0.85, 0], [-0.49, -0.85, 0]])
    for atoms in (hydronium, molecule("CH4"), molecule("CH3OH"), Atoms("OH2", np.full((3, 3), np.nan))):
        with pytest.raises(InputError, match="no water found"):
            rigid_water(atoms)


def test_water_in_another_order_is_held_too():
    atoms = molecule("H2O") + molecule("H2O")[[1, 0, 2]] + molecule("CH3OH")
    atoms.positions[3:] += 10
    atoms.positions[6:] += 10
    atoms = atoms[[0, 3, 4, 1, 2, 5, *range(6, 12)]]
    assert rigid_water(atoms).atoms.tolist() == [[0, 3], [0, 4], [3, 4], [2, 1], [2, 5], [1, 5]]
    assert constraints_of(atoms, "none", guess_bonds=True).constraint_set.n_rows == 6


def test_rigid_water_across_a_boundary():
    atoms = molecule("H2O")
    atoms.set_cell([8, 8, 8])
    atoms.pbc = True
    atoms.positions -= atoms.positions[0]
    atoms.wrap()
    assert rigid_water(atoms).n_rows == 3


def test_rigid_water_geometry():
    atoms = molecule("H2O")
    assert rigid_water(atoms, "spc").target[:2] == pytest.approx([1.0, 1.0])
    assert rigid_water(atoms, (1.0, 90.0)).target == pytest.approx([1.0, 1.0, np.sqrt(2)])
    assert rigid_water(atoms).target is None
    with pytest.raises(InputError, match=r"no water model 'spd'.*did you mean"):
        rigid_water(atoms, "spd")


def test_waters_in_nanometers():
    water = molecule("H2O")
    water.positions *= 0.1
    with pytest.raises(InputError, match="multiply by 10 where these are in nm") as raised:
        rigid_water(water, "tip3p")
    assert list(raised.value.atoms) == [0]
