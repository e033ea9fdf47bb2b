"""Free energies from the mean forces of windows: along one coordinate with an error band, and in several.

F(b) - F(a) is the integral of dF/dx. It is that of a Gaussian process learned from the derivatives
(`gaussian_process`), linear in the mean forces, so that the covariance of all differences is known and not only errors
at points. The band has what the windows do not tell between them as well, and the process knows where the next window
helps most. In several coordinates only gradients can be fitted: how much more likely the vectors are if their
components need not belong to one free energy is the check of consistency.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from kcons.constraints.arguments import Finite, FloatArray, Positive, as_float_array, checked, positive, whole_number
from kcons.errors import InputError
from kcons.free_energy.averages import finite
from kcons.free_energy.profiles.gaussian_process import Axis, Learned, inside, learn
from kcons.thermostats import Estimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Points of a profile, and points at which a window may be proposed.
_POINTS = 201
#: Windows from which on lengths are learned that differ from place to place, and coefficients of those.
_MANY, _COEFFICIENTS = 7, 6
#: Standard errors by which a closed profile may miss its beginning before that is warned of.
_CLOSES = 4.0
#: Colors of figures, color-blind safe (Okabe and Ito), and standard errors of their bands.
_BLUE, _RED, _GREY, _BAND = "#0072B2", "#D55E00", "0.35", 2.0
#: Part of the largest variance of a mean force that is rounding.
_KNOWN = 1e-9
#: Part of the range of the windows below which places are the same.
_SAME = 1e-9
#: Sizes of the field that is no gradient, relative to the gradient, among which the most likely one is looked for.
_ROTATIONS = np.geomspace(0.01, 3.0, 12)
#: Probability below which that field is warned of.
_CHANCE = 1e-3
#: Places whose errors are computed at once, with the covariances among them.
_TOGETHER = 200


@dataclass(frozen=True, eq=False, repr=False)
class Profile:
    """A free energy along one coordinate, -kT ln of the probability density of x.

    Attributes
    ----------
    x, F : ndarray, shape (201,)
        Places from the first window to the last, and the free energy there; 0 at `zero`.
    error : ndarray, shape (201,)
        Standard errors of these differences.
    covariance : ndarray, shape (201, 201)
        Of these differences.
    zero : float
    windows, mean_forces, mean_force_errors : ndarray, shape (n,)
        What it was made of, in order. Mean forces are dF/dx.
    period : float or None
    closure : Estimate or None
        Integral of dF/dx over the period, which should be 0, before the profile was closed.
    """

    x: FloatArray
    F: FloatArray
    error: FloatArray
    covariance: FloatArray
    zero: float
    windows: FloatArray
    mean_forces: FloatArray
    mean_force_errors: FloatArray
    period: float | None
    closure: Estimate | None
    _process: Learned

    def __repr__(self) -> str:
        ends = f"{self.windows[0]:.6g} to {self.windows[-1]:.6g}"
        return f"<Profile: {len(self.windows)} windows from {ends}>"

    def __str__(self) -> str:
        """A line for each window, and how far the free energy reaches."""
        low, high = self.x[np.argmin(self.F)], self.x[np.argmax(self.F)]
        own = np.array([self.difference(self.zero, x) for x in self.windows])
        columns = zip(self.windows, self.mean_forces, self.mean_force_errors, *own.T, strict=True)
        rows = [f"{x:10.4f} {f:11.4f} +- {e:<9.4f} {F:10.4f} +- {dF:.4f}" for x, f, e, F, dF in columns]
        rise = self.difference(low, high)
        end = f"from {low:.4g} to {high:.4g} F rises by {rise.value:.4g} +- {rise.error:.2g}"
        return "\n".join([f"{'window':>10} {'dF/dx':>11}{'':13} {'F':>10}", *rows, end])

    def difference(self, a: float, b: float) -> Estimate:
        """F(b) - F(a) with its standard error."""
        ends = inside([[a], [b]], self.x[:1], self.x[-1:], [self.period], "ends of the difference")
        return self._process.difference(*ends)

    def lower_than(self, energy: float) -> NDArray[np.bool_]:
        """At which places of the profile F is at most so much above its lowest value."""
        return np.asarray(self.F - self.F.min() <= energy)

    def next_windows(self, count: int, *, below: float | None = None) -> list[float]:
        """Where more windows would tell most, if they were sampled as long as those that are there.

        Each is put where the variance of all differences of free energy together is reduced most (Bayesian
        quadrature: Kempkes and Perez de Alba Ortiz, arXiv 2601.08783), taking those before it as done. A window has
        the error that its neighbors suggest.

        Parameters
        ----------
        count : int
        below : float, optional
            Only places count where the free energy is this much above its lowest value or less: rates and populations
            do not depend on the others.
        """
        grid = aims = self.x
        if below is not None:
            if not below > 0:
                raise InputError(f"below is {below}; give a positive energy", item="below")
            aims = grid[self.lower_than(below)]
        covariance = self._process.posterior((aims[:, None], [-1]), (grid[:, None], [0]))[1]
        noise = np.interp(grid, self.windows, self.mean_force_errors**2, period=self.period)
        m = len(aims)
        # What is known exactly has a variance of rounding, from which nothing more is to be learned.
        least = _KNOWN * float((np.diag(covariance)[m:] + noise).max())
        chosen = []
        taken = np.abs(grid[:, None] - self.windows).min(axis=1) < _SAME * np.ptp(grid)  # a place has one window
        for _ in range(whole_number(count, "count")):
            shared = covariance[:m, m:]
            variance = np.maximum(np.maximum(np.diag(covariance)[m:], 0.0) + noise, least)
            gain = ((shared - shared.mean(axis=0)) ** 2).sum(axis=0) / variance
            best = int(np.argmax(np.where(taken, -1.0, gain)))
            taken[best] = True
            column = covariance[:, m + best]
            covariance = covariance - np.outer(column, column) / variance[best]
            chosen.append(float(grid[best]))
        return chosen


@checked
def integrate(
    x: ArrayLike, f: ArrayLike, e: ArrayLike, *, period: Positive | None = None, zero: Finite | None = None
) -> Profile:
    """Free energy along a coordinate from the mean forces of windows.

    Parameters
    ----------
    x : array_like, shape (n,)
        Places of the windows, in any order; radian for angles if f is per radian.
    f : array_like, shape (n,)
        dF/dx there: the slope of the free energy, not the force against it.
    e : array_like, shape (n,)
        Standard errors of f; 0 where it is exact.
    period : float, optional
        Of the coordinate: the profile goes once around, from the first window, and ends where it begins; `closure` says
        how far the mean forces were from that.
    zero : float, optional
        Where F is 0; by default where it is lowest.

    Raises
    ------
    InputError
        Fewer than 3 windows; a NaN or infinity; a negative error; windows further apart than the period; a place
        outside of the windows.

    Warns
    -----
    UserWarning
        The integral over the period is more than 4 standard errors from 0; windows around it miss a threefold barrier.
    """
    arrays = [finite(values, name, "window") for values, name in ((x, "x"), (f, "f"), (e, "e"))]
    for array, name in zip(arrays, "xfe", strict=True):
        if array.ndim != 1 or array.shape != arrays[0].shape:
            raise InputError(f"{name} must have shape {(arrays[0].size,)}, not {array.shape}", item=name)
    place, force, error = arrays
    if (error < 0).any():
        raise InputError(f"the error of window {int(np.argmin(error))} is negative", item="e")
    if period is not None and place.size:
        if np.ptp(place) > period * (1 + _SAME):
            said = f"windows are {np.ptp(place):g} apart, further than the period {period:g}; check the units"
            raise InputError(said, item="period")
        place = place.min() + (place - place.min()) % period
        place = np.where(place - place.min() > period * (1 - _SAME), place.min(), place)
    order = np.argsort(place, kind="stable")
    places, forces, errors = place[order], force[order], error[order]
    apart = np.diff(places, prepend=-np.inf) > _SAME * (np.ptp(places) if places.size else 0.0)
    exact = ~apart[1:] & (errors[1:] + errors[:-1] == 0) & (np.abs(np.diff(forces)) > 1e-9 * np.abs(forces[1:]))
    if exact.any():
        said = f"windows at {places[1:][exact][0]:g} have other mean forces, all with an error of 0"
        raise InputError(f"{said}; give their errors", item="e")
    different = int(apart.sum())
    if different < 3:
        raise InputError(f"{different} different windows are too few for a profile; give 3 or more", item="x")
    low, high = float(places[0]), float(places[-1] if period is None else places[0] + period)
    axis = Axis(low, high - low, period is not None, _COEFFICIENTS if different >= _MANY else 1)
    process, closure = learn(places[:, None], forces[:, None], errors[:, None, None] ** 2, [axis], [True]), None
    if period is not None:
        _tell_of_waves(places, period)
        closure = process.difference(np.array([low]), np.array([high]))
        if abs(closure.value) > _CLOSES * closure.error and abs(closure.value) > 1e-9 * period * np.abs(forces).max():
            warnings.warn(
                f"the mean force has the integral {closure.value:.4g} ± {closure.error:.2g} over the period, which "
                "should be 0: a window has not forgotten where it started from, or its error is too small",
                stacklevel=2,
            )
        process = process.closed()
    grid = np.linspace(low, high, _POINTS)
    if zero is None:
        zero = float(grid[np.argmin(process.mean(grid[:, None], [-1])[0])])
    F, covariance = process.differences(grid[:, None], inside([[zero]], grid[:1], grid[-1:], [period], "zero")[0])
    band = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Profile(grid, F, band, covariance, zero, places, forces, errors, period, closure, process)


def _tell_of_waves(places: FloatArray, period: float) -> None:
    """Warn where windows tell less of some sum of the waves of most torsions than one in the right place does."""
    waves = 2 * np.pi / period * np.outer(places, [1, 2, 3])
    sizes = np.linalg.svd(np.hstack([np.sin(waves), np.cos(waves)]), compute_uv=False)
    if len(places) < 6 or sizes[-1] < 1.0:
        said = f"a barrier that comes three times in the period {period:.4g} may have no slope at any of the windows"
        warnings.warn(f"{said}, and no error tells of it: give seven or more, about equally far apart", stacklevel=3)


def plot_profile(profile: Profile, *, coordinate: str = "x", energy: str = "energy") -> Figure:
    """The free energy with two standard errors above; below, what it was made of: mean forces of the windows.

    `coordinate` and `energy` are what the axes say.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 6.0), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for each in (above, below):
        each.grid(True, alpha=0.3)
    low, high = profile.F - _BAND * profile.error, profile.F + _BAND * profile.error
    above.fill_between(profile.x, low, high, color=_BLUE, alpha=0.25, linewidth=0, label=f"± {_BAND:g} standard errors")
    above.plot(profile.x, profile.F, color=_BLUE, label="F")
    above.set_ylabel(f"F / {energy}")
    above.legend(fontsize=8)
    below.plot(profile.x, np.gradient(profile.F, profile.x), color=_BLUE, linewidth=1.0, label="slope of F")
    how: dict[str, Any] = {"color": _RED, "fmt": "o", "markersize": 4, "capsize": 2, "label": "windows"}
    below.errorbar(profile.windows, profile.mean_forces, _BAND * profile.mean_force_errors, **how)
    below.axhline(0.0, color=_GREY, linewidth=0.8)
    below.set(xlabel=coordinate, ylabel=f"dF/dx / ({energy}/unit of x)")
    below.legend(fontsize=8)
    return figure


# -- several coordinates -----------------------------------------------------------------------------


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
        The mean forces are not the gradient of any free energy; windows around a period miss a threefold barrier.
    """
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
        if period is not None:
            _tell_of_waves(places[:, j], period)
    low = places.min(axis=0)
    lengths = np.array([spread if p is None else p for spread, p in zip(np.ptp(places, axis=0), turns, strict=True)])
    axes = [Axis(float(a), float(b), p is not None) for a, b, p in zip(low, lengths, turns, strict=True)]
    process = learn(places, forces, covariances, axes, [p is None for p in turns])
    if d > 1:
        # By the ratio of likelihoods, all lengths as they are. The size cannot be negative: chance has it at 0 half of
        # the time.
        found = [replace(process.best, rotation=float(size)).log_likelihood() for size in _ROTATIONS]
        best = int(np.argmax(found))
        chance = 0.5 * float(chi2.sf(2 * (found[best] - process.best.log_likelihood()), 1))
        if chance < _CHANCE:
            warnings.warn(
                f"the mean forces are no gradient: a field beside it of {_ROTATIONS[best]:.0%} of its size is more "
                f"likely (p = {chance:.1e}). Windows are in different states of what is not held, or their errors are "
                "too small",
                stacklevel=2,
            )
    if zero is None:
        lowest = places[np.argmin(process.mean(places, [-1])[0])]
    else:
        lowest = as_float_array(zero, "zero")
        if lowest.shape != (d,) or not np.isfinite(lowest).all():
            raise InputError(f"zero must be {d} finite numbers", item="zero")
    surface = Surface(places, forces, low, low + lengths, turns, lowest, process)
    surface._places(lowest[None])
    return surface
