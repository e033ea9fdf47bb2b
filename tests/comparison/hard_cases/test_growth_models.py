"""Growth models and flows through the core; the free energy they fall to."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core

from kcons.comparison.hard_cases.growth_models import EXCESS, START, _equilibrium, _excess


@pytest.mark.parametrize("number", cases_of("growth_models"))
def test_core(number):
    check_core(number)


def test_the_excess_of_the_start_is_that_of_the_figure():
    """sum x ln(x/x_eq), written without cancellation; nothing is left at equilibrium."""
    assert _excess(np.log(START)) == pytest.approx(EXCESS, rel=1e-14)
    assert _excess(np.log(START)) == pytest.approx(START @ np.log(START / _equilibrium()), rel=1e-14)
    assert abs(_excess(np.log(_equilibrium(2.0)), 2.0)) < 1e-30
