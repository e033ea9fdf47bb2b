"""Averages at step zero: known coefficients come back, errors are honest, and what cannot be is refused."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from kcons.comparison import extrapolate
from kcons.errors import InputError


def test_exact_values_come_back():
    for order in (2, 4):
        h = np.array([4.0, 2.0, 1.0])
        found = extrapolate(h, [(1.5 - 0.03 * s**order, 0.01 * s) for s in h], order)
        assert found.value == pytest.approx(1.5, rel=1e-12) and found.slope == pytest.approx(-0.03, rel=1e-11)
        assert found.freedom == 1 and found.chi_square < 1e-20 and found.fits and found.order == order


def test_two_steps_are_richardson():
    """(4 a(h) - a(2h))/3 and its error; nothing is left to judge the fit by."""
    found = extrapolate([1.0, 2.0], [(0.9, 0.02), (0.6, 0.05)])
    assert found.value == pytest.approx((4 * 0.9 - 0.6) / 3, rel=1e-12)
    assert found.error == pytest.approx(math.hypot(4 * 0.02, 0.05) / 3, rel=1e-12)
    assert found.slope_error == pytest.approx(math.hypot(0.02, 0.05) / 3, rel=1e-12)
    assert (found.freedom, found.probability) == (0, 1.0)
    assert found.estimate.off(1.0) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("errors", [(0.1, 1e-9), (1e-10, 0.1), (1e-200, 1e-200), (1e-9, 1e120)], ids=str)
def test_errors_may_be_as_unequal_as_they_like(errors):
    """The sums of squares of least squares lose what is uncertain beside what is certain."""
    found = extrapolate([1.0, 2.0], [(0.9, errors[0]), (0.6, errors[1])])
    assert found.value == pytest.approx(1.0, rel=1e-12) and found.slope == pytest.approx(-0.1, rel=1e-12)
    assert found.error == pytest.approx(math.hypot(4 * errors[0], errors[1]) / 3, rel=1e-12)
    assert found.slope_error == pytest.approx(math.hypot(*errors) / 3, rel=1e-12)


def test_an_exact_run_among_others_holds_the_fit():
    found = extrapolate([1.0, 2.0, 4.0], [(1.0, 1e-9), (1.3, 0.1), (2.5, 0.1)])
    slope = (3 * 0.3 + 15 * 1.5) / (3**2 + 15**2)  # of a line through the first
    assert found.slope == pytest.approx(slope, rel=1e-9) and found.value == pytest.approx(1 - slope, rel=1e-9)
    assert found.chi_square == pytest.approx(((0.3 - 3 * slope) ** 2 + (1.5 - 15 * slope) ** 2) / 0.01, rel=1e-6)


def test_errors_are_honest():
    """Synthetic runs: values scatter as told, chi^2 as it should."""
    rng = np.random.default_rng(3)
    h, errors = np.array([4.0, 3.0, 2.0, 1.0]), np.array([0.01, 0.02, 0.02, 0.03])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = [
            extrapolate(h, np.stack([2 + 0.1 * h**2 + errors * rng.standard_normal(4), errors], 1)) for _ in range(800)
        ]
    off = np.array([(run.value - 2) / run.error for run in runs])
    steep = np.array([(run.slope - 0.1) / run.slope_error for run in runs])
    for scores in (off, steep):
        assert abs(scores.mean()) < 3.5 / math.sqrt(800) and scores.std() == pytest.approx(1, abs=0.09)
    assert np.mean([run.chi_square for run in runs]) == pytest.approx(2, abs=0.3)
    assert np.mean([run.probability for run in runs]) == pytest.approx(0.5, abs=0.04)
    assert np.mean([not run.fits for run in runs]) < 0.03


def test_a_model_that_does_not_fit_is_told():
    """h^4 beside h^2, far beyond the errors."""
    h = np.array([4.0, 2.0, 1.0])
    with pytest.warns(UserWarning, match=r"does not fit averages at steps 4, 2, 1: chi\^2 .* for 1\. Take finer steps"):
        found = extrapolate(h, [(1 + 0.01 * s**2 + 0.01 * s**4, 0.01) for s in h])
    assert not found.fits and found.probability < 1e-6


@pytest.mark.parametrize(
    "steps, averages, order, text",
    [
        ([2.0], [(1.0, 0.1)], 2, "at one step cannot be extrapolated"),
        ([2.0, 2.0], [(1.0, 0.1), (1.1, 0.1)], 2, "at one step cannot be extrapolated"),
        ([0.3, 0.1 + 0.2], [(1.0, 0.1), (1.1, 0.1)], 2, "at one step cannot be extrapolated"),
        ([2.0, 1.0], [(1.0, 0.1)], 2, "do not go together"),
        ([2.0, -1.0], [(1.0, 0.1), (1.0, 0.1)], 2, "give positive numbers"),
        ([2.0, 1.0], [(1.0, 0.1), (1.0, 0.0)], 2, "positive errors"),
        ([2.0, 1.0], [(1.0, 0.1), (np.nan, 0.1)], 2, "finite values"),
        ([2.0, 1.0], [(1.0, 0.1), (1.0, 0.1)], 0, "order is 0"),
        ([2.0, 1.0], [(1.0, 0.1), (1.0, 0.1)], math.nan, "order is nan"),
        ([2.0, 1.0], [(1.0, 0.1), (1.0, 0.1)], None, "order is None"),
        ([2.0, 1.0], [1.0, 1.0], 2, r"give each step its \(value, standard error\)"),
        ([2.0, 1.0], [(1.0, 0.1), (1.0,)], 2, "averages is no array of numbers"),
        ([2.0, 1.0], [(1.0, 1e-200), (1.0, 0.1)], 2, "all but the smallest count for nothing"),
    ],
)
def test_bad_input(steps, averages, order, text):
    with pytest.raises(InputError, match=text):
        extrapolate(steps, averages, order)
