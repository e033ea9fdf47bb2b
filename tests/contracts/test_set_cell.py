"""`Motion.set_cell`: the same engine under another cell equals a new engine, for each kind of solver."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Angle, Constraint, Distance, FixedAtoms, RadiusOfGyration
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.motion import Motion

CELL = np.array([[9.0, 0, 0], [1.5, 8.5, 0], [-1.0, 0.7, 9.5]])
STRETCH = np.array([[1.03, 0.01, 0], [0, 0.98, 0.02], [0.01, 0, 1.02]])


def chain(n=5, seed=0):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(n, 3))
    return np.cumsum(steps / np.linalg.norm(steps, axis=1)[:, None], axis=0)


CASES: dict[str, tuple[list[Constraint], int]] = {
    "water": ([Distance([[0, 1], [0, 2], [1, 2]])], 3),
    "lanes": ([Distance([[0, 1], [0, 2], [0, 3]])], 4),
    "chain": ([Distance([[k, k + 1] for k in range(29)])], 30),
    "mixed": ([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], 5),
    "general": ([RadiusOfGyration([[0, 1, 2, 3]]), Distance([[3, 4]])], 5),
    "two, one fixed": ([Distance([[0, 1], [2, 3]]), FixedAtoms([4])], 5),
    "few among many": ([Angle([[0, 1, 2]]), RadiusOfGyration([[3, 4, 5]])], 40),
}


def fractional(x, cell):
    f = x @ np.linalg.inv(cell)
    return f - np.floor(f)


@pytest.mark.parametrize("case", CASES)
def test_equals_a_new_engine(case):
    rows, n = CASES[case]
    x = fractional(chain(n), CELL) @ CELL  # many rows cross the boundary
    masses = np.linspace(1, 3, n)
    held = ConstraintSet(rows, x, masses, cell=CELL)
    motion = Motion(held, x)
    cell = CELL @ STRETCH
    moved = x @ STRETCH + np.random.default_rng(1).normal(scale=0.01, size=x.shape)
    v = np.random.default_rng(2).normal(size=x.shape)
    motion.set_cell(cell, True, moved)
    fresh = Motion(ConstraintSet(held.constraints, x @ STRETCH, masses, cell=cell), x @ STRETCH)
    assert motion.rank == fresh.rank
    found = motion.project_positions(moved, moved)
    assert np.abs(found - fresh.project_positions(moved, moved)).max() <= 1e-13
    assert np.abs(motion.constraint_set.value(found)).max() <= 1e-13
    assert np.abs(fresh.constraint_set.value(found)).max() <= 1e-13
    assert np.abs(motion.project_velocities(found, v) - fresh.project_velocities(found, v)).max() <= 1e-13
    assert np.abs(motion.acceleration(found, v, v) - fresh.acceleration(found, v, v)).max() <= 1e-11
    far = found + np.random.default_rng(3).normal(scale=0.3, size=x.shape)
    assert np.abs(motion.constraint_set.value(motion.restore_positions(far))).max() <= 1e-12


def test_half_the_box_and_bad_cells_change_nothing():
    rows, n = CASES["mixed"]
    x = chain(n)
    motion = Motion(ConstraintSet(rows, x, np.ones(n), cell=CELL), x)
    before = motion.constraint_set.lattice
    assert before is not None
    for cell, positions, message in (
        (np.diag([1.9, 9, 9]), None, r"Distance\(.*half the box"),
        (np.diag([9.0, 0, 9]), None, "not independent"),
        (np.full((3, 3), np.nan), None, "NaN"),
        (CELL, x * 12, r"Angle.*half the box"),
    ):
        with pytest.raises(InputError, match=message):
            motion.set_cell(cell, True, positions)
        assert motion.constraint_set.lattice is before
        assert motion._local.lattice is before


def test_no_cell_any_more():
    rows, n = CASES["water"]
    x = chain(n)
    motion = Motion(ConstraintSet(rows, x, np.ones(n), cell=CELL), x)
    motion.set_cell(None)
    assert motion.constraint_set.half_width == np.inf
    assert np.abs(motion.constraint_set.value(motion.project_positions(x + 0.01, x))).max() <= 1e-14
