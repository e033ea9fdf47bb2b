"""The engine with targets that move and atoms that are fixed, in closed form; others, and cells: `random_cells`."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion


def test_a_distance_that_grows() -> None:
    """The position projection meets the target at `time` along the gradients at `x_ref`."""
    target = held.MovingTarget(lambda t: 1.0 + 0.5 * t, lambda t: 0.5, lambda t: 0.0)
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    masses = np.array([1.0, 3.0])
    motion = Motion(ConstraintSet(held.Distance([0, 1], target), x, masses), x)
    lam = np.empty(1)
    y = motion.project_positions(x, x, time=0.4, reference_time=0.0, multipliers=lam)
    np.testing.assert_allclose(y, [[-0.15, 0, 0], [1.05, 0, 0]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(lam, 0.2 / (1 + 1 / 3), rtol=1e-14)
    v = motion.project_velocities(x, np.zeros((2, 3)), time=0.0)
    np.testing.assert_allclose(v, [[-0.375, 0, 0], [0.125, 0, 0]], rtol=0, atol=1e-16)
    np.testing.assert_allclose(motion.restore_positions(x, time=1.0), [[-0.375, 0, 0], [1.125, 0, 0]], atol=1e-15)


def test_reference_time_is_that_of_the_gradients() -> None:
    """A plane that turns: corrections along its normal at `reference_time`, onto where it is at `time`."""

    def normal(t: float) -> np.ndarray:
        return np.array([-np.sin(t), np.cos(t), 0.0])

    plane = held.Formula("y1*cos(t) - x1*sin(t)", [0])
    x = np.array([[1.0, 0.0, 0.0]])
    motion = Motion(ConstraintSet(plane, x, [2.0]), x)
    for reference in (0.0, 0.2, None):
        along = normal(0.3 if reference is None else reference)
        expected = x[0] - along * (x[0] @ normal(0.3)) / (along @ normal(0.3))
        y = motion.project_positions(x, x, time=0.3, reference_time=reference)
        np.testing.assert_allclose(y[0], expected, rtol=0, atol=1e-14)
    f = np.array([[1.0, 2.0, 3.0]])
    for time in (0.0, 0.3):
        expected = f[0] - normal(time) * (normal(time) @ f[0])
        np.testing.assert_allclose(motion.project_forces(x, f, time=time)[0], expected, rtol=0, atol=1e-14)


def test_dependent_rows_on_fixed_atoms_share_their_multiplier() -> None:
    """Two rods in line that hold one atom: of all solutions the one of least norm."""
    x = np.array([[-1.0, 0, 0], [0, 0, 0], [1.0, 0, 0]])
    rows = [
        held.FixedAtoms([0, 2]),
        held.LinearCombination([1, 0], [[1.0, 0, 0], [-1.0, 0, 0]]),
        held.LinearCombination([1, 2], [[1.0, 0, 0], [-1.0, 0, 0]]),
    ]
    motion = Motion(ConstraintSet(rows, x, np.ones(3)), x)
    f = np.array([[0.0, 0, 0], [4.0, 1, 0], [0, 0, 0]])
    lam = motion.multipliers(x, np.zeros((3, 3)), f)
    np.testing.assert_allclose(lam[6:], [-2.0, -2.0], rtol=1e-14)
    np.testing.assert_allclose(motion.constraint_force(x, np.zeros((3, 3)), f).sum(axis=0), [-4.0, 0, 0], atol=1e-14)


@pytest.mark.parametrize("extra", [0, 400])
@pytest.mark.parametrize("row", [held.Distance([0, 1]), held.CenterDistance([[0]], [[1]])])
def test_a_cell_that_changes(extra: int, row: held.Constraint) -> None:
    """A barostat sets the cell of the set it gave; every solver sees it, on a compact copy as well."""
    x = np.vstack([[[0.5, 0, 0], [9.5, 0, 0]], np.random.default_rng(0).uniform(0, 9, (extra, 3))])
    whole = ConstraintSet(row, x, np.ones(len(x)), cell=[10.0, 10, 10])
    motion = Motion(whole, x)
    motion.project_positions(x, x)
    whole.with_cell([10.5, 10, 10])
    y = motion.project_positions(x, x)
    np.testing.assert_allclose(y[1, 0] - y[0, 0], 9.5, rtol=0, atol=1e-14)
    assert motion.report(y).residual < 1e-14
    v = np.zeros_like(x)
    v[0, 1] = 1.0
    np.testing.assert_allclose(motion.project_velocities(y, v), v, rtol=0, atol=1e-15)


def test_no_cell_any_more():
    x = np.array([[0.0, 0, 0], [1.0, 0.2, 0], [0.4, 1.1, 0.3]])
    skewed = np.array([[9.0, 0, 0], [1.5, 8.5, 0], [-1.0, 0.7, 9.5]])
    motion = Motion(ConstraintSet(held.Distance([[0, 1], [0, 2], [1, 2]]), x, np.ones(3), cell=skewed), x)
    motion.set_cell(None)
    assert motion.constraint_set.half_width == np.inf
    assert np.abs(motion.constraint_set.value(motion.project_positions(x + 0.01, x))).max() <= 1e-14
