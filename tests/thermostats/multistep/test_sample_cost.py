"""Correlation times against those of a process whose are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from kcons.errors import InputError
from kcons.thermostats import evaluations_per_sample
from kcons.thermostats.multistep import autocorrelation_time


@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_autoregression(keep):
    """1 + 2 sum keep^k = (1 + keep)/(1 - keep)."""
    values = lfilter([1.0], [1.0, -keep], np.random.default_rng(3).normal(size=200_000))
    assert autocorrelation_time(values) == pytest.approx((1 + keep) / (1 - keep), rel=0.05)
    assert evaluations_per_sample(5 + values, 8) == 8 * autocorrelation_time(5 + values)


def test_anticorrelation_counts_as_one_and_so_does_rest():
    assert autocorrelation_time(np.tile([1.0, -1.0], 50)) == 1.0
    assert autocorrelation_time(np.full(50, 3.3)) == 1.0


def test_bad_input():
    with pytest.raises(InputError, match="32 finite values"):
        autocorrelation_time(np.zeros(31))
    with pytest.raises(InputError, match="32 finite values"):
        autocorrelation_time([np.nan] * 40)
    with pytest.raises(InputError, match="evaluations is 0"):
        evaluations_per_sample(np.zeros(40), 0)
    with pytest.raises(InputError, match=r"evaluations is .* give a positive number"):
        evaluations_per_sample(np.zeros(40), {"slow": 8})
