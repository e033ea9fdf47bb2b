"""Orders of the difference formulas."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints.differences import first_derivative, first_derivative_4, second_derivative


@pytest.mark.parametrize(
    ("formula", "expected", "order"),
    [
        (first_derivative_4, np.cos(0.3), 4),
        (first_derivative, np.cos(0.3), 8),
        (second_derivative, -np.sin(0.3), 8),
    ],
)
def test_order(formula, expected, order):
    steps = np.array([0.4, 0.2, 0.1])
    errors = [abs(float(formula(lambda t: np.asarray(np.sin(t)), 0.3, h)) - expected) for h in steps]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(order, abs=0.1)
