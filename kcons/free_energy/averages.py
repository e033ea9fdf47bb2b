"""Means of correlated samples with weights, and their errors.

The mean force of a window is a ratio, sum w f/sum w. To first order its fluctuation is that of the mean of the series
u = w (f - mean)/<w>, whose neighbors depend on each other: a mean of n values has g times the variance of independent
ones, g being the statistical inefficiency (from `kcons.thermostats.correlated_series`, as all errors of means).
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from kcons.constraints.arguments import FloatArray, as_float_array
from kcons.errors import InputError, UnsupportedError
from kcons.thermostats.correlated_series import FEW_INDEPENDENT, spread

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


def pymbar() -> ModuleType:
    """The package pymbar, imported when it is needed.

    Raises
    ------
    UnsupportedError
        It is not installed.
    """
    # It logs general advice when it is imported, some of it through the logger of a module.
    loud = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        import pymbar
    except ModuleNotFoundError:
        raise UnsupportedError(
            "BAR is left to pymbar, which is not installed: python -m pip install 'kcons[free-energy]'"
        ) from None
    finally:
        logging.disable(loud)
    return pymbar  # type: ignore[no-any-return]


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
        Fewer than 10 independent samples; a quantity that never changes, whose error is then 0.
    """
    series, factors = _checked(values, weights)
    n = len(series)
    fluctuation = _linearized(series, factors)
    counted = series[factors > 0]
    scale = np.maximum(np.abs(counted).max(axis=0), np.finfo(float).tiny)
    constant = np.abs(counted - counted[0]).max(axis=0) <= 1e-13 * scale
    if constant.any():
        warnings.warn(
            f"all values of column {np.flatnonzero(constant).tolist()} are the same: their error is given as 0. "
            "Either they are known exactly, or they were recorded once and repeated",
            UserWarning,
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
    if effective < FEW_INDEPENDENT:
        heaviest = float(factors.max() / factors.sum())
        warnings.warn(
            f"{n} samples are worth {effective:.1f} independent ones, or a few of them make up the spread (the "
            f"heaviest has {heaviest:.0%} of the weight, memory lasts for {inefficiency.max():.0f} samples): the error "
            "is not to be relied on. Sample longer",
            UserWarning,
            stacklevel=2,
        )
    return Mean(_mean(series, factors), covariance, np.sqrt(np.diag(covariance)), n, effective, inefficiency)


def agreement(one: ArrayLike, covariance: ArrayLike, other: ArrayLike, other_covariance: ArrayLike) -> float:
    """Probability of a difference of two means as large as theirs, by chi square, if they are of the same quantities.

    Held windows share no configurations, and so have no overlap that could be looked at: where a window has forgotten
    how it was made, its mean force is the same from both sides.

    Parameters
    ----------
    one, other : array_like, shape (d,) or ()
    covariance, other_covariance : array_like, shape (d, d) or ()
        Of the means. Where the sum of both is singular, only what has an error counts; a difference in what has none
        has the probability 0. Differences of rounding, 1e-9 of the largest mean, are none.
    """
    arrays = [as_float_array(values, name) for values, name in ((one, "one"), (other, "other"))]
    spreads = [as_float_array(values, "covariance") for values in (covariance, other_covariance)]
    d = arrays[0].size
    if any(a.size != d or a.ndim > 1 for a in arrays) or any(
        c.shape not in ((d, d), ()) or c.size != d * d for c in spreads
    ):
        raise InputError(f"two means of {d} quantities need covariances of shape {(d, d)}", item="covariance")
    if not all(np.isfinite(each).all() for each in (*arrays, *spreads)):
        raise InputError("a mean or a covariance is not finite", item="covariance")
    if any((np.diagonal(c.reshape(d, d)) < 0).any() for c in spreads):
        raise InputError("a variance is negative; give covariances of the means", item="covariance")
    away = arrays[0].ravel() - arrays[1].ravel()
    sizes, directions = np.linalg.eigh(sum(c.reshape(d, d) for c in spreads))
    known = sizes > 1e-12 * max(float(sizes[-1]), 0.0)
    parts = directions.T @ away
    parts[np.abs(parts) <= 1e-9 * np.abs(np.concatenate(arrays, axis=None)).max()] = 0.0
    if parts[~known].any():
        return 0.0
    square = float((parts[known] ** 2 / sizes[known]).sum())
    count = int(known.sum())
    return float(chi2.sf(square, count)) if count else 1.0


def _checked(values: ArrayLike, weights: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """Values (n, d) and weights (n,) whose mean is about 1."""
    series = finite(values, "values")
    series = series[:, None] if series.ndim == 1 else series
    if series.ndim != 2 or len(series) < MIN_SAMPLES or not series.shape[1]:
        raise InputError(
            f"values of shape {series.shape} are too few for an error; give (n, d) with n of {MIN_SAMPLES} or more",
            item="values",
        )
    factors = np.ones(len(series)) if weights is None else finite(weights, "weights")
    if factors.shape != (len(series),):
        raise InputError(f"weights must have shape {(len(series),)}, not {factors.shape}", item="weights")
    if (factors < 0).any() or not factors.any():
        raise InputError("weights must not be negative, and one of them must be positive", item="weights")
    factors = factors / factors.max()
    if factors.sum() <= (1 + 1e-12) * factors.max():
        raise InputError(
            f"sample {int(np.argmax(factors))} has all of the weight, and one sample has no error; sample longer",
            item="weights",
        )
    return series, factors / factors.mean()


def _mean(series: FloatArray, factors: FloatArray) -> FloatArray:
    return np.asarray(factors @ series / factors.sum())


def _linearized(series: FloatArray, factors: FloatArray) -> FloatArray:
    """What the ratio sum w f/sum w fluctuates by, sample by sample: its mean is 0."""
    return factors[:, None] * (series - _mean(series, factors)) / factors.mean()
