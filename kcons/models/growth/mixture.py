"""Ideal mixtures: chemical potentials, the Gibbs energy of the populations, and its minimum.

    mu_i = mu0_i + kT ln(x_i / sum x)   (notes eq. 147),      g = sum_i x_i mu_i,      dg = sum_i mu_i dx_i

The last equation holds exactly (Gibbs-Duhem). With sum x = c kept, g has its minimum g_eq at
x_eq,i = c exp(-mu0_i/kT)/W, W = sum exp(-mu0_i/kT), where all mu are equal. T ds = -dg in a closed system at constant
T, so that T(s_eq - s_0) = g(x_0) - g_eq is the only budget of entropy that ends at equilibrium.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import numbers
from kcons.errors import InputError
from kcons.models.growth.compensated_sums import compensated_sum, two_sum
from kcons.models.growth.model import FloatArray, Populations, common_lanes, taken

#: Below this |ln x/x_eq| the excess of a species is summed as a power series.
NEAR = 0.2


class Mixture:
    """An ideal mixture of n species.

    Parameters
    ----------
    mu0 : array_like, shape (n,) or (n, N)
        Standard chemical potentials; a shift common to all of them changes nothing where sum x is kept.
    kT : float or array_like, shape (N,)

    Raises
    ------
    InputError
        If mu0 is not finite or kT is not positive.
    """

    def __init__(self, mu0: ArrayLike, kT: ArrayLike = 1.0) -> None:
        self.mu0: FloatArray = numbers(mu0, "mu0").copy()
        self.kT: FloatArray = numbers(kT, "kT").copy()
        if self.mu0.ndim not in (1, 2) or not self.mu0.size or not np.all(np.isfinite(self.mu0)):
            raise InputError("mu0 has shape (n,) and is finite", item="mu0")
        if self.kT.ndim > 1 or not np.all(np.isfinite(self.kT) & (self.kT > 0)):
            raise InputError("kT is positive and finite, a number or one a system", item="kT")
        self.lanes = common_lanes(mu0=self.mu0.shape[1:], kT=self.kT.shape)
        # -ln W, the Gibbs energy at equilibrium over c kT.
        reduced = -self._columns() / self.kT
        top = np.max(reduced, axis=0)
        self._log_w: FloatArray = top + np.log(np.sum(np.exp(reduced - top), axis=0))
        self._log_fraction: FloatArray = reduced - self._log_w

    @property
    def n(self) -> int:
        return len(self.mu0)

    def _columns(self, lanes: int = 0) -> FloatArray:
        """mu0 that broadcasts against (n, N)."""
        return self.mu0[:, None] if self.mu0.ndim == 1 and (self.kT.ndim or lanes) else self.mu0

    def _fractions(self, p: Populations) -> FloatArray:
        """ln(x_eq/c), to broadcast against p.x."""
        return self._log_fraction[:, None] if p.x.ndim == 2 and self._log_fraction.ndim == 1 else self._log_fraction

    # -- thermodynamics -------------------------------------------------------------------------------

    def potentials(self, p: Populations) -> FloatArray:
        """mu, shape of p.x (notes eq. 147); from ln x, hence finite where x underflows."""
        return self._columns(p.x.ndim - 1) + self.kT * (p.log_x - np.log(np.sum(p.x, axis=0)))

    def gibbs_energy(self, p: Populations) -> FloatArray:
        """g = sum x mu, a number a system."""
        return np.asarray(np.sum(p.x * self.potentials(p), axis=0))

    def moments(self, p: Populations) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M_0, M_1, M_2 with M_q = sum mu^q x (notes eq. 152)."""
        mu = self.potentials(p)
        return np.asarray(np.sum(p.x, axis=0)), np.sum(p.x * mu, axis=0), np.sum(p.x * mu * mu, axis=0)

    def equilibrium(self, total: ArrayLike = 1.0) -> FloatArray:
        """ln x_eq for sum x = total, shape (n,) or (n, N)."""
        c = np.asarray(total, dtype=np.float64)
        f = self._log_fraction
        return f[:, None] + np.log(c) if c.ndim and f.ndim == 1 else f + np.log(c)

    def least_gibbs_energy(self, total: ArrayLike = 1.0) -> FloatArray:
        """g_eq = -c kT ln sum exp(-mu0/kT)."""
        return -np.asarray(total) * self.kT * self._log_w

    def largest_gibbs_energy(self, total: ArrayLike = 1.0) -> FloatArray:
        """c max mu0: g is convex, so that its largest values are where one species is alone."""
        return np.asarray(total) * np.max(self.mu0, axis=0)

    def excess(self, p: Populations, total: ArrayLike) -> FloatArray:
        """g - g_eq as a sum of terms that are never negative, so that nothing cancels near equilibrium.

        g_eq is taken at the actual sum X of the populations, near `total`:
        kT [sum x_eq h(ln x/x_eq) - c h(ln X/c)] with h(u) = u e^u - e^u + 1 and x_eq, c for `total`.
        """
        c = np.asarray(total, dtype=np.float64)
        u, x_eq = self._displacement(p, c)
        v = np.log1p((np.sum(p.x, axis=0) - c) / c)
        return np.asarray(self.kT * (np.sum(x_eq * entropy_function(u), axis=0) - c * entropy_function(v)))

    def excess_over(self, p: Populations, total: ArrayLike, level: FloatArray) -> FloatArray:
        """`excess` less `level`, to the round-off of the potentials about their mean.

        Far from equilibrium the excess is many times as large as what the populations differ in, and so is its
        round-off. The part of each population in `level` is therefore taken from its own term: with a = level/(c kT)
        kT [sum (x_eq h(ln x/x_eq) - a x) - c h(ln X/c) + a (X - c)],  with ln x/x_eq and X - c to twice the precision.
        """
        c = np.asarray(total, dtype=np.float64)
        log_eq = self._fractions(p) + np.log(c)
        a = level / (c * self.kT)
        # A trial step of an integrator may overflow; it is then rejected.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            x_eq = np.exp(log_eq)
            u, rest = two_sum(p.log_x, -log_eq)
            near = np.abs(u) < NEAR
            terms = p.x * ((u - a) + rest) - (p.x - x_eq)
            if near.any():
                terms = np.where(near, x_eq * _entropy_series(np.where(near, u + rest, 0.0)) - a * p.x, terms)
            more = compensated_sum([*p.x, -c])
            terms_of_sum = [-c * entropy_function(np.log1p(more / c)), a * more]
            return np.asarray(self.kT * compensated_sum([*terms, *terms_of_sum]))

    def relative_potentials(self, p: Populations) -> FloatArray:
        """mu less that of the largest population, shape of p.x.

        Exact where differences are all that is left: next to equilibrium, where all mu are equal, and where one species
        is nearly alone.
        """
        u = p.log_x - self._fractions(p)
        largest = np.argmax(p.x, axis=0)
        return np.asarray(self.kT * (u - np.take_along_axis(u, np.expand_dims(largest, 0), axis=0)))

    def _displacement(self, p: Populations, c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ln(x/x_eq) and x_eq."""
        log_eq = self._fractions(p) + np.log(c)
        return p.log_x - log_eq, np.exp(log_eq)

    def take(self, lanes: NDArray[np.intp]) -> Self:
        """The mixtures of some of N systems."""
        parts = ["mu0"] * (self.mu0.ndim == 2) + ["kT"] + ["_log_w", "_log_fraction"] * (self._log_w.ndim > 0)
        part = taken(self, lanes, *parts)
        part.lanes = lanes.shape if self.lanes else ()
        return part


def entropy_function(u: ArrayLike) -> FloatArray:
    """h(u) = u e^u - e^u + 1, which is 0 with zero slope at u = 0 and positive elsewhere, to full relative accuracy."""
    u = np.asarray(u, dtype=np.float64)
    near = np.abs(u) < NEAR
    if not near.any():
        return _plain_entropy_function(u)
    series = _entropy_series(np.where(near, u, 0.0))
    return series if near.all() else np.where(near, series, _plain_entropy_function(u))


def _entropy_series(u: FloatArray) -> FloatArray:
    # u^2/2 + u^3/3 + u^4/8 + ...: sum over k >= 2 of (k - 1) u^k/k!.
    series = np.zeros_like(u)
    for factor in _SERIES:
        series = series * u + factor
    return series * u * u


def _plain_entropy_function(u: FloatArray) -> FloatArray:
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.asarray(u * np.exp(u) - np.expm1(u))


_SERIES = [(k - 1) / math.factorial(k) for k in range(14, 1, -1)]
