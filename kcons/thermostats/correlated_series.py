"""Errors of means and slopes of values along a run, which depend on their neighbors.

The error of a mean follows from the spectrum of the series at frequency zero. A spectrum is described by a level N, and
a shape L that makes it R N at frequency zero,

    S(f) = N (1 + (R - 1) L(f)),   L(0) = 1.

L is that of an exponential memory (a Lorentzian), or of an oscillator that is damped critically or less. R > 1 is
something slow, beside whatever noise there is; R < 1 are values that swing back; R = 1 are independent values. All
memories up to a sixth of the series, with several frequencies each, and all R are tried on the 16 to 64 slowest cosines
of the series (DCT-II), by the likelihood of what is left when the mean (or the line) is taken out. The error is the
average over all of them: a slow part that a run barely shows counts as far as the run leaves it likely.
"""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Fewest values that `mean` takes an error from; independent ones below which it is not to be relied on, so that runs
#: of 5 are told of 19 times in 20, and runs of 30 once in 50; the same of blocks that make up the spread.
MIN_SAMPLES, FEW_INDEPENDENT, _FEW_BLOCKS = 32, 15, 10
#: Cosines of a long series. Their number is halved while the faster ones have hardly anything of the spread and
#: `_FEWEST_COSINES` remain: what matters is how the spectrum begins, not how smooth a series is from value to value.
_COSINES, _FEWEST_COSINES, _SMOOTH = 64, 16, 0.8
#: Shortest memory times the number of cosines, longest as a part of the series, and how many are tried between them.
_SHORTEST, _LONGEST, _MEMORIES = 0.35, 1 / 6, 18
#: Oscillators, by frequency times memory (0.05 stands for critical damping), and their shortest period times the number
#: of cosines.
_OSCILLATORS, _PERIOD = (0.05, 2.0, 3.5, 6.0, 10.0), 1.3
#: Smallest part of the level N that a spectrum with R < 1 falls to.
_LOWEST = 0.02
#: ln R. Before the values are seen R is 1 within a factor of 7 or so (a Cauchy distribution of this width).
_LOG_R: FloatArray = np.linspace(-math.log(64.0), math.log(4096.0), 48)
_WIDTH = 2.0
#: Before the values are seen a memory t has the density t^-0.4 in ln t. Chosen, with the bounds of R, so that errors
#: are right on average for series of 20 memories and more, whether all of a series is slow or a small part of it.
_SLOWER = 0.4
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
    """Standard error of the mean of a series, and how many independent values would give the same.

    Where fewer than 10 blocks make up the spread, as of a distribution with heavy tails, at most so many.
    """

    error: float
    independent: float


def _cosines(values: FloatArray) -> FloatArray:
    """The orthonormal cosine transform (DCT-II) along the first axis."""
    from scipy.fft import dct  # slow to import

    return np.asarray(dct(values, axis=0, norm="ortho"))


@lru_cache(maxsize=4)
def _processes(cosines: int, degree: int) -> tuple[FloatArray, ...]:
    """All that are tried, for the mean (degree 0) or the slope (1) of as many values as cosines, at level 1.

    Axes, shape (p, k, cosines), along which the cosines are independent; weights 1/S along these, shape (p, r, k); the
    variance of the mean or the slope, shape (p, r); ln of how likely each is but for the level, shape (p, r), -inf
    where a spectrum would be negative. Of p shapes with r ratios each.
    """
    k, t = np.arange(cosines), np.arange(cosines, dtype=np.float64)
    design = _cosines(np.vander(t - t.mean(), degree + 1))
    inside = np.linalg.qr(design, mode="complete")[0][:, degree + 1 :]
    rule = np.linalg.pinv(design)[0]
    same_parity = (k[:, None] - k) % 2 == 0
    found = []
    for turn in (0.0, *_OSCILLATORS):
        for memory in np.geomspace(_SHORTEST / cosines, _LONGEST, _MEMORIES):
            if 2 * math.pi * memory * cosines < _PERIOD * turn:
                continue
            # Of Re(a exp(-z|t|)) in a series of length 1: the spectrum, and what its two ends take from it.
            z, a = complex(1.0, -turn) / memory, complex(1.0, -1.0 / turn if turn else 0.0)
            lorentz = z / (z**2 + (math.pi * k) ** 2)
            ends = np.where(k, math.sqrt(2.0), 1.0) * lorentz
            ends = same_parity * np.outer(ends, ends * (1.0 - np.where(k % 2, -1.0, 1.0) * np.exp(-z)))
            covariance = (a * (np.diag(lorentz) - ends)).real / (a / z).real
            sizes, axes = np.linalg.eigh(inside.T @ covariance @ inside)
            spectrum = 1.0 + np.expm1(_LOG_R)[:, None] * sizes
            allowed = spectrum[:, -1] > _LOWEST
            spectrum[~allowed] = 1.0
            prior = -_SLOWER * math.log(memory * cosines / _SHORTEST) - np.log1p((_LOG_R / _WIDTH) ** 2)
            prior -= 0.5 * np.log(spectrum).sum(axis=1)
            own = rule @ rule + np.expm1(_LOG_R) * (rule @ covariance @ rule)
            found.append((axes.T @ inside.T, 1.0 / spectrum, own, np.where(allowed, prior, -np.inf)))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def _error(values: FloatArray, degree: int) -> tuple[float, int]:
    """Standard error of the mean (degree 0), or of the slope by the index (1); the number of cosines it was taken from.

    Of values whose mean, and slope, is 0.
    """
    # In the fastest third the spectrum of values at intervals is not that of a continuous motion.
    found = _cosines(values)[: min(_COSINES, max(2 * len(values) // 3, _FEWEST_COSINES))]
    while len(found) >= 2 * _FEWEST_COSINES:
        squares = found**2
        if squares @ np.cos(np.pi / len(found) * np.arange(len(found))) <= _SMOOTH * squares.sum():
            break
        found = found[: len(found) // 2]
    count = len(found)
    axes, weights, own, prior = _processes(count, degree)
    along = (axes @ found) ** 2
    level = np.maximum((weights @ along[..., None])[..., 0] / along.shape[1], np.finfo(float).tiny)
    likely = prior - 0.5 * along.shape[1] * np.log(level)
    likely = np.exp(likely - likely.max())
    error = float((likely * np.sqrt(level * np.maximum(own, 0.0))).sum() / likely.sum())
    return error * (count / len(values)) ** (0.5 + degree), count


def spread(series: FloatArray) -> Spread:
    """Error of the mean of finite values, shape (n,) with n >= 3; 0 where they differ by rounding."""
    off = series - series.mean()
    variance = float(off @ off) / (len(off) - 1)
    if not variance > (_ROUNDING * float(np.abs(series).max())) ** 2:
        return Spread(0.0, float(len(series)))
    off = off / math.sqrt(variance)
    error, count = _error(off, 0)
    size = len(off) // count
    blocks = off[: size * count].reshape(count, size).mean(axis=1)
    squares = (blocks - blocks.mean()) ** 2
    # The number of blocks where these are normal; 3 where one has all of the spread.
    carriers = 3.0 * float(squares.sum()) ** 2 / max(float((squares**2).sum()), np.finfo(float).tiny)
    most = carriers if carriers < _FEW_BLOCKS else math.inf
    return Spread(error * math.sqrt(variance), min(1.0 / error**2, most))


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
        Fewer than 15 independent values. Some runs with far fewer are not noticed: errors are too small.
    """
    series = as_float_array(values, "values")
    if series.ndim != 1 or len(series) < MIN_SAMPLES:
        raise InputError(f"{series.shape} values are too few for an error; give {MIN_SAMPLES} or more", item="values")
    if not np.isfinite(series).all():
        bad = int(np.argmin(np.isfinite(series)))
        raise InputError(f"number {bad} of values is not finite; leave it out", item="values")
    found = spread(series)
    if doubt := few(len(series), found.independent):
        warnings.warn(doubt, UserWarning, stacklevel=2)
    return Estimate(float(series.mean()), found.error)


def slope(times: FloatArray, values: FloatArray) -> Estimate:
    """Slope of values by least squares; n >= 3 finite values at about equal distances."""
    t = times - times.mean()
    square = float(t @ t)
    steep = float(t @ values) / square
    left = values - values.mean() - steep * t
    n, size = len(t), float(np.sqrt(np.mean(left * left)))
    if not size > _ROUNDING * float(np.abs(values).max()):
        return Estimate(steep, size / math.sqrt(square))
    return Estimate(steep, size * _error(left / size, 1)[0] * math.sqrt(n * (n * n - 1) / 12.0 / square))
