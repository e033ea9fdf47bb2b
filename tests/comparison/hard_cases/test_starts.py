"""Difficult starts through the core; residuals of several frames."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.contract import Frame
from kcons.comparison.hard_cases.starts import first_residual, rotor


@pytest.mark.parametrize("number", cases_of("starts"))
def test_core(number):
    check_core(number)


def test_the_largest_residual_of_some_frames():
    problem = rotor(3.0)
    assert problem.residual(problem.x) < 1e-15

    def frame(factor):
        return Frame(x=factor * problem.x, v=problem.v, kinetic=0.0, potential=0.0)

    assert first_residual(problem, frame(1.0), frame(1.02), frame(1.01)) == problem.residual(1.02 * problem.x) > 0.01
    assert np.isnan(first_residual(problem, frame(1.0), frame(np.nan)))


def test_the_rotor_turns_once_in_two_pi():
    problem = rotor()
    np.testing.assert_allclose(problem.v, np.cross([0, 0, 1.0], problem.x), atol=1e-15)
    assert np.abs(problem.m @ problem.v).max() < 1e-15


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("X33") == "silently wrong"
