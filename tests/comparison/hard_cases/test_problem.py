"""Problems of the hard cases."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison.hard_cases import Problem


def test_problem_forces_come_from_its_potential():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4, 3))
    problem = Problem(
        x, np.ones(4), push=rng.standard_normal((4, 3)), springs=[(0, 2, 3.0, 1.1)], tether=0.7, anchors=0 * x
    )
    y, d = x + 0.1, rng.standard_normal((4, 3))
    slope = (problem.potential(y + 1e-6 * d) - problem.potential(y - 1e-6 * d)) / 2e-6
    assert slope == pytest.approx(-np.sum(problem.forces(y) * d), rel=1e-7)
