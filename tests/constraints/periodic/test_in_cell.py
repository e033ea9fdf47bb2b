"""A cell that comes, changes or is too small: what rows mean in it."""

from __future__ import annotations

import numpy as np
import pytest
from rows_in_cells import CHAIN, MASSES, ROWS

from kcons import ConstraintSet, Motion
from kcons.constraints import (
    CenterDistance,
    Distance,
)
from kcons.errors import ImageError, InputError


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
