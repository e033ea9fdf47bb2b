"""Torsions turned as rigid groups: the force is that of the turn, and no turn is used that changes anything else."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet
from kcons.constraints import Angle, Dihedral, Distance
from kcons.free_energy import HeldCoordinates
from kcons.free_energy.held_coordinates import rigid_turn

#: A chain of five atoms with a branch at the third.
X = np.array([[0.0, 0.1, 0.2], [1.1, 0.0, -0.1], [1.6, 1.2, 0.1], [2.7, 1.3, 0.9], [3.1, 0.4, 1.9], [1.0, 2.1, -0.4]])
MASSES = np.array([1.0, 12.0, 14.0, 16.0, 12.0, 1.5])
BONDS = np.array([[0, 1], [2, 1], [2, 3], [3, 4], [2, 5]])
PHI = Dihedral([[0, 1, 2, 3]])


def energy(x):
    apart = np.linalg.norm(x[:, None] - x[None], axis=2)[np.triu_indices(6, 1)]
    return np.sum(apart**3) + x[:, 0] @ x[:, 1]


def gradient(x):
    steps = 1e-5 * np.eye(18).reshape(18, 6, 3)
    return np.array([(energy(x + s) - energy(x - s)) / 2e-5 for s in steps]).reshape(6, 3)


@pytest.mark.parametrize("bonds", [BONDS, np.vstack([BONDS, [[4, 5]]])], ids=["chain", "a ring beyond"])
def test_the_smaller_group_turns_and_its_force_is_the_slope_of_the_energy(bonds):
    turn = rigid_turn(PHI, bonds, X)
    assert turn.group.tolist() == [0] and turn.axis.tolist() == [2, 1]
    before = PHI.measure(X[PHI.atoms], 0.0)[0]
    for angle in (0.4, -0.2):
        there = turn.turned(X, angle)
        assert PHI.measure(there[PHI.atoms], 0.0)[0] - before == pytest.approx(angle, abs=1e-12)
        np.testing.assert_allclose(
            np.linalg.norm(np.subtract(*there[BONDS.T]), axis=1), np.linalg.norm(np.subtract(*X[BONDS.T]), axis=1)
        )
    slope = (energy(turn.turned(X, 1e-4)) - energy(turn.turned(X, -1e-4))) / 2e-4
    assert turn.force(X, -gradient(X)) == pytest.approx(slope, rel=1e-6)


def test_what_cannot_be_turned():
    for row, bonds in (
        (PHI, np.vstack([BONDS, [[0, 3]]])),  # a ring
        (PHI, BONDS[[0, 2, 3]]),
        (Dihedral([[3, 1, 2, 0]]), BONDS),
        (Angle([[0, 1, 2]]), BONDS),
    ):
        assert rigid_turn(row, bonds, X) is None


def turned(x=X, f=None, beside=(), bonds=BONDS, **cell):
    """That of a sample."""
    held = HeldCoordinates(ConstraintSet([*beside, PHI], x, MASSES, **cell), {"phi": PHI}, x, bonds=bonds)
    return held.sample(x, np.zeros((6, 3)), -gradient(X) if f is None else f).turned[0]


@pytest.mark.parametrize(
    ("beside", "turns"),
    [
        ([], True),
        ([Distance([[0, 1], [1, 2], [2, 3], [2, 5]])], True),
        ([Distance([[0, 1], [1, 2], [2, 3], [0, 2]])], False),  # the measure of the others changes
        ([Angle([[0, 1, 2]]), Distance([[4, 5]])], True),
        ([Distance([[0, 4]])], False),
        ([Dihedral([[0, 1, 2, 5]])], False),
        ([Distance([[0, 1]]), Distance([[0, 1]])], False),  # of dependent rows no measure is known
    ],
)
def test_other_rows_must_not_change(beside, turns):
    expected = rigid_turn(PHI, BONDS, X).force(X, -gradient(X)) if turns else np.nan
    assert turned(beside=beside) == pytest.approx(expected, nan_ok=True)


def test_a_molecule_across_a_box_is_not_turned():
    turn = rigid_turn(PHI, BONDS, X)
    assert np.isfinite(turn.force(X, np.ones((6, 3)))) and np.isnan(turned(bonds=None))
    for atom in (0, turn.axis[0]):  # cut in the middle: the axis is none
        there = X.copy()
        there[atom] += 10.0
        assert np.isnan(turn.force(there, np.ones((6, 3))))


@pytest.mark.parametrize(("cut", "known"), [(None, True), (5, True), (4, False), (3, False), (2, False)])
def test_a_molecule_that_a_cell_has_cut_from_the_start_is_not_turned(cut, known):
    """The torsion is right in any image, and nothing else that is held tells of the cut."""
    bonds, there = np.array([[0, 1], [1, 5], [1, 2], [2, 3], [3, 4]]), X.copy()
    assert rigid_turn(PHI, bonds, X).group.tolist() == [3, 4]
    if cut is not None:
        there[cut, 0] += 12.0
    expected = rigid_turn(PHI, bonds, X).force(X, -gradient(X)) if known else np.nan
    assert turned(there, bonds=bonds, cell=12 * np.eye(3), pbc=True) == pytest.approx(expected, nan_ok=True)
