"""A cell that comes, changes or is too small: what rows mean in it."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import (
    Angle,
    CenterDistance,
    Dihedral,
    Distance,
    FixedAtoms,
    LinearCombination,
    LinearRelation,
)
from kcons.errors import ImageError, InputError

MASSES = np.array([1.0, 16.0, 12.0, 2.0, 30.0, 1.0])


CHAIN = np.array([[0, 0, 0], [1.1, 0.2, 0], [1.5, 1.3, 0.3], [2.6, 1.5, 1.1], [3.0, 2.7, 1.0], [2.2, 3.5, 1.6]])


ROWS = {
    "relation": [LinearRelation(0, [1, 2], [0.7, 0.3], None)],
    "relation of bonded atoms": [Distance([[0, 1], [1, 2]]), LinearRelation(0, [1, 2], [0.7, 0.3], None)],
    "combination": [LinearCombination([0, 1, 2], [[1.0, 0.5, 0.2], [-0.4, -0.5, 0.3], [-0.6, 0, -0.5]])],
    "free angle": [Angle([[0, 1, 2]])],
    "free dihedral": [Dihedral([[0, 1, 2, 3]]), Distance([[3, 4]])],
    "centres": [CenterDistance([0, 1, 2], [3, 4, 5])],
    "centre of a molecule": [
        Distance([[0, 1], [1, 2], [2, 3]]),
        Dihedral([[0, 1, 2, 3]]),
        CenterDistance([0, 3], [4, 5]),
    ],
    "moving length": [Distance([[0, 1]], lambda t: 1.1180339887498950 + 0.1 * t), Distance([[1, 2]])],
    "all": [
        FixedAtoms([2]),
        Distance([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]),
        Angle([[0, 1, 2]]),
        Dihedral([[2, 3, 4, 5]]),
        LinearCombination([0, 5], [[1.0, 1.0, 0], [-1.0, -1.0, 0]]),
    ],
}


def test_a_first_cell_is_refused_where_images_have_to_be_found():
    rows = ConstraintSet(ROWS["relation"], CHAIN, MASSES)
    motion = Motion(rows, CHAIN)
    with pytest.raises(InputError, match="make a new ConstraintSet"):
        motion.set_cell(np.diag([9.0] * 3))
    assert rows.lattice is None
    plain = Motion(ConstraintSet(Distance([[0, 1]]), CHAIN, MASSES), CHAIN)
    plain.set_cell(np.diag([9.0] * 3))
    assert plain.lattice is not None


def test_a_cell_that_shrinks_onto_loose_atoms_is_refused():
    rows = ConstraintSet(CenterDistance([0], [5]), CHAIN[:, [0, 1, 2]], MASSES, cell=np.diag([12.0] * 3))
    motion = Motion(rows, CHAIN)
    before = motion.lattice
    with pytest.raises(InputError, match="more than a tenth"):
        motion.set_cell(np.diag([12.0, 6.9, 12.0]), positions=CHAIN)
    assert motion.lattice is before
    for width in (11.0, 10.0, 9.1, 8.3, 7.6):
        motion.set_cell(np.diag([12.0, width, 12.0]), positions=CHAIN)
    before = motion.lattice
    with pytest.raises(ImageError):
        motion.set_cell(np.diag([12.0, 6.9, 12.0]), positions=CHAIN)
    assert motion.lattice is before
    # Without positions it is found out when these come.
    motion.set_cell(np.diag([12.0, 6.9, 12.0]))
    with pytest.raises(ImageError):
        motion.project_positions(CHAIN, CHAIN)


def test_directions_without_periodicity_do_not_count_as_a_change_of_the_cell():
    """The vectors that stand for them are any two normals, which jump where the periodic one turns a little."""
    rng = np.random.default_rng(4)
    for _ in range(200):
        cell = rng.normal(size=(3, 3)) + 9 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rows = ConstraintSet(ROWS["relation"], CHAIN, MASSES, cell=cell, pbc=(True, False, False))
        rows.with_cell(cell @ (np.eye(3) + 0.02 * rng.uniform(-1, 1, (3, 3))), (True, False, False))
