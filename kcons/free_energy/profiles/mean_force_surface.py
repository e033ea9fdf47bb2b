"""Free energy in several coordinates from the mean forces of windows, wherever these are.

A Gaussian process learned from the vectors (`gaussian_process`): least squares on as many functions as there are
components, with the errors and the lengths that make the vectors most likely. Only gradients can be fitted by it. How
much more likely the vectors are if their components need not belong to one free energy is the check of consistency.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.stats import chi2

from kcons.constraints.arguments import FloatArray, as_float_array, positive
from kcons.constraints.target import nearest_image
from kcons.errors import InputError
from kcons.free_energy.averages import finite
from kcons.free_energy.profiles.gaussian_process import Axis, GradientProcess, Learned, inside, learn
from kcons.thermostats import Estimate

#: Sizes of the field that is no gradient, relative to the gradient, among which the most likely one is looked for.
_ROTATIONS = np.geomspace(0.01, 3.0, 12)
#: Probability below which that field is warned of.
_CHANCE = 1e-3
#: Distance, in parts of the range, below which two minima are one.
_SAME = 1e-3
#: Places whose errors are computed at once, with the covariances among them.
_TOGETHER = 200


class Minimum(NamedTuple):
    """A minimum of a surface: where, F and the standard error of F, both against the zero of the surface."""

    x: FloatArray
    F: float
    error: float


@dataclass(frozen=True, eq=False)
class Surface:
    """A free energy in d coordinates.

    Attributes
    ----------
    windows, mean_forces : ndarray, shape (n, d)
    low, high : ndarray, shape (d,)
        The range of the windows, or one period.
    periods : tuple of float or None
    zero : ndarray, shape (d,)
        Where F is 0.
    """

    windows: FloatArray
    mean_forces: FloatArray
    low: FloatArray
    high: FloatArray
    periods: tuple[float | None, ...]
    zero: FloatArray
    _process: Learned

    def free_energy(self, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """F and its standard error, both against `zero`, at places of shape (m, d)."""
        places = self._places(x)
        F, variance = np.zeros(len(places)), np.zeros(len(places))
        for k in range(0, len(places), _TOGETHER):
            part = slice(k, k + _TOGETHER)
            F[part], covariance = self._process.differences(places[part], self.zero)
            variance[part] = np.diag(covariance)
        return F, np.sqrt(np.maximum(variance, 0.0))

    def difference(self, a: ArrayLike, b: ArrayLike) -> Estimate:
        """F(b) - F(a) with its standard error."""
        ends = [as_float_array(place, item) for place, item in ((a, "a"), (b, "b"))]
        if any(end.shape != self.low.shape for end in ends):
            raise InputError(f"a and b must be places of {len(self.low)} coordinates", item="a")
        return self._process.difference(*self._places(np.stack(ends)))

    def minima(self) -> list[Minimum]:
        """Minima inside of the range, lowest first; each is what a search from some window comes to."""
        size, periods = self.high - self.low, np.array([period or 0.0 for period in self.periods])
        bounds = [(0.0, 1.0) if period is None else (None, None) for period in self.periods]
        how: dict[str, Any] = {"jac": True, "method": "L-BFGS-B", "bounds": bounds, "options": {"ftol": 1e-13}}

        def value(part: FloatArray) -> tuple[float, FloatArray]:
            there = self._process.mean((self.low + part * size)[None], range(-1, len(size)))[:, 0]
            return float(there[0]), there[1:] * size

        found: list[FloatArray] = []
        for start in self.windows:
            (place,) = self._places((self.low + minimize(value, (start - self.low) / size, **how).x * size)[None])
            at_an_end = (periods == 0) & ((place <= self.low) | (place >= self.high))
            known = (np.abs(nearest_image(place - other, periods) / size).max() <= _SAME for other in found)
            if not at_an_end.any() and not any(known):
                found.append(place)
        if not found:
            return []
        F, errors = self.free_energy(found)
        minima = [Minimum(x, float(value), float(error)) for x, value, error in zip(found, F, errors, strict=True)]
        return sorted(minima, key=lambda minimum: minimum.F)

    def _places(self, x: ArrayLike) -> FloatArray:
        return inside(x, self.low, self.high, self.periods, "x")


def fit_surface(
    x: ArrayLike,
    f: ArrayLike,
    errors: ArrayLike,
    *,
    periods: Sequence[float | None] | None = None,
    zero: ArrayLike | None = None,
) -> Surface:
    """Free energy in d coordinates from the mean forces of n windows, on a grid or not.

    The time goes with the third power of n d: some hundred windows in two coordinates take seconds to a minute.

    Parameters
    ----------
    x : array_like, shape (n, d)
        Places of the windows.
    f : array_like, shape (n, d)
        The gradient of the free energy there.
    errors : array_like, shape (n, d) or (n, d, d)
        Standard errors of f, or covariances of its components.
    periods : sequence of d periods, optional
        None for a coordinate that is not periodic.
    zero : array_like, shape (d,), optional
        Where F is 0; by default at the lowest window.

    Raises
    ------
    InputError
        Fewer than d + 2 windows; a NaN or infinity; shapes that do not go together; a covariance that is none;
        windows further apart than a period.

    Warns
    -----
    UserWarning
        The mean forces are not the gradient of any free energy.
    """
    places, forces, covariances, turns = _checked(x, f, errors, periods)
    d, low = places.shape[1], places.min(axis=0)
    lengths = np.array([spread if p is None else p for spread, p in zip(np.ptp(places, axis=0), turns, strict=True)])
    axes = [Axis(float(a), float(b), p is not None) for a, b, p in zip(low, lengths, turns, strict=True)]
    process = learn(places, forces, covariances, axes, [p is None for p in turns])
    if d > 1:
        _warn_of_rotation(process.best)
    if zero is None:
        lowest = places[np.argmin(process.mean(places, [-1])[0])]
    else:
        lowest = as_float_array(zero, "zero")
        if lowest.shape != (d,) or not np.isfinite(lowest).all():
            raise InputError(f"zero must be {d} finite numbers", item="zero")
    surface = Surface(places, forces, low, low + lengths, turns, lowest, process)
    surface._places(lowest[None])
    return surface


def _warn_of_rotation(process: GradientProcess) -> None:
    """Warn where a field that is no gradient makes the vectors more likely, all lengths as they are."""
    found = [replace(process, rotation=float(size)).log_likelihood() for size in _ROTATIONS]
    best = int(np.argmax(found))
    # By the ratio of likelihoods. The size cannot be negative: chance has it at 0 half of the time.
    chance = 0.5 * float(chi2.sf(2 * (found[best] - process.log_likelihood()), 1))
    if chance < _CHANCE:
        warnings.warn(
            f"the mean forces are no gradient: a field beside it of {_ROTATIONS[best]:.0%} of its size is more likely "
            f"(p = {chance:.1e}). Windows are in different states of what is not held, or their errors are too small",
            UserWarning,
            stacklevel=3,
        )


def _checked(
    x: ArrayLike, f: ArrayLike, errors: ArrayLike, periods: Sequence[float | None] | None
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[float | None, ...]]:
    places, forces, given = (finite(a, name, "window") for a, name in ((x, "x"), (f, "f"), (errors, "errors")))
    if places.ndim != 2 or not places.shape[1] or len(places) < places.shape[1] + 2:
        raise InputError(f"x has shape {places.shape}; give (n, d) with n of d + 2 or more", item="x")
    n, d = places.shape
    if forces.shape != (n, d):
        raise InputError(f"f must have shape {(n, d)}, not {forces.shape}", item="f")
    if given.shape not in ((n, d), (n, d, d)):
        raise InputError(f"errors must have shape {(n, d)} or {(n, d, d)}, not {given.shape}", item="errors")
    if given.ndim == 2 and (given < 0).any():
        raise InputError(f"an error of window {np.argwhere(given < 0)[0, 0]} is negative", item="errors")
    covariances = given if given.ndim == 3 else given[:, :, None] ** 2 * np.eye(d)
    sizes = np.linalg.eigvalsh(covariances)
    skew = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2))
    bad = np.flatnonzero((sizes[:, 0] < -1e-9 * np.abs(sizes[:, -1])) | (skew > 1e-9 * np.abs(sizes).max(axis=1)))
    if len(bad):
        raise InputError(f"the covariance of window {bad[0]} is not symmetric and positive", item="errors")
    turns = tuple(None if p is None else positive(p, "periods") for p in ((None,) * d if periods is None else periods))
    if len(turns) != d:
        raise InputError(f"periods must be {d} positive numbers or None", item="periods")
    for j, (spread, period) in enumerate(zip(np.ptp(places, axis=0), turns, strict=True)):
        if spread == 0 or (period is not None and spread > period * (1 + 1e-9)):
            reason = "windows are further apart than the period in" if spread else "all windows are at one value of"
            raise InputError(f"{reason} coordinate {j}; check the units, or leave it out", item="x")
    return places, forces, covariances, turns
