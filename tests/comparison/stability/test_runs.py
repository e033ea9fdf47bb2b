"""Largest steps, drift of the energy, and reversal."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison.stability import SYSTEMS, attempt, drift, largest_step, reversal
from kcons.comparison.stability.runs import Copies


def test_largest_step_of_the_free_rotor_is_one():
    """omega = 1: asin(omega dt) has no value beyond, and the failure is an error."""
    found = largest_step("Rattle", "rotor", quick=True)
    assert 0.9 <= found["largest_step"] <= 1.0 < found["fails_at"]
    assert found["how"] == "ConvergenceError"
    assert found["silent_residual"] <= 1e-13
    assert attempt("Rattle", "rotor", 0.99, 50)[0] == "stable"


@pytest.mark.parametrize("name", SYSTEMS)
def test_copies_have_the_forces_of_the_system(name):
    problem = SYSTEMS[name](2)
    copies = Copies([SYSTEMS[name](1), problem])
    y = problem.x + 0.01 * np.random.default_rng(0).standard_normal(problem.x.shape)
    both = np.vstack([y, y])
    np.testing.assert_allclose(copies.forces(both, 0.0)[problem.n_atoms :], problem.forces(y), atol=1e-14)
    total, kinetic = copies.energies(both, copies.v)
    assert total[1] == pytest.approx(problem.potential(y) + problem.kinetic(problem.v), rel=1e-13)
    assert kinetic[1] == pytest.approx(problem.kinetic(problem.v), rel=1e-13)
    assert copies.residual(copies.x) <= 1e-15


def test_drift_and_reversal():
    found = drift("pendulum", 4, 2000)
    assert len(found["slopes"]) == 4 and found["residual"] <= 1e-14
    assert abs(found["slope"]) <= 1e-6
    assert reversal("Rattle", "butane", 100)["missed_by"] <= 1e-12
    assert "cannot" in reversal("OpenMM", "butane", 10)
