"""Long runs through the core, shortened; the drift that is told from an oscillation."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core

from kcons.comparison.hard_cases.long_runs import pendulum, secular_drift


@pytest.mark.parametrize("number", cases_of("long_runs"))
def test_core(number):
    check_core(number)


def test_a_drift_is_told_from_an_oscillation():
    """Half of what a straight line rises by; of a thousand times as large an oscillation nothing is left."""
    t = np.linspace(0.0, 1.0, 20_001)[:-1]
    assert secular_drift(1e-6 * t) == pytest.approx(0.5e-6, rel=1e-10)
    assert abs(secular_drift(1e-3 * np.cos(2 * np.pi * 40.3 * t + 0.4))) < 1e-9


def test_the_pendulum_is_released_at_its_angle():
    problem = pendulum(2.0)
    assert problem.residual(problem.x) < 1e-15
    assert problem.potential(problem.x) == pytest.approx(-np.cos(2.0), rel=1e-14)
