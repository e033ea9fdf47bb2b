"""Means of correlated samples with weights, and their errors.

The mean force of a window is a ratio, sum w f/sum w. To first order its fluctuation is that of the mean of the series
u = w (f - mean)/<w>, whose neighbors depend on each other: a mean of n values has g times the variance of independent
ones, g being the statistical inefficiency (from `kcons.thermostats.correlated_series`, as all errors of means).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from kcons.constraints.arguments import FloatArray, as_float_array
from kcons.errors import InputError
from kcons.thermostats.correlated_series import few, spread

#: Fewest values that an error is taken from.
MIN_SAMPLES = 16


@dataclass(frozen=True, eq=False)
class Mean:
    """Means of d quantities.

    Attributes
    ----------
    value : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
        Of the means, not of the samples.
    error : ndarray, shape (d,)
        Standard errors.
    n : int
        Samples used.
    n_effective : float
        Independent samples of equal weight that would tell as much: (sum w)^2/sum w^2 over the inefficiency, if that is
        more than 1. Fewer where few blocks make up the spread, as of heavy tails.
    inefficiency : ndarray, shape (d,)
        Samples for each independent one; less than 1 of values that swing back.
    """

    value: FloatArray
    covariance: FloatArray
    error: FloatArray
    n: int
    n_effective: float
    inefficiency: FloatArray


def finite(values: ArrayLike, item: str, row: str = "sample") -> FloatArray:
    """Values as an array; `InputError` naming the first row that is not finite."""
    array = as_float_array(values, item)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        raise InputError(f"{item} of {row} {bad[0, 0] if array.ndim else 0} is not finite; leave it out", item=item)
    return array


def weighted_mean(values: ArrayLike, weights: ArrayLike | None = None) -> Mean:
    """Mean of correlated samples, sum w f/sum w, with its error.

    Parameters
    ----------
    values : array_like, shape (n, d) or (n,)
        In the order in which they were taken.
    weights : array_like, shape (n,), optional
        Equal by default. A common factor does not matter.

    Raises
    ------
    InputError
        Fewer than 16 samples; a NaN or infinity; a negative weight, or none that is positive.

    Warns
    -----
    UserWarning
        Fewer than 15 independent samples; a quantity that never changes, whose error is then 0.
    """
    series = finite(values, "values")
    series = series[:, None] if series.ndim == 1 else series
    if series.ndim != 2 or len(series) < MIN_SAMPLES or not series.shape[1]:
        raise InputError(
            f"values of shape {series.shape} are too few for an error; give (n, d) with n of {MIN_SAMPLES} or more",
            item="values",
        )
    n = len(series)
    factors = np.ones(n) if weights is None else finite(weights, "weights")
    if factors.shape != (n,) or (factors < 0).any() or not factors.any():
        raise InputError(f"weights must have shape {(n,)}, not be negative, and one be positive", item="weights")
    factors = factors / factors.max()
    if factors.sum() <= 1 + 1e-12:
        said = f"sample {int(np.argmax(factors))} has all of the weight, and one sample has no error; sample longer"
        raise InputError(said, item="weights")
    factors /= factors.mean()
    value = factors @ series / n
    # What the ratio sum w f/sum w fluctuates by, sample by sample: its mean is 0.
    fluctuation = factors[:, None] * (series - value)
    counted = series[factors > 0]
    scale = np.maximum(np.abs(counted).max(axis=0), np.finfo(float).tiny)
    constant = np.abs(counted - counted[0]).max(axis=0) <= 1e-13 * scale
    if constant.any():
        warnings.warn(
            f"all values of column {np.flatnonzero(constant).tolist()} are the same: their error is given as 0. "
            "Either they are known exactly, or they were recorded once and repeated",
            stacklevel=2,
        )
        fluctuation[:, constant] = 0.0
    covariance = fluctuation.T @ fluctuation / (n * (n - 1))
    found = [spread(u) for u in fluctuation.T]
    error = np.array([each.error for each in found])
    inefficiency = np.ones(len(found))
    np.divide(error**2, np.diag(covariance), out=inefficiency, where=~constant)
    widening = np.sqrt(inefficiency)
    covariance *= np.outer(widening, widening)
    alike = float(factors.sum() ** 2 / (factors**2).sum())
    effective = max(min(alike / max(float(inefficiency.max()), 1.0), *(each.independent for each in found)), 1.0)
    if doubt := few(n, effective):
        heaviest, memory = factors.max() / factors.sum(), inefficiency.max()
        why = f"the heaviest has {heaviest:.0%} of the weight, memory lasts for {memory:.0f}"
        warnings.warn(f"{doubt} ({why})", stacklevel=2)
    return Mean(value, covariance, np.sqrt(np.diag(covariance)), n, effective, inefficiency)


def agreement(one: FloatArray, other: FloatArray, covariance: FloatArray) -> float:
    """Probability, by chi square, of a difference of two means (d,) as large as theirs, if both are of the same.

    `covariance` (d, d) is that of both together; where it is singular, only what has an error counts, and a difference
    in what has none has the probability 0. Differences of rounding, 1e-9 of the largest mean or of 1, are none.
    """
    sizes, directions = np.linalg.eigh(covariance)
    known = sizes > 1e-12 * max(float(sizes[-1]), 0.0)
    parts = directions.T @ (one - other)
    parts[np.abs(parts) <= 1e-9 * max(np.abs(one).max(), np.abs(other).max(), 1.0)] = 0.0
    if parts[~known].any():
        return 0.0
    count = int(known.sum())
    return float(chi2.sf((parts[known] ** 2 / sizes[known]).sum(), count)) if count else 1.0
