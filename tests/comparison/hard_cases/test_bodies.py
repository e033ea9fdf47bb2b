"""Rigid bodies through the core; water is that of TIP3P."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.bodies import WATER


@pytest.mark.parametrize("number", cases_of("bodies"))
def test_core(number):
    check_core(number)


def test_water_has_the_shape_of_tip3p():
    a, b = WATER[1] - WATER[0], WATER[2] - WATER[0]
    lengths = np.linalg.norm([a, b], axis=1)
    np.testing.assert_allclose(lengths, 0.9572, atol=1e-4)
    assert np.degrees(np.arccos(a @ b / lengths.prod())) == pytest.approx(104.52, abs=0.01)


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("X05") == "silently wrong"
