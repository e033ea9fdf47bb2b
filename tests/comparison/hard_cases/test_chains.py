"""Chains through the core; the zigzag has the bonds and angles it is asked for."""

from __future__ import annotations

import numpy as np
import pytest
from hard_case_runs import cases_of, check_core, verdict_on_careless

from kcons.comparison.hard_cases.chains import bonds, zigzag


@pytest.mark.parametrize("number", cases_of("chains"))
def test_core(number):
    check_core(number)


@pytest.mark.parametrize(("degrees", "length"), [(110.0, 1.0), (156.0, 0.15), (180.0, 2.0)])
def test_a_zigzag_has_equal_bonds_and_angles(degrees, length):
    x = zigzag(6, degrees, length)
    steps = np.array([x[j] - x[i] for i, j in bonds(6)])
    assert len(steps) == 5
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), length, rtol=1e-14)
    cosines = -np.einsum("ij,ij->i", steps[1:], steps[:-1]) / length**2
    np.testing.assert_allclose(cosines, np.cos(np.radians(degrees)), atol=1e-14)


def test_a_program_that_holds_nothing_is_noticed():
    assert verdict_on_careless("X24") == "silently wrong"
