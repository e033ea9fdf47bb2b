"""Means of correlated samples: their errors are as large as they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import kstest, norm

from kcons.free_energy.averages import agreement, weighted_mean


def ar1(rng, n, memory, d=1):
    """x' = a x + noise of variance 1 each, from its stationary distribution: g = (1 + a)/(1 - a)."""
    noise = rng.standard_normal((n, d)) * np.sqrt(1 - memory**2)
    noise[0] = rng.standard_normal(d)
    return lfilter([1.0], [1.0, -memory], noise, axis=0)


@pytest.mark.filterwarnings("ignore:.*independent ones")  # in one of 300, a single block has most of the spread
def test_weights_that_belong_to_the_values():
    """x normal with weight exp(b x) has the mean b. The weights have the memory of x."""
    rng, b, found = np.random.default_rng(2), 1.0, []
    for _ in range(300):
        x = ar1(rng, 3000, 0.6)
        mean = weighted_mean(x, np.exp(b * x[:, 0]))
        found.append(abs(mean.value - b) / mean.error)
    for part, off in ((0.68, 0.08), (0.95, 0.04)):
        assert np.mean(np.array(found) < norm.ppf(0.5 + part / 2)) == pytest.approx(part, abs=off)


def test_several_quantities_at_once_have_a_covariance():
    rng = np.random.default_rng(3)
    mixing = np.array([[1.0, 0.0], [0.8, 0.3]])
    found = [weighted_mean(ar1(rng, 1000, 0.5, d=2) @ mixing.T) for _ in range(300)]
    assert np.median([m.n_effective for m in found]) == pytest.approx(1000 / 3, rel=0.15)
    seen = np.cov(np.array([m.value for m in found]).T)
    said = np.mean([m.covariance for m in found], axis=0)
    assert said == pytest.approx(3 * mixing @ mixing.T / 1000, rel=0.08)
    assert seen == pytest.approx(said, rel=0.25)  # of 300 samples, a variance is known to 8 percent


def test_one_sample_with_all_the_weight_is_warned_of():
    weights = np.where(np.arange(1000) == 7, 1.0, 1e-6)
    with pytest.warns(UserWarning, match=r"worth 1\.0 independent.*heaviest has 100%"):
        weighted_mean(np.random.default_rng(6).standard_normal(1000), weights)


def test_a_series_that_never_changes_is_warned_of():
    """Also one that changes only where it has no weight."""
    values = np.random.default_rng(7).standard_normal((100, 2))
    values[:, 1] = 0.1
    values[90:, 1] = 5.0
    with pytest.warns(UserWarning, match=r"column \[1\] are the same"):
        found = weighted_mean(values, np.repeat([1.0, 2.0, 0.0], [40, 50, 10]))
    assert found.error[1] == 0 and found.value[1] == pytest.approx(0.1, rel=1e-14)
    assert found.error[0] > 0


def test_windows_that_agree_do_so_with_the_right_probability():
    rng = np.random.default_rng(8)
    roots = [np.array([[1.0, 0.0], [0.9, 0.3]]), np.array([[0.5, 0.2], [0.0, 0.4]])]
    covariances = [root @ root.T for root in roots]
    drawn = [3.0 + rng.standard_normal((2000, 2)) @ root.T for root in roots]
    found = [agreement(a, b, sum(covariances)) for a, b in zip(*drawn, strict=True)]
    assert kstest(found, "uniform").pvalue > 0.01
    assert agreement(np.array([3.0, 3.0]), np.array([3.0, 9.0]), sum(covariances)) < 1e-4


@pytest.mark.parametrize(
    ("one", "other", "variances", "chance"),
    [
        ([1.0], [1.5], [0.04], 0.01242),
        ([1.0], [1.0], [0.0], 1.0),
        ([1.0], [1.1], [0.0], 0.0),
        ([0.0, 2.0], [1.0, 2.0], [2.0, 0.0], 0.4795),
        # Known exactly, as the multiplier of two atoms alone, where each side has another rounding.
        ([-7.75], [-7.75 * (1 + 1e-13)], [2e-28], 1.0),
        ([-7.75], [-7.75 * (1 + 1e-6)], [2e-28], 0.0),
        ([2e-15], [-1e-15], [2e-32], 1.0),  # 0 by symmetry
    ],
)
def test_agreement_of_single_numbers_and_of_exact_ones(one, other, variances, chance):
    assert agreement(np.array(one), np.array(other), np.diag(variances)) == pytest.approx(chance, rel=1e-3)
