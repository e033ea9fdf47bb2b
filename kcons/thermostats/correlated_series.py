"""Errors of means and slopes of values along a run, which depend on their neighbors.

The error of a mean follows from the spectrum of the series at frequency zero. A spectrum is described by a level N, and
a shape L that makes it R N at frequency zero,

    S(f) = N (1 + (R - 1) L(f)),   L(0) = 1.

L is that of an exponential memory (a Lorentzian), or of an oscillator that is damped critically or less. R > 1 is
something slow, beside whatever noise there is; R < 1 are values that swing back; R = 1 are independent values. All
memories from a third of a block to a sixth of the series, with several frequencies each, and all R are tried on the
means of 16 to 127 blocks, by the likelihood of what is left when the mean (or the line) is taken out. The error is the
average over all of them: a slow part that a run barely shows counts as far as the run leaves it likely.
"""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array, positive
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Fewest values that `mean` takes an error from, and independent ones below which it is not to be relied on.
MIN_SAMPLES, FEW_INDEPENDENT = 32, 10
#: Fewest blocks of a long series. They are joined in pairs while neighbors are so alike and `_JOINED` remain: what
#: matters is how the spectrum begins, not how smooth a series is from value to value.
_BLOCKS, _JOINED, _ALIKE = 64, 16, 0.8
#: Shortest memory in blocks, longest as a part of the series, and how many are tried between them.
_SHORTEST, _LONGEST, _MEMORIES = 0.35, 1 / 6, 12
#: Oscillators, by frequency times memory (0.05 stands for critical damping), how likely each is against an exponential
#: memory before the values are seen, and their shortest period in blocks.
_OSCILLATORS, _RARER, _PERIOD = (0.05, 2.0, 4.0, 10.0), 0.4, 1.3
#: Smallest part of the level N that a spectrum with R < 1 falls to.
_LOWEST = 0.05
#: ln R. Before the values are seen R is 1 within a factor of 7 or so (a Cauchy distribution of this width).
_LOG_R: FloatArray = np.linspace(-math.log(16.0), math.log(4096.0), 48)
_WIDTH = 2.0
#: Before the values are seen a memory t has the density t^-0.25 in ln t. Chosen, with the bounds of R, so that errors
#: are right on average for series of 20 memories and more, whether all of a series is slow or a small part of it.
_SLOWER = 0.25
#: Spread relative to the values below which it is rounding.
_ROUNDING = 1e-13


class Estimate(NamedTuple):
    """A mean and its standard error."""

    value: float
    error: float

    def off(self, expected: float, error: float = 0.0) -> float:
        """Distance from `expected` (known to `error`) in standard errors; infinite where both are known exactly."""
        away, doubt = self.value - expected, math.hypot(self.error, error)
        if not doubt:
            return math.copysign(math.inf, away) if away else 0.0
        return away / doubt


class Spread(NamedTuple):
    """Of the mean of a series.

    Attributes
    ----------
    error : float
        Standard error.
    independent : float
        As many independent values would give the same error. Where fewer than 10 blocks make up the spread, as of a
        distribution with heavy tails, at most so many.
    """

    error: float
    independent: float


class _Process(NamedTuple):
    """Covariances between blocks: along their axes, of the mean or the slope, and ln of how likely the process is."""

    sizes: FloatArray
    axes: FloatArray
    own: float
    prior: float


@lru_cache(maxsize=4)
def _processes(blocks: int, degree: int) -> tuple[list[_Process], float]:
    """All that are tried, and for independent blocks of unit variance the variance of the mean or of the slope."""
    t = np.arange(blocks, dtype=np.float64)
    design = np.vander(t - t.mean(), degree + 1)
    inside = np.linalg.qr(design, mode="complete")[0][:, degree + 1 :]
    rule = np.linalg.pinv(design)[0]
    apart = np.abs(np.subtract.outer(t, t)).astype(np.int64)
    found = []
    for turn in (0.0, *_OSCILLATORS):
        for memory in np.geomspace(_SHORTEST, blocks * _LONGEST, _MEMORIES):
            if 2 * math.pi * memory < _PERIOD * turn:
                continue
            # Means over blocks of Re(a exp(-z|t|)), of which the sum over all lags is Re(2 a/z).
            z, a = complex(1.0, -turn) / memory, complex(1.0, -1.0 / turn if turn else 0.0)
            lags = (a / z**2 * (np.cosh(z) - 1.0) * np.exp(-z * t)).real
            lags[0] = (a / z * (1.0 - (1.0 - np.exp(-z)) / z)).real
            covariance = (lags / (a / z).real)[apart]
            sizes, axes = np.linalg.eigh(inside.T @ covariance @ inside)
            prior = math.log(_RARER if turn else 1.0) - _SLOWER * math.log(memory / _SHORTEST)
            found.append(_Process(sizes, axes.T @ inside.T, float(rule @ covariance @ rule), prior))
    return found, float(rule @ rule)


def _means(values: FloatArray, size: int) -> FloatArray:
    count = len(values) // size
    return np.asarray(values[: size * count].reshape(count, size).mean(axis=1))


def _error(values: FloatArray, degree: int) -> tuple[float, FloatArray]:
    """Standard error of the mean (degree 0), or of the slope by the index (1); the blocks it was taken from.

    Of values whose mean, and slope, is 0.
    """
    size = max(len(values) // _BLOCKS, 1)
    blocks = _means(values, size)
    while len(blocks) >= 2 * _JOINED and blocks[1:] @ blocks[:-1] > _ALIKE * float(blocks @ blocks):
        size *= 2
        blocks = _means(values, size)
    count = len(blocks)
    processes, plain = _processes(count, degree)
    logarithms, errors = [], []
    for process in processes:
        log_r = _LOG_R[1.0 + np.expm1(_LOG_R) * process.sizes[-1] > _LOWEST]
        more = np.expm1(log_r)
        spectrum = 1.0 + more[:, None] * process.sizes
        level = ((process.axes @ blocks) ** 2 / spectrum).sum(axis=1) / len(process.sizes)
        level = np.maximum(level, np.finfo(float).tiny)
        likely = -0.5 * (len(process.sizes) * np.log(level) + np.log(spectrum).sum(axis=1))
        logarithms.append(likely - np.log1p((log_r / _WIDTH) ** 2) + process.prior)
        errors.append(np.sqrt(level * (plain + more * process.own)))
    found = np.concatenate(logarithms)
    weights = np.exp(found - found.max())
    error = float(weights @ np.concatenate(errors) / weights.sum())
    return error * (size * count / len(values)) ** (0.5 + degree) * size**-degree, blocks


def spread(series: FloatArray) -> Spread:
    """Error of the mean of finite values, shape (n,) with n >= 3; 0 where they differ by rounding."""
    off = series - series.mean()
    variance = float(off @ off) / (len(off) - 1)
    if not variance > (_ROUNDING * float(np.abs(series).max())) ** 2:
        return Spread(0.0, float(len(series)))
    off = off / math.sqrt(variance)
    error, blocks = _error(off, 0)
    squares = (blocks - blocks.mean()) ** 2
    # The number of blocks where these are normal; 3 where one has all of the spread.
    carriers = 3.0 * float(squares.sum()) ** 2 / max(float((squares**2).sum()), np.finfo(float).tiny)
    independent = 1.0 / error**2
    return Spread(
        error * math.sqrt(variance), min(independent, carriers) if carriers < FEW_INDEPENDENT else independent
    )


def checked(series: FloatArray, item: str) -> FloatArray:
    """The same series, if an error can be taken from it; `InputError` otherwise."""
    if series.ndim != 1 or len(series) < MIN_SAMPLES:
        raise InputError(f"{series.shape} {item} are too few for an error; give {MIN_SAMPLES} or more", item=item)
    if not np.isfinite(series).all():
        bad = int(np.argmin(np.isfinite(series)))
        raise InputError(f"number {bad} of {item} is not finite; leave it out", item=item)
    return series


def few(n: int, independent: float) -> str | None:
    """What is to be said of an error from so few independent values; None of one that is all right."""
    if independent >= FEW_INDEPENDENT:
        return None
    return (
        f"{n} values are worth {independent:.1f} independent ones, or a few of them make up the spread: the error is "
        "not to be relied on. Sample longer"
    )


def mean(values: ArrayLike) -> Estimate:
    """Mean of correlated values with its standard error.

    Parameters
    ----------
    values : array_like, shape (n,)
        At equal distances along a run.

    Raises
    ------
    InputError
        Fewer than 32 values; a NaN or infinity.

    Warns
    -----
    UserWarning
        Fewer than 10 independent values.
    """
    series = checked(as_float_array(values, "values"), "values")
    found = spread(series)
    doubt = few(len(series), found.independent)
    if doubt:
        warnings.warn(doubt, UserWarning, stacklevel=2)
    return Estimate(float(series.mean()), found.error)


def autocorrelation_time(values: ArrayLike) -> float:
    """Statistical inefficiency 1 + 2 sum rho(k) of a series, in values: so many of them are one independent sample.

    The sum goes on as long as sums of two neighboring correlations are positive and fall (Geyer's initial monotone
    sequence, Stat. Sci. 7, 473 (1992)). It is for long runs, where it is known to a few percent. The error of a mean is
    that of `mean`, which also knows of slow parts that noise hides.

    1 for a series that does not change, or whose values swing back.

    Raises
    ------
    InputError
        Fewer than 32 values; a NaN or infinity.
    """
    series = checked(as_float_array(values, "values"), "values")
    n = len(series)
    off = series - series.mean()
    power = np.fft.rfft(off, 2 * n)
    covariance = np.fft.irfft(power * power.conj(), 2 * n)[:n]
    if not covariance[0] > (_ROUNDING * float(np.abs(series).max())) ** 2 * n:
        return 1.0
    pairs = (covariance / covariance[0])[: n - n % 2].reshape(-1, 2).sum(axis=1)
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


def slope(times: FloatArray, values: FloatArray) -> Estimate:
    """Slope of values by least squares; n >= 3 finite values at about equal distances."""
    t = times - times.mean()
    square = float(t @ t)
    steep = float(t @ values) / square
    left = values - values.mean() - steep * t
    n, size = len(t), float(np.sqrt(np.mean(left * left)))
    if not size > _ROUNDING * float(np.abs(values).max()):
        return Estimate(steep, size / math.sqrt(square))
    error = size * _error(left / size, 1)[0]
    return Estimate(steep, error * math.sqrt(n * (n * n - 1) / 12.0 / square))
