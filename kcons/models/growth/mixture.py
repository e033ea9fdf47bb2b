"""Ideal mixtures: chemical potentials, the Gibbs energy of the populations, and its minimum.

    mu_i = mu0_i + kT ln(x_i / sum x)   (notes eq. 147),      g = sum_i x_i mu_i,      dg = sum_i mu_i dx_i

The last equation holds exactly (Gibbs-Duhem). With sum x = c kept, g has its minimum g_eq at
x_eq,i = c exp(-mu0_i/kT)/W, W = sum exp(-mu0_i/kT), where all mu are equal. T ds = -dg in a closed system at constant
T, so that T(s_eq - s_0) = g(x_0) - g_eq is the only budget of entropy that ends at equilibrium.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_softmax, logsumexp

from kcons.constraints.arguments import FloatArray, numbers, positive
from kcons.errors import InputError
from kcons.models.growth.model import Populations

#: Below this |ln x/x_eq| the excess of a species is summed as a power series.
NEAR = 0.2


class Mixture:
    """An ideal mixture of n species.

    Parameters
    ----------
    mu0 : array_like, shape (n,)
        Standard chemical potentials; a shift common to all of them changes nothing where sum x is kept.
    kT : float
    """

    def __init__(self, mu0: ArrayLike, kT: float = 1.0) -> None:
        self.mu0: FloatArray = numbers(mu0, "mu0").copy()
        self.kT = positive(kT, "kT")
        if self.mu0.ndim != 1 or not self.mu0.size or not np.all(np.isfinite(self.mu0)):
            raise InputError("mu0 has shape (n,) and is finite", item="mu0")
        #: ln(x_eq/c), and the Gibbs energy at equilibrium over -c kT.
        self._log_fraction: FloatArray = log_softmax(-self.mu0 / self.kT)
        self._log_w = float(logsumexp(-self.mu0 / self.kT))

    @property
    def n(self) -> int:
        return len(self.mu0)

    def potentials(self, p: Populations) -> FloatArray:
        """mu, shape of p.x (notes eq. 147); from ln x, hence finite where x underflows."""
        return (self.mu0 + (self.kT * (p.log_x - np.log(np.sum(p.x, axis=0)))).T).T

    def relative_potentials(self, p: Populations) -> FloatArray:
        """mu less that of the largest population, shape (n,).

        Exact where differences are all that is left: next to equilibrium, where all mu are equal, and where one species
        is nearly alone.
        """
        u = p.log_x - self._log_fraction
        return np.asarray(self.kT * (u - u[np.argmax(p.x)]))

    def gibbs_energy(self, p: Populations) -> FloatArray:
        """g = sum x mu, a number a state."""
        return np.asarray(np.sum(p.x * self.potentials(p), axis=0))

    def moments(self, p: Populations) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M_0, M_1, M_2 with M_q = sum mu^q x (notes eq. 152)."""
        mu = self.potentials(p)
        return np.asarray(np.sum(p.x, axis=0)), np.sum(p.x * mu, axis=0), np.sum(p.x * mu * mu, axis=0)

    def equilibrium(self, total: float = 1.0) -> FloatArray:
        """ln x_eq for sum x = total, shape (n,)."""
        return np.asarray(self._log_fraction + np.log(total))

    def least_gibbs_energy(self, total: float = 1.0) -> float:
        """g_eq = -c kT ln sum exp(-mu0/kT)."""
        return -total * self.kT * self._log_w

    def largest_gibbs_energy(self, total: float = 1.0) -> float:
        """c max mu0: g is convex, so that its largest values are where one species is alone."""
        return total * float(np.max(self.mu0))

    def excess(self, p: Populations, total: float) -> FloatArray:
        """g - g_eq as a sum of terms that are never negative, so that nothing cancels near equilibrium; a number a
        state.

        g_eq is taken at the actual sum X of the populations, near `total`:
        kT [sum x_eq h(ln x/x_eq) - c h(ln X/c)] with h(u) = u e^u - e^u + 1 and x_eq, c for `total`.
        """
        log_eq = self.equilibrium(total)
        terms = np.exp(log_eq) @ entropy_function((p.log_x.T - log_eq).T)
        over = np.log1p((np.sum(p.x, axis=0) - total) / total)
        return np.asarray(self.kT * (terms - total * entropy_function(over)))

    def excess_over(self, p: Populations, total: float, level: float) -> float:
        """`excess` less `level`, to the round-off of the potentials about their mean.

        Far from equilibrium the excess is many times as large as what the populations differ in, and so is its
        round-off. The part of each population in `level` is therefore taken from its own term: with a = level/(c kT)
        kT [sum (x_eq h(ln x/x_eq) - a x) - c h(ln X/c) + a (X - c)],  with ln x/x_eq and X - c to twice the precision.
        """
        log_eq = self.equilibrium(total)
        a = level / (total * self.kT)
        # A trial step of an integrator may overflow; it is then rejected.
        with np.errstate(all="ignore"):
            u = p.log_x - log_eq
            part = u - p.log_x
            rest = (p.log_x - (u - part)) - (log_eq + part)  # what rounding took from u (Knuth)
            terms = p.x * ((u - a) + rest) - (p.x - np.exp(log_eq))
            near = np.abs(u) < NEAR
            terms = np.where(near, np.exp(log_eq) * _series(np.where(near, u + rest, 0.0)) - a * p.x, terms)
            if not (np.all(np.isfinite(terms)) and np.all(np.isfinite(p.x))):
                return math.nan
            more = math.fsum([*p.x, -total])
            over = float(entropy_function(np.log1p(more / total)))
            return self.kT * math.fsum([*terms, -total * over, a * more])


def entropy_function(u: ArrayLike) -> FloatArray:
    """h(u) = u e^u - e^u + 1, which is 0 with zero slope at u = 0 and positive elsewhere, to full relative accuracy."""
    u = np.asarray(u, dtype=np.float64)
    near = np.abs(u) < NEAR
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.where(near, _series(np.where(near, u, 0.0)), u * np.exp(u) - np.expm1(u))


def _series(u: FloatArray) -> FloatArray:
    """u^2/2 + u^3/3 + u^4/8 + ...: the sum over k >= 2 of (k - 1) u^k/k!."""
    return np.asarray(np.polyval(_COEFFICIENTS, u) * u * u)


_COEFFICIENTS = [(k - 1) / math.factorial(k) for k in range(14, 1, -1)]
