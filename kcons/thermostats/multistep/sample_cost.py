"""What an independent sample costs in evaluations of the forces."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import numbers, positive
from kcons.errors import InputError
from kcons.thermostats.correlated_series import FEWEST


def autocorrelation_time(values: ArrayLike) -> float:
    """Statistical inefficiency 1 + 2 sum rho(k) of a series, in values: so many of them are one independent sample.

    The sum goes on as long as sums of two neighbouring correlations are positive and fall (Geyer's initial monotone
    sequence). 1 for a series that does not change. It tells what a sample costs in a long run; the error of a mean,
    which also knows of slow parts that noise hides, is that of `mean`.

    Raises
    ------
    InputError
        Fewer than 32 values, or values that are not finite.
    """
    series = numbers(values, "values")
    if series.ndim != 1 or len(series) < FEWEST or not np.isfinite(series).all():
        raise InputError(f"give {FEWEST} finite values or more, one after another, not {series.shape}", item="values")
    n = len(series)
    off = series - series.mean()
    power = np.fft.rfft(off, 2 * n)
    covariance = np.fft.irfft(power * power.conj(), 2 * n)[:n]
    if not covariance[0] > (1e-12 * np.abs(series).max()) ** 2 * n:
        return 1.0
    rho = covariance / covariance[0]
    pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    falling = np.minimum.accumulate(pairs[: ends[0] if len(ends) else len(pairs)])
    return max(1.0, float(2 * falling.sum() - 1))


def evaluations_per_sample(values: ArrayLike, evaluations: float) -> float:
    """Evaluations of the (slow) forces for one independent sample of what was observed.

    Parameters
    ----------
    values : array_like, shape (n_values,)
        An observable along a run, after equilibration.
    evaluations : float
        Of the forces in question from one value to the next, for example from `ForceGroups.evaluations`.

    Raises
    ------
    InputError
        As for `autocorrelation_time`; evaluations not positive.
    """
    return positive(evaluations, "evaluations") * autocorrelation_time(values)
