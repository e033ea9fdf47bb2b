"""All solvers of a plan or none: what one of them cannot do takes back what the others did."""

import numpy as np
import pytest

from kcons.constraints import Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError
from kcons.motion import Motion
from kcons.motion.local_projections import LocalProjections
from kcons.motion.restoring.nearest_point import Work
from kcons.plan.plan import make_plan

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.24, 0.9266, 0]])


def projections():
    """Rigid triangles and a short chain, so two solvers, and a fixed atom."""
    x = np.concatenate(
        [WATER + 5.0 * k for k in range(3)] + [1.5 * np.eye(3)[[0, 0, 1, 1, 2, 2, 0]].cumsum(axis=0) - 9]
    )
    triangles = np.concatenate([np.array([[0, 1], [0, 2], [1, 2]]) + 3 * k for k in range(3)])
    chain = np.array([[k, k + 1] for k in range(9, 15)])
    held = ConstraintSet([Distance(np.concatenate([triangles, chain])), FixedAtoms([15])], x, np.ones(len(x)))
    return LocalProjections(held, make_plan(held, x, 0.0), None), held, x


def test_positions_and_tangents_of_all_solvers():
    solve, held, x = projections()
    assert {solver.name for solver in solve.plan.solvers} == {"water", "sparse"}
    new = x + 0.02 * np.random.default_rng(0).normal(size=x.shape)
    y, v, lam = new.copy(), np.zeros_like(x), np.full(held.n_rows, np.nan)
    solve.positions(y, x, 0.0, 0.0, v, 2.0, lam)
    assert np.all(np.abs(held.value(y)) <= held.tolerance(y))
    np.testing.assert_array_equal(lam[-3:], 0.0)
    moved = (held.jacobian(x).T @ lam).reshape(-1, 3)
    np.testing.assert_allclose((y - new)[:15], moved[:15], atol=1e-13)
    np.testing.assert_allclose(v[:15], 2.0 * (y - new)[:15], atol=1e-12)
    assert min(solve.iterations) > 0
    speed = np.random.default_rng(1).normal(size=x.shape)
    solve.tangents(x, speed, None, 0.0, None, "velocity")
    assert np.abs(held.jacobian(x) @ speed.ravel()).max() < 1e-13
    assert solve.rates(x, 0.0) is None


@pytest.mark.parametrize("broken", [slice(0, 3), slice(9, 15)])
def test_one_that_fails_takes_all_back(broken):
    solve, _held, x = projections()
    new = x + 0.02 * np.random.default_rng(0).normal(size=x.shape)
    new[broken] += 40.0 * np.random.default_rng(1).normal(size=x[broken].shape)
    y, v = new.copy(), np.ones_like(x)
    with pytest.raises(ConvergenceError):
        solve.positions(y, x, 0.0, 0.0, v, 1.0, None)
    np.testing.assert_array_equal(y, new)
    np.testing.assert_array_equal(v, 1.0)


def test_the_nearest_point_is_that_of_the_engine():
    solve, held, x = projections()
    off = x + 0.05 * np.random.default_rng(2).normal(size=x.shape)
    y = off.copy()
    solve.nearest(y, 0.0, Work(solve.plan))
    np.testing.assert_allclose(y, Motion(held, x).restore_positions(off, bonds=[]), rtol=0, atol=1e-13)
