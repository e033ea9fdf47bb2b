"""Sums that lose nothing to rounding, against exact fractions."""

from fractions import Fraction

import numpy as np

from kcons.models.growth.compensated_sums import compensated_sum, two_sum


def test_two_sum_is_exact():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 200)) * 10.0 ** rng.integers(-12, 12, (2, 200))
    total, error = two_sum(a, b)
    assert np.array_equal(total, a + b)
    for k in range(200):
        assert Fraction(a[k]) + Fraction(b[k]) == Fraction(total[k]) + Fraction(error[k])


def test_compensated_sum_of_terms_that_cancel():
    rng = np.random.default_rng(1)
    terms = rng.normal(size=(6, 100)) * 100.0
    terms[-1] = -np.sum(terms[:-1], axis=0) * (1 + 1e-12)
    exact = np.array([float(sum(Fraction(value) for value in column)) for column in terms.T])
    assert np.allclose(compensated_sum(terms), exact, rtol=1e-15, atol=0.0)
    # What it is for.
    assert np.max(np.abs(np.sum(terms, axis=0) / exact - 1)) > 1e-5
