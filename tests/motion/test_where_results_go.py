"""Whole systems: where results go, and what of the system is looked at."""

import numpy as np
import pytest

from kcons.constraints import Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError
from kcons.motion import Motion


@pytest.fixture(params=[0, 20], ids=["all atoms", "few among many"])
def system(request):
    """One bond, alone or among free atoms: then the engine works on a copy of two atoms."""
    rng = np.random.default_rng(0)
    x = np.concatenate([[[0.0, 0, 0], [1.0, 0.2, 0]], rng.normal(size=(request.param, 3)) + 5.0])
    motion = Motion(ConstraintSet(Distance([[0, 1]]), x, np.ones(len(x))), x)
    return motion, x, x + 0.05 * rng.normal(size=x.shape)


@pytest.mark.parametrize("project", ["positions", "velocities"])
def test_results_go_where_they_are_wanted(system, project):
    motion, x, new = system

    def call(given, out=None):
        if project == "positions":
            return motion.project_positions(given, x, out=out)
        return motion.project_velocities(x, given, out=out)

    before = new.copy()
    fresh = call(new)
    np.testing.assert_array_equal(new, before)
    assert fresh is not new and np.abs(fresh[:2] - new[:2]).max() > 1e-4
    np.testing.assert_array_equal(fresh[2:], new[2:])
    other = np.full_like(new, np.nan)
    assert call(new, other) is other
    np.testing.assert_array_equal(other, fresh)
    assert call(new, new) is new
    np.testing.assert_array_equal(new, fresh)


def test_the_reference_may_be_what_is_changed(system):
    motion, x, _ = system
    y = x * 1.01
    expected = motion.project_positions(y.copy(), y.copy())
    np.testing.assert_array_equal(motion.project_positions(y, y, out=y), expected)


def test_velocities_follow_positions(system):
    motion, x, new = system
    v = np.ones_like(x)
    y = motion.project_positions(new, x, velocities=v, dt=0.5)
    np.testing.assert_allclose(v, 1.0 + (y - new) / 0.5, atol=1e-13)


@pytest.mark.parametrize("free", [0, 20], ids=["all atoms", "few among many"])
@pytest.mark.parametrize("of_the_set", [False, True])
def test_a_cell_that_moves_the_image_of_a_fixed_atom_is_refused(free, of_the_set):
    """No solver sees a row between fixed atoms: it was off by the change of the cell, and nothing was said."""
    x = np.concatenate([[[0.5, 0, 0], [9.5, 0, 0], [8.5, 0, 0]], np.full((free, 3), 5.0)])
    rows = [FixedAtoms([0, 1]), Distance([[0, 1], [1, 2]])]
    held = ConstraintSet(rows, x, np.ones(len(x)), cell=[10.0] * 3)
    motion = Motion(held, x)
    for _ in range(2):
        with pytest.raises(ContradictionError, match=r"#6 Distance\(0, 1\) lies between fixed atoms .* in this cell"):
            if of_the_set:
                held.with_cell([11.0, 10, 10])
                motion.project_velocities(x, x)
            else:
                motion.set_cell([11.0, 10, 10])
        assert np.array_equal(motion.lattice[0], 10 * np.eye(3))
        motion.certify(x)
    motion.set_cell([10.0, 12, 11])
    motion.certify(motion.project_positions(x + 0.01, x))
