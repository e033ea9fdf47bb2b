"""A free energy in d coordinates as a Gaussian process of which the gradient is known at points.

Values and derivatives of a Gaussian process are jointly normal: with the covariance k(x, y) of the free energy, the
covariance of its gradients is the second derivative of k (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, section 9.4; for mean forces Stecher, Bernstein and Csanyi, J. Chem. Theory Comput. 10, 4079 (2014)).
So no integral has to be done: differences of the free energy and their covariance are solutions of one linear system.

The kernel is a product over coordinates of Matern kernels of u(x), an increasing function of the coordinate that is
learned with it. Where the free energy changes quickly u does, and windows are proposed there. u' is a cubic B-spline
with positive coefficients. A periodic coordinate is a circle, on which the distance is the chord, and its kernel is a
smoother one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import OptimizeResult, minimize, root

from kcons.constraints.arguments import FloatArray, as_float_array
from kcons.errors import InputError
from kcons.thermostats import Estimate

#: Of the diagonal, added to the covariance: rounding of a matrix of that size.
_ROUNDING = 1e-10
#: Prior standard deviations of the logarithms of amplitude, of length, and of neighboring local lengths.
_WIDE, _LOCAL = 1.5, 0.5
#: Prior standard deviation of a constant gradient, in units of the largest gradient seen.
_TREND = 10.0
#: Step along the imaginary axis, exact but for rounding.
_TINY = 1e-30
#: Step of differences of logarithms of hyperparameters, least curvature of the likelihood that is believed, and the
#: logarithm of the largest weight of a place against that of a normal distribution.
_STEP, _FLATTEST, _HEAVIEST = 0.05, 0.5, 2.0
#: By how much more the last parameter counts than the first where directions of the cubature are chosen.
_TILT = 1e-3
#: Part of the range of the windows below which places are the same.
_SAME = 1e-9
#: Largest logarithm of a parameter, and minus the log likelihood of those that are too smooth for double precision.
_FURTHEST, _IMPOSSIBLE = 7.0, 1e30
#: Lengths from which the search for the most likely ones starts, as parts of the range.
_STARTS = (0.3, 0.1)


@dataclass(frozen=True)
class Axis:
    """One coordinate: where it begins, and its range; its period if it is periodic."""

    low: float
    length: float
    periodic: bool
    #: Of u': 1 for the same length everywhere, or 4 and more.
    coefficients: int = 1

    def design(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Matrices of shape (n, coefficients) that give u and u' from the coefficients, in units of the range."""
        part = (x - self.low) / self.length
        k = self.coefficients
        if k == 1:
            return part[:, None], np.full((len(x), 1), 1.0 / self.length)
        if self.periodic:
            knots, basis = np.arange(-3, k + 4) / k, np.eye(k)[np.arange(k + 3) % k]
            turns = np.floor(part)
        else:
            inner = np.linspace(0.0, 1.0, k - 2)
            knots, basis = np.concatenate([np.zeros(3), inner, np.ones(3)]), np.eye(k)
            turns = np.zeros(len(part))
        spline = BSpline(knots, basis, 3)
        integral = spline.antiderivative()
        turn = integral(1.0) - integral(0.0)
        place = part - turns
        return integral(place) - integral(0.0) + turns[:, None] * turn, spline(place) / self.length


def inside(x: ArrayLike, low: FloatArray, high: FloatArray, periods: Sequence[float | None], item: str) -> FloatArray:
    """Places (m, d) within the range of the windows, into it by periods where there is one; refuses all others."""
    places = np.array(as_float_array(x, item))
    if places.ndim != 2 or places.shape[1] != len(low) or not np.isfinite(places).all():
        raise InputError(f"{item} must be finite numbers of shape (m, {len(low)})", item=item)
    for column, a, b, period in zip(places.T, low, high, periods, strict=True):
        outside = (column < a - _SAME * (b - a)) | (column > b + _SAME * (b - a))
        if period is not None:
            column[outside] = a + (column[outside] - a) % period
        elif outside.any():
            raise InputError(
                f"{item} {column[outside][0]:g} is beyond the windows, which are between {a:g} and {b:g}; add a window "
                "there",
                item=item,
            )
    return np.clip(places, low, high)


def _matern(square: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matern 7/2 of squared distances, with two derivatives by them: the mean force is as smooth as Matern 5/2."""
    a = np.sqrt(7 * square)
    decay = np.exp(-a)
    value = (1 + a + 0.4 * a**2 + a**3 / 15) * decay
    return value, -0.7 * (1 + a + a**2 / 3) * decay, 49 / 60 * (1 + a) * decay


def _smoother(square: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matern 11/2, for torsions: their free energies are sums of a few waves, without walls."""
    a = np.sqrt(11 * square)
    decay = np.exp(-a)
    value = (1 + a + (4 / 9) * a**2 + a**3 / 9 + a**4 / 63 + a**5 / 945) * decay
    slope = -(11 / 18) * (1 + a + (3 / 7) * a**2 + (2 / 21) * a**3 + a**4 / 105) * decay
    return value, slope, (121 / 252) * (1 + a + 0.4 * a**2 + a**3 / 15) * decay


class Points:
    """Points of shape (n, d), with what of u(x) does not depend on its coefficients."""

    def __init__(self, x: FloatArray, axes: Sequence[Axis]) -> None:
        self.x = x
        self.designs = [axis.design(column) for axis, column in zip(axes, x.T, strict=True)]


#: Points, and which components are meant at each: -1 the free energy, j its derivative by coordinate j.
Asked: TypeAlias = tuple[Points, Sequence[int]]


@dataclass(eq=False)
class GradientProcess:
    """What is known of a free energy from gradients (n, d) at points, with covariances (n, d, d) of their errors.

    `parameters` are logarithms of the amplitude, and of u' in units of the range; `trends` says along which coordinates
    the free energy may also grow by a constant slope; `rotation` is the size, relative to the gradient, of a field
    beside it whose components know nothing of each other: how far the vectors are from being any gradient.
    """

    points: Points
    gradients: FloatArray
    covariances: FloatArray
    axes: Sequence[Axis]
    parameters: FloatArray
    trends: Sequence[bool]
    rotation: float = 0.0

    def __post_init__(self) -> None:
        # Gradients that vanish within their errors may be as large as these.
        squares = self.gradients**2 + np.diagonal(self.covariances, axis1=1, axis2=2)
        lengths = [axis.length for axis in self.axes]
        self._size = float((np.sqrt(squares.mean(axis=0)) * lengths).max()) or 1.0
        steepest = math.sqrt(float(squares.max())) or 1.0
        self._slopes = [_TREND * steepest if free else 0.0 for free in self.trends]
        n, d = self.gradients.shape
        self._seen: Asked = (self.points, range(d))
        noise = np.einsum("ipq,ij->piqj", self.covariances, np.eye(n)).reshape(n * d, n * d)
        self._root = cholesky(self._prior(self.parameters) + noise, lower=True, check_finite=False)
        self._weights = cho_solve((self._root, True), self.gradients.T.ravel(), check_finite=False)

    def log_likelihood(self) -> float:
        """Of the gradients seen."""
        y = self.gradients.T.ravel()
        return -0.5 * float(y @ self._weights) - float(np.log(np.diag(self._root)).sum())

    def slope(self, directions: FloatArray) -> FloatArray:
        """Derivatives of the log likelihood along directions in the space of parameters, shape (k, parameters).

        Those of the covariance are complex steps.
        """
        inverse = cho_solve((self._root, True), np.eye(len(self._weights)), check_finite=False)
        kernel = 0.5 * (np.outer(self._weights, self._weights) - inverse)
        steps = (self._prior(self.parameters + _TINY * 1j * direction) for direction in directions)
        return np.array([float((kernel * step.imag).sum()) / _TINY for step in steps])

    def _prior(self, parameters: FloatArray) -> FloatArray:
        """Covariance of the gradients seen, without their errors; complex where the parameters are."""
        prior = self._covariance(self._seen, self._seen, parameters)
        prior[np.diag_indices(len(prior))] += _ROUNDING * np.trace(prior) / len(prior)
        return prior

    def _covariance(self, left: Asked, right: Asked, parameters: FloatArray | None = None) -> FloatArray:
        """Prior covariance, component by component, with the parameters of the process or others."""
        (one, rows), (other, columns) = left, right
        given = self.parameters if parameters is None else parameters
        logarithms = np.split(given[1:], np.cumsum([axis.coefficients for axis in self.axes])[:-1])
        factors = [np.exp(each) for each in logarithms]
        variance = (self._size * np.exp(given[0] - np.mean([each.mean() for each in logarithms]))) ** 2
        parts = [
            _parts(axis.periodic, factor, one.designs[j], other.designs[j])
            for j, (axis, factor) in enumerate(zip(self.axes, factors, strict=True))
        ]

        def block(p: int, q: int) -> FloatArray:
            product = variance * math.prod(part[p == j][q == j] for j, part in enumerate(parts))
            for j, slope in enumerate(self._slopes):
                if slope and p in (-1, j) and q in (-1, j):
                    ends = [
                        z.x[:, j] - self.axes[j].low if c == -1 else np.ones(len(z.x))
                        for z, c in ((one, p), (other, q))
                    ]
                    product = product + slope**2 * np.outer(*ends)
            if self.rotation and p == q >= 0:
                du, dw = (z.designs[p][1] @ factors[p] for z in (one, other))
                alike = math.prod(part[0][0] for part in parts)
                product = product + self.rotation**2 * variance * alike * np.outer(du, dw)
            return np.asarray(product)

        return np.block([[block(p, q) for q in columns] for p in rows])

    def mean(self, x: FloatArray, components: Sequence[int]) -> FloatArray:
        """Of `posterior` alone, shape (components, n)."""
        cross = self._covariance((Points(x, self.axes), components), self._seen)
        return (cross @ self._weights).reshape(len(components), len(x))

    def posterior(self, *asked: tuple[FloatArray, Sequence[int]]) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of what is asked: places (n, d) and components there, one component after another.

        Only differences of free energies have a meaning.
        """
        wanted = [(Points(x, self.axes), components) for x, components in asked]
        cross = np.concatenate([self._covariance(each, self._seen) for each in wanted])
        prior = np.block([[self._covariance(a, b) for b in wanted] for a in wanted])
        return cross @ self._weights, prior - cross @ cho_solve((self._root, True), cross.T)


def _parts(
    periodic: bool, factors: FloatArray, left: tuple[FloatArray, FloatArray], right: tuple[FloatArray, FloatArray]
) -> list[list[FloatArray]]:
    """The kernel of one coordinate: [[itself, its derivative by the right], [by the left, by both]]."""
    (u, du), (w, dw) = ([design @ factors for design in side] for side in (left, right))
    away = u[:, None] - w[None, :]
    if periodic:  # u grows by the mean of the coefficients in a period.
        radius = factors.mean() / (2 * math.pi)
        square = (2 * radius * np.sin(away / (2 * radius))) ** 2
        first, second = 2 * radius * np.sin(away / radius), 2 * np.cos(away / radius)
    else:
        square, first, second = away**2, 2 * away, np.full_like(away, 2.0)
    value, slope, bend = _smoother(square) if periodic else _matern(square)
    along, twice = slope * first, bend * first**2 + slope * second
    return [[value, -along * dw], [along * du[:, None], -twice * du[:, None] * dw]]


class Learned:
    """Processes with the hyperparameters that are likely, each with its weight.

    The most likely ones alone would be too sure of what they do not know. So means and covariances are averaged over
    two points for each eigenvector of the curvature of the likelihood (a cubature of third order: Arasaratnam and
    Haykin, IEEE Trans. Automat. Contr. 54, 1254 (2009)), with the weights that their own likelihoods give them.
    """

    def __init__(self, best: GradientProcess, others: Sequence[GradientProcess], weights: FloatArray) -> None:
        #: Of the most likely hyperparameters; others, and weights of these whose sum is 1.
        self.best, self.others, self.weights = best, others, weights

    def differences(self, x: FloatArray, zero: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Free energies at places (n, d) against that at `zero` (d,), and their covariance."""
        F, c = self.posterior((np.vstack([x, zero]), [-1]))
        return F[:-1] - F[-1], c[:-1, :-1] - c[:-1, -1:] - c[-1:, :-1] + c[-1, -1]

    def difference(self, a: FloatArray, b: FloatArray) -> Estimate:
        """F(b) - F(a) of two places (d,)."""
        (F,), ((variance,),) = self.differences(b[None], a)
        return Estimate(float(F), math.sqrt(max(float(variance), 0.0)))

    def closed(self) -> Learned:
        """The same without constant slopes."""
        free = [False] * len(self.best.axes)
        best, *others = (replace(process, trends=free) for process in (self.best, *self.others))
        return Learned(best, others, self.weights)

    def mean(self, x: FloatArray, components: Sequence[int]) -> FloatArray:
        """Of `posterior` alone, shape (components, n)."""
        return np.asarray(np.tensordot(self.weights, [each.mean(x, components) for each in self.others], axes=1))

    def posterior(self, *asked: tuple[FloatArray, Sequence[int]]) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance as `GradientProcess.posterior` has them, and what the means differ by."""
        means, covariances = zip(*(each.posterior(*asked) for each in self.others), strict=True)
        mean = self.weights @ np.array(means)
        away = np.array(means) - mean
        return mean, np.asarray(np.tensordot(self.weights, covariances, axes=1) + (away.T * self.weights) @ away)


def learn(
    x: FloatArray, gradients: FloatArray, covariances: FloatArray, axes: Sequence[Axis], trends: Sequence[bool]
) -> Learned:
    """Processes whose hyperparameters are likely, in view of the gradients and of broad priors."""
    counts = [axis.coefficients for axis in axes]
    points = Points(x, axes)

    def process(p: FloatArray) -> GradientProcess:
        return GradientProcess(points, gradients, covariances, axes, p, trends)

    def prior(p: FloatArray) -> Any:
        """Minus the logarithm of the density of parameters, complex where these are."""
        value = 0.5 * (p[0] / _WIDE) ** 2
        for own in np.split(p[1:], np.cumsum(counts)[:-1]):
            level, bends = (own.mean() + math.log(_STARTS[0])) / _WIDE, np.diff(own) / _LOCAL
            value += 0.5 * (level**2 + bends @ bends)
        return value

    def unlikely(p: FloatArray, directions: FloatArray | None = None) -> tuple[float, FloatArray]:
        """Minus the logarithm of what the gradients make of that density, and its slopes along some directions."""
        along = np.zeros((0, len(p))) if directions is None else directions.T
        try:
            here = process(p)
        except np.linalg.LinAlgError:
            return _IMPOSSIBLE, np.zeros(len(along))
        slope = [prior(p + _TINY * 1j * direction).imag / _TINY for direction in along]
        return float(prior(p)) - here.log_likelihood(), slope - here.slope(along)

    def search(start: FloatArray, directions: FloatArray) -> OptimizeResult:
        """The most likely parameters that are sums of `directions`, shape (parameters, k)."""

        def function(q: FloatArray) -> tuple[float, FloatArray]:
            return unlikely(directions @ q, directions)

        options = {"ftol": 1e-12, "gtol": 1e-7, "maxiter": 200}
        bounds = [(-_FURTHEST, _FURTHEST)] * len(start)
        found = minimize(function, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        # Values are exact to their rounding, in which a flat maximum is lost; slopes find it.
        exact = root(lambda q: function(q)[1], found.x, options={"xtol": 1e-11})
        if exact.success and np.abs(exact.x - found.x).max() < _STEP and np.abs(exact.x).max() < _FURTHEST:
            found.x = exact.x
        return found

    # The same length everywhere along a coordinate first, from two starts; then lengths that differ.
    same = np.repeat(np.eye(1 + len(axes)), [1, *counts], axis=0)
    starts = [np.array([0.0, *(-math.log(part) for _ in axes)]) for part in _STARTS]
    best = same @ min((search(start, same) for start in starts), key=lambda result: float(result.fun)).x
    if len(best) > len(axes) + 1:
        best = np.asarray(search(best, np.eye(len(best))).x)
    # Where windows are symmetric eigenvalues are equal, and rounding would choose their directions: parameters count a
    # little differently.
    n, every = len(best), np.eye(len(best))
    ends = [(unlikely(best + step, every)[1], unlikely(best - step, every)[1]) for step in _STEP * every]
    curvature = np.array([after - before for after, before in ends]) / (2 * _STEP)
    tilt = 1.0 + _TILT * np.linspace(0.0, 1.0, n) ** 2
    sizes, directions = np.linalg.eigh(tilt[:, None] * (curvature + curvature.T) / 2 * tilt)
    away = directions * np.sqrt(n / np.maximum(sizes, _FLATTEST))
    chosen = np.clip(np.concatenate([best + away.T, best - away.T]), -_FURTHEST, _FURTHEST)
    # The density of each over that of the normal distribution which the points stand for.
    logarithms = unlikely(best)[0] - np.array([unlikely(p)[0] for p in chosen]) + 0.5 * n
    weights = np.exp(np.clip(logarithms, -50.0, _HEAVIEST))
    kept = weights > 1e-3 * weights.max()
    if not (logarithms[kept] > -50.0).all():  # nothing near is possible
        chosen, weights, kept = best[None], np.ones(1), np.ones(1, dtype=bool)
    return Learned(process(best), [process(p) for p in chosen[kept]], weights[kept] / weights[kept].sum())
