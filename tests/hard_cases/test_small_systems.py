"""Small test systems of long runs: starts on the constraints, and forces that fit the energy."""

from __future__ import annotations

import numpy as np
import pytest

from hard_cases.small_systems import SYSTEMS, separated


@pytest.mark.parametrize("name", SYSTEMS)
def test_starts_are_on_the_constraints_with_tangent_velocities(name):
    for seed in (1, 2):
        problem = SYSTEMS[name](seed)
        assert problem.residual(problem.x) <= 1e-15
        np.testing.assert_allclose(problem.tangent(problem.v), problem.v, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", SYSTEMS)
def test_forces_are_the_slope_of_the_energy(name):
    problem, h = SYSTEMS[name](3), 1e-5
    rng = np.random.default_rng(0)
    x = problem.x + 0.01 * rng.standard_normal(problem.x.shape)
    way = rng.standard_normal(x.shape)
    slope = (problem.potential(x + h * way) - problem.potential(x - h * way)) / (2 * h)
    assert slope == pytest.approx(-np.sum(problem.forces(x) * way), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("name", SYSTEMS)
def test_seeds_give_different_starts(name):
    one, same, other = (SYSTEMS[name](seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.v, same.v)
    assert not np.array_equal(one.v, other.v) or not np.array_equal(one.x, other.x)


def test_points_that_are_not_too_near():
    x = separated(np.random.default_rng(1), 12, 0.9)
    apart = [np.linalg.norm(a - b) for k, a in enumerate(x) for b in x[:k]]
    assert x.shape == (12, 3) and min(apart) >= 0.9
