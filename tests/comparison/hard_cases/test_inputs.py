"""Bad and unusual input through the core; the chain it is made from."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.inputs import base_residual, moving_chain


@pytest.mark.parametrize("number", cases_of("inputs"))
def test_core(number):
    check_core(number)


def test_the_residual_of_the_chain():
    problem = moving_chain(4)
    assert base_residual(problem.x) < 1e-14
    assert base_residual(1.01 * problem.x) == pytest.approx(0.01, rel=1e-10)
    np.testing.assert_allclose(problem.tangent(problem.v), problem.v, atol=1e-14)


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("X60") == "silently wrong"
