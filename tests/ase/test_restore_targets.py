"""`constrain(project=True)` and `Constraints.restore` with far targets: whole groups move, bonds stay."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from ase import Atoms
from ase.build import fcc111, molecule

from kcons.ase import constrain
from kcons.ase.topology import bonds_of
from kcons.constraints import CenterDistance, Dihedral, Distance
from kcons.errors import InfeasibleError, InputError


def lengths(atoms: Atoms) -> np.ndarray:
    """All distances within three bonds' reach of each other that no torsion changes: bonds and ends of angles."""
    bonds = {tuple(b) for b in bonds_of(atoms).tolist()}
    near = {a: {y for b in bonds for y in b if a in b and y != a} for a in range(len(atoms))}
    ends = {tuple(sorted(pair)) for a in near for pair in combinations(near[a], 2)}
    return np.array([atoms.get_distance(i, j, mic=True) for i, j in sorted(bonds | ends)])


@pytest.mark.parametrize("degrees", range(-180, 181, 15))
def test_a_torsion_at_any_target(degrees: int) -> None:
    atoms = molecule("CH3CH2OH")
    before = lengths(atoms)
    held = constrain(atoms, Dihedral([[3, 2, 1, 0]], np.radians(degrees)), project=True)
    assert abs((atoms.get_dihedral(3, 2, 1, 0) - degrees + 180) % 360 - 180) < 1e-9
    np.testing.assert_allclose(lengths(atoms), before, rtol=0, atol=0.01)
    assert held.report(atoms).residual < 1e-14 * 4


def test_an_adsorbate_turns_and_the_metal_stays() -> None:
    """Metals have no bonds that could be changed, nor are they moved along."""
    slab = fcc111("Cu", (3, 3, 2), vacuum=12.0)
    ethanol = molecule("CH3CH2OH")
    ethanol.positions += slab.positions.mean(axis=0) - ethanol.positions.mean(axis=0)
    ethanol.positions[:, 2] += 8.0
    both = slab + ethanol
    both.wrap()
    first = len(slab)
    before = lengths(both)
    metal = both.positions[:first].copy()
    constrain(both, Dihedral([[first + 3, first + 2, first + 1, first]], 0.5), project=True)
    np.testing.assert_allclose(lengths(both), before, rtol=0, atol=0.01)
    np.testing.assert_array_equal(both.positions[:first], metal)


def test_bonds_that_are_given_are_taken() -> None:
    """Two waters that are said to be bonded shift no more one by one."""
    pair = molecule("H2O") + molecule("H2O")
    pair.positions[3:] += [0.0, 0.0, 3.0]
    pull = CenterDistance([0, 1, 2], [3, 4, 5], 6.0)
    free = pair.copy()
    constrain(free, pull, project=True)
    assert free.get_distance(0, 3) > 5.5
    pair.info["bonds"] = [[0, 1], [0, 2], [3, 4], [3, 5], [0, 3]]
    start = pair.positions.copy()
    with pytest.raises(InfeasibleError, match="no row asks for"):
        constrain(pair, pull, project=True)
    np.testing.assert_array_equal(pair.positions, start)
    assert not pair.constraints
    pair.info["bonds"] = [[0, 7]]
    with pytest.raises(InputError, match="bonds"):
        constrain(pair, pull, project=True)


def test_momenta_go_along() -> None:
    atoms = molecule("CH3CH2OH")
    atoms.set_momenta(np.random.default_rng(0).normal(size=(9, 3)))
    held = constrain(atoms, [Dihedral([[3, 2, 1, 0]], 0.3), Distance([[0, 1]])], project=True)
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ atoms.get_velocities().ravel()).max() < 1e-13
