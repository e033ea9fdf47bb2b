"""Free energy along one coordinate from the mean forces of windows: thermodynamic integration with an error band.

F(b) - F(a) is the integral of dF/dx. It is that of a Gaussian process learned from the derivatives
(`gaussian_process`), linear in the mean forces, so that the covariance of all differences is known and not only errors
at points. The band has what the windows do not tell between them as well, and the process knows where the next window
helps most.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import FloatArray, as_float_array, checked, positive, whole_number
from kcons.errors import InputError
from kcons.free_energy.averages import finite
from kcons.free_energy.profiles.gaussian_process import Axis, Learned, difference, learn
from kcons.thermostats import Estimate

#: Points of a profile unless they are given, and points at which a window may be proposed.
_POINTS = 201
#: Windows from which on lengths are learned that differ from place to place, and coefficients of those.
_MANY, _COEFFICIENTS = 7, 6
#: Standard errors by which a closed profile may miss its beginning before that is warned of.
_CLOSES = 4.0
#: Part of the largest variance of a mean force that is rounding.
_KNOWN = 1e-9
#: Part of the range of the windows below which places are the same.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class _Windows:
    """Mean forces in the order of their places, and the process learned from them."""

    x: FloatArray
    f: FloatArray
    e: FloatArray
    period: float | None

    @property
    def end(self) -> float:
        """Where the profile ends that begins at the first window."""
        return float(self.x[-1] if self.period is None else self.x[0] + self.period)

    @cached_property
    def learned(self) -> Learned:
        """Gaussian processes that need not close."""
        low, many = float(self.x[0]), len(self.x) >= _MANY
        axis = Axis(low, self.end - low, self.period is not None, _COEFFICIENTS if many else 1)
        return learn(self.x[:, None], self.f[:, None], self.e[:, None, None] ** 2, [axis], [True])

    @cached_property
    def _learned_closed(self) -> Learned:
        return self.learned.closed()

    def process(self, closed: bool) -> Learned:
        return self._learned_closed if closed else self.learned

    def values(self, at: FloatArray, closed: bool) -> tuple[FloatArray, FloatArray]:
        """Free energies up to a constant, and their covariance."""
        return self.process(closed).posterior((at[:, None], [-1]))


@dataclass(frozen=True, eq=False, repr=False)
class Profile:
    """A free energy along one coordinate.

    Attributes
    ----------
    x : ndarray, shape (m,)
    F : ndarray, shape (m,)
        Free energy less that at `zero`. As it comes from mean forces, -kT ln of the probability density of x.
    error : ndarray, shape (m,)
        Standard errors of these differences.
    covariance : ndarray, shape (m, m)
        Of these differences.
    zero : float
    windows, mean_forces, mean_force_errors : ndarray, shape (n,)
        What it was made of, in order. Mean forces are dF/dx.
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
    closure: Estimate | None
    _known: _Windows
    _added: Callable[[FloatArray], FloatArray] | None = None

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

    def _values(self, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        F, covariance = self._known.values(at, self._known.period is not None)
        return F if self._added is None else F + self._added(at), covariance

    def difference(self, a: float, b: float) -> Estimate:
        """F(b) - F(a) with its standard error."""
        return difference(*self._values(_places([a, b], self._known, "ends of the difference")))

    def lower_than(self, energy: float, at: FloatArray | None = None) -> NDArray[np.bool_]:
        """At which places (those of the profile by default) F is at most so much above its lowest value there."""
        F = self.F if at is None else self._values(at)[0]
        return np.asarray(F - F.min() <= energy)

    def without_jacobian(
        self, jacobian: Literal["distance", "angle"] | Callable[[FloatArray], FloatArray], thermal_energy: float
    ) -> Profile:
        """The 'geometric' free energy, -kT ln(P(x)/J(x)) = F + kT ln J(x).

        Two definitions are in use. F = -kT ln P(x) has in it how much room there is at x: two particles that do not
        interact have F = -2 kT ln r. Divided by the Jacobian J, P is a density in Cartesian coordinates, and these
        particles have a constant W = F + 2 kT ln r (the potential of mean force of the theory of liquids).
        Differences of F give rates and populations along x; W goes to 0 at large distances.

        Parameters
        ----------
        jacobian : {'distance', 'angle'} or callable
            J = x^2 of a distance in three dimensions; J = sin x of an angle in radian; any other J(x), positive.
        thermal_energy : float
            kT in the unit of F.

        Raises
        ------
        InputError
            J is not positive somewhere; kT is not positive; this profile has a Jacobian taken out already.
        """
        if self._added is not None:
            raise InputError("the Jacobian has been taken out of this profile already", item="jacobian")
        kT = positive(thermal_energy, "thermal_energy")
        known = {"distance": np.square, "angle": np.sin}
        J = known.get(jacobian) if isinstance(jacobian, str) else jacobian
        if J is None:
            raise InputError(f"unknown jacobian {jacobian!r}; give 'distance', 'angle' or J(x)", item="jacobian")

        def added(x: FloatArray) -> FloatArray:
            factor = np.asarray(J(x), dtype=float)
            if not (np.isfinite(factor) & (factor > 0)).all():
                worst = x[np.argmin(np.where(np.isfinite(factor), factor, -np.inf))]
                raise InputError(f"the Jacobian is not positive at {worst:g}", item="jacobian")
            return kT * np.log(factor)

        if jacobian == "distance" and self.x.min() <= 0:
            raise InputError(
                f"there is no distance of {self.x.min():g}; give the J(x) of this coordinate", item="jacobian"
            )
        shift = added(np.append(self.x, self.zero))
        return replace(self, F=self.F + shift[:-1] - shift[-1], _added=added)

    def added_slope(self, at: FloatArray) -> FloatArray:
        """What `without_jacobian` added to dF/dx, shape of `at`; 0 where it was not asked for."""
        if self._added is None:
            return np.zeros_like(at)
        step = 1e-6 * np.ptp(self.windows)
        return (self._added(at + step) - self._added(at - step)) / (2 * step)

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
        known = self._known
        grid = np.linspace(known.x[0], known.end, _POINTS)
        aims = grid
        if below is not None:
            if not below > 0:
                raise InputError(f"below is {below}; give a positive energy", item="below")
            aims = grid[self.lower_than(below, grid)]
        covariance = known.process(known.period is not None).posterior((aims[:, None], [-1]), (grid[:, None], [0]))[1]
        noise = np.interp(grid, known.x, known.e**2, period=known.period)
        m = len(aims)
        # What is known exactly has a variance of rounding, from which nothing more is to be learned.
        least = _KNOWN * float((np.diag(covariance)[m:] + noise).max())
        chosen = []
        for _ in range(whole_number(count, "count")):
            shared = covariance[:m, m:]
            variance = np.maximum(np.maximum(np.diag(covariance)[m:], 0.0) + noise, least)
            gain = ((shared - shared.mean(axis=0)) ** 2).sum(axis=0) / variance
            best = int(np.argmax(gain))
            column = covariance[:, m + best]
            covariance = covariance - np.outer(column, column) / variance[best]
            chosen.append(float(grid[best]))
        return chosen


@checked
def integrate(
    x: ArrayLike,
    f: ArrayLike,
    e: ArrayLike,
    *,
    period: float | None = None,
    zero: float | None = None,
    at: ArrayLike | None = None,
) -> Profile:
    """Free energy along a coordinate from the mean forces of windows.

    Parameters
    ----------
    x : array_like, shape (n,)
        Places of the windows, in any order; radian for angles if f is per radian.
    f : array_like, shape (n,)
        dF/dx there: the slope of the free energy, not the force against it. Windows at one place are put together.
    e : array_like, shape (n,)
        Standard errors of f; 0 where it is exact.
    period : float, optional
        Of the coordinate: the profile goes once around, from the first window, and ends where it begins; `closure` says
        how far the mean forces were from that.
    zero : float, optional
        Where F is 0; by default where it is lowest.
    at : array_like, shape (m,), optional
        Where F is given; by default at 201 points from the first window to the last.

    Raises
    ------
    InputError
        Fewer than 3 windows; a NaN or infinity; a negative error; windows further apart than the period; a place
        outside of the windows.

    Warns
    -----
    UserWarning
        The integral over the period is more than 4 standard errors from 0: some mean force is wrong, or its error.
    """
    known = _windows(x, f, e, period)
    points = np.linspace(known.x[0], known.end, _POINTS) if at is None else _places(at, known, "at")
    closure = None
    if period is not None:
        closure = difference(*known.values(np.array([known.x[0], known.end]), False))
        if abs(closure.value) > _CLOSES * closure.error and abs(closure.value) > 1e-9 * period * np.abs(known.f).max():
            warnings.warn(
                f"the mean force has the integral {closure.value:.4g} ± {closure.error:.2g} over the period, which "
                "should be 0: a window has not forgotten where it started from, or its error is too small",
                UserWarning,
                stacklevel=2,
            )
    if zero is None:
        inner = np.linspace(known.x[0], known.end, _POINTS)
        zero = float(inner[np.argmin(known.values(inner, period is not None)[0])])
    places = np.append(points, _places([zero], known, "zero"))
    F, covariance = known.values(places, period is not None)
    less = covariance[:-1, :-1] - covariance[:-1, -1:] - covariance[-1:, :-1] + covariance[-1, -1]
    error = np.sqrt(np.maximum(np.diag(less), 0.0))
    return Profile(points, F[:-1] - F[-1], error, less, zero, known.x, known.f, known.e, closure, known)


def _windows(x: ArrayLike, f: ArrayLike, e: ArrayLike, period: float | None) -> _Windows:
    """Windows in order; those at one place are one, with the weights that their errors give them."""
    arrays = [finite(values, name, "window") for values, name in ((x, "x"), (f, "f"), (e, "e"))]
    for array, name in zip(arrays, "xfe", strict=True):
        if array.ndim != 1 or array.shape != arrays[0].shape:
            raise InputError(f"{name} must have shape {(arrays[0].size,)}, not {array.shape}", item=name)
    place, force, error = arrays
    if (error < 0).any():
        raise InputError(f"the error of window {int(np.argmin(error))} is negative", item="e")
    if period is not None:
        positive(period, "period")
        if len(place) and np.ptp(place) > period * (1 + _SAME):
            raise InputError(
                f"windows are {np.ptp(place):g} apart, further than the period {period:g}; check the units",
                item="period",
            )
        place = place.min() + (place - place.min()) % period if len(place) else place
        place = np.where(place - place.min() > period * (1 - _SAME), place.min(), place) if len(place) else place
    # Places that differ by rounding are one.
    order = np.argsort(place, kind="stable")
    new = np.diff(place[order], prepend=-np.inf) > _SAME * np.ptp(place) if len(place) else np.zeros(0, dtype=bool)
    places, which = place[order][new], np.zeros(len(place), dtype=np.int64)
    which[order] = np.cumsum(new) - 1
    if len(places) < 3:
        raise InputError(f"{len(places)} different windows are too few for a profile; give 3 or more", item="x")
    for k in np.flatnonzero(np.bincount(which[error == 0], minlength=len(places)) > 1):
        exact = force[(which == k) & (error == 0)]
        if np.ptp(exact) > 1e-9 * np.abs(exact).max():
            raise InputError(
                f"windows at {places[k]:g} have mean forces from {exact.min():g} to {exact.max():g}, all with an error "
                "of 0; give their errors",
                item="e",
            )
    # Errors of 0 among others: exact values count alone.
    weights = (
        1.0 / np.maximum(error, 1e-12 * max(float(error.max()), np.finfo(float).tiny)) ** 2
        if error.any()
        else np.ones(len(error))
    )
    total = np.bincount(which, weights)
    together = np.bincount(which, weights * force) / total
    errors = np.sqrt(np.bincount(which, (weights * error) ** 2)) / total
    return _Windows(places, together, errors, period)


def _places(at: ArrayLike, known: _Windows, item: str) -> FloatArray:
    """Places within the range of the windows; into it by periods where there is one."""
    points = as_float_array(at, item)
    if points.ndim != 1 or not np.isfinite(points).all():
        raise InputError(f"{item} must be a list of finite numbers", item=item)
    low, high = float(known.x[0]), known.end
    slack = _SAME * (high - low)
    if known.period is not None:
        outside = (points < low - slack) | (points > high + slack)
        points = np.where(outside, low + (points - low) % known.period, points)
    elif (points < low - slack).any() or (points > high + slack).any():
        raise InputError(
            f"{item} goes beyond the windows, which are between {low:g} and {high:g}; add a window there", item=item
        )
    return np.clip(points, low, high)
