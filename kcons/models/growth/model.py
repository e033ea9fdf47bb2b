"""Growth models and the thermodynamics of their species (notes section 3, eqs. 146, 147).

    dx/dt = Psi(x) + G(x) phi(x),   G = diag(x),   Psi >= 0                          (notes eqs. 62, 124, 125)

phi are the relative rates of growth and Psi the sources. Where Psi = 0 the equation of ln x is d ln x/dt = phi(x):
it cannot make a population negative, and it goes on where x itself is below the smallest number of the machine.
For this reason mixtures and rows are handed `Populations`, which hold both x and ln x.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_softmax, logsumexp

from kcons.constraints.arguments import FloatArray, as_float_array, check_call, finite_number, positive, whole_number
from kcons.errors import InputError, NonFiniteError
from kcons.models.integration import called

#: Below this |ln x/x_eq| the excess of a species is summed as a power series.
NEAR = 0.2
#: Of h(u)/u^2, h(u) = u^2/2 + u^3/3 + u^4/8 + ...: the sum over k >= 2 of (k - 1) u^k/k!.
_SERIES = [(k - 1) / math.factorial(k) for k in range(14, 1, -1)]
#: A function of time and populations, arguments in SciPy's order.
OfState = Callable[[float, FloatArray], ArrayLike]


class Populations(NamedTuple):
    """A state: time, populations x, shape (n,), and their logarithms; of several states, shape (n, k).

    Where ln x is below -745, x is 0; ln x is always finite.
    """

    time: float
    x: FloatArray
    log_x: FloatArray

    @classmethod
    def from_logarithms(cls, time: float, log_x: FloatArray) -> Self:
        # A trial step of an integrator may overflow; it is then rejected.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            return cls(time, np.exp(log_x), log_x)

    @classmethod
    def from_values(cls, time: float, x: ArrayLike) -> Self:
        """Populations from x."""
        array = as_float_array(x, "x0").copy()
        if array.ndim not in (1, 2) or array.size == 0:
            raise InputError(f"populations have shape (n,) or (n, k), not {array.shape}", item="x0")
        bad = np.argwhere(~(np.isfinite(array) & (array > 0)))
        if len(bad):
            value = array[tuple(bad[0])]
            raise InputError(
                f"population {bad[0][0]} is {value:.6g}; populations are positive and finite: leave a species that is "
                "zero out, start it at a small positive number, or give the start as log_x0",
                item="x0",
            )
        return cls(time, array, np.log(array))

    @classmethod
    def start(cls, time: float, x0: ArrayLike | None, log_x0: ArrayLike | None) -> Self:
        """The start of a run, given as populations or as their logarithms."""
        if (x0 is None) == (log_x0 is None):
            raise InputError("give the start either as x0 or as log_x0", item="x0")
        if x0 is not None:
            return cls.from_values(time, x0)
        log_x = np.array(as_float_array(log_x0, "log_x0"))
        if not np.all(np.isfinite(log_x)):
            raise InputError("log_x0 is not finite", item="log_x0")
        return cls.from_logarithms(time, log_x)


class GrowthModel:
    """Relative rates phi(t, x) and sources Psi(t, x).

    Parameters
    ----------
    rates : callable (t, x) -> (n,)
        phi; arguments in the order of SciPy's ``solve_ivp``.
    sources : callable (t, x) -> (n,), optional
        Psi >= 0; left out, Psi = 0.
    n : int
        Number of species.
    """

    def __init__(self, rates: OfState, sources: OfState | None = None, *, n: int) -> None:
        self.n = whole_number(n, "n")
        check_call("rates", rates, ("t", "x"))
        check_call("sources", sources, ("t", "x"))
        self._rates = rates
        self._sources = sources

    def rates(self, p: Populations) -> FloatArray:
        """phi, shape (n,) (notes eq. 62)."""
        return called("rates", self._rates, (self.n,), p.time, p.x, scalar=True)

    def sources(self, p: Populations) -> FloatArray | None:
        """Psi, shape (n,), or None where there are none.

        Raises
        ------
        NonFiniteError
            If a source is negative: it would carry populations through zero.
        """
        if self._sources is None:
            return None
        psi = called("sources", self._sources, (self.n,), p.time, p.x, scalar=True)
        if np.any(psi < 0):
            raise NonFiniteError(
                f"source {int(np.argmax(psi < 0))} is negative ({psi[psi < 0][0]:.6g}): write losses as rates, "
                "proportional to the population that is lost",
                item="sources",
            )
        return psi

    def drift(self, p: Populations) -> FloatArray:
        """Psi + G phi: dx/dt without constraints (notes eq. 124)."""
        growth, psi = p.x * self.rates(p), self.sources(p)
        return growth if psi is None else growth + psi

    def velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """dx/dt without constraints, for any x (negative ones included), shape (n,) or (n, k): the field of a phase
        portrait."""
        x = as_float_array(x, "x")
        if x.ndim == 2:
            return np.stack([self.velocity(t, column) for column in x.T], axis=1)
        return self.drift(Populations(t, x, np.full_like(x, np.nan)))


class Logistic(GrowthModel):
    """dx/dt = alpha x - beta x^2 (notes eq. 65)."""

    def __init__(self, alpha: float = 1.0, beta: float = 0.1) -> None:
        self.alpha, self.beta = positive(alpha, "alpha"), positive(beta, "beta")
        super().__init__(lambda t, x: self.alpha - self.beta * x, n=1)

    @property
    def plateau(self) -> float:
        """alpha/beta, the limit of every solution (notes eqs. 67, 68)."""
        return self.alpha / self.beta

    def exact(self, t: ArrayLike, x0: float) -> FloatArray:
        """x(t) (notes eq. 66), written so that what overflows is in the denominator."""
        times, x0 = as_float_array(t, "t"), finite_number(x0, "x0")
        if x0 < 0:
            raise InputError(f"x0 is {x0:g}; populations are not negative", item="x0")
        if x0 in (0.0, self.plateau):
            return np.full(times.shape, x0)
        with np.errstate(over="ignore"):
            share = self.plateau / x0 - 1.0
            left = 1.0 + share * np.exp(-self.alpha * times)
        if np.any(left <= 0):
            since = np.log(-share) / self.alpha
            raise InputError(f"x = {x0:g} at t = 0 came from infinity at t = {since:.6g}; give later times", item="t")
        return np.asarray(self.plateau / left)


class LotkaVolterra(GrowthModel):
    """Prey x_1 and predators x_2 (notes eqs. 69, 70).

    dx_1/dt = x_1 (alpha_1 - beta_1 x_2),     dx_2/dt = -x_2 (beta_2 - alpha_2 x_1)
    """

    def __init__(self, alpha1: float = 1.0, beta1: float = 1.0, alpha2: float = 1.0, beta2: float = 2.0) -> None:
        self.alpha1, self.beta1 = positive(alpha1, "alpha1"), positive(beta1, "beta1")
        self.alpha2, self.beta2 = positive(alpha2, "alpha2"), positive(beta2, "beta2")
        super().__init__(lambda t, x: [self.alpha1 - self.beta1 * x[1], self.alpha2 * x[0] - self.beta2], n=2)

    @property
    def equilibrium(self) -> FloatArray:
        """(beta_2/alpha_2, alpha_1/beta_1) (notes eq. 74)."""
        return np.array([self.beta2 / self.alpha2, self.alpha1 / self.beta1])

    def invariant(self, x: ArrayLike) -> FloatArray:
        """G, constant along every solution (notes eq. 73); x of shape (2,) or (2, k)."""
        x = as_float_array(x, "x")
        prey, predators = x[0] / self.equilibrium[0], x[1] / self.equilibrium[1]
        return np.asarray(self.alpha1 * (predators - np.log(predators)) + self.beta2 * (prey - np.log(prey)))

    def jacobian(self, t: float, x: ArrayLike) -> FloatArray:
        """dV/dx, shape (2, 2) (notes eq. 75)."""
        x1, x2 = as_float_array(x, "x")
        return np.array(
            [[self.alpha1 - self.beta1 * x2, -self.beta1 * x1], [self.alpha2 * x2, self.alpha2 * x1 - self.beta2]]
        )

    def divergence(self, x: ArrayLike) -> FloatArray:
        """div V = (alpha_1 - beta_1 x_2) - (beta_2 - alpha_2 x_1) (notes eq. 72)."""
        x = as_float_array(x, "x")
        return np.asarray((self.alpha1 - self.beta1 * x[1]) - (self.beta2 - self.alpha2 * x[0]))


# -- ideal mixtures -----------------------------------------------------------------------------------


class Mixture:
    """An ideal mixture of n species.

        mu_i = mu0_i + kT ln(x_i / sum x)   (notes eq. 147),      g = sum_i x_i mu_i,      dg = sum_i mu_i dx_i

    The last equation holds exactly (Gibbs-Duhem). With sum x = c kept, g has its minimum g_eq at
    x_eq,i = c exp(-mu0_i/kT)/W, W = sum exp(-mu0_i/kT), where all mu are equal. T ds = -dg in a closed system at
    constant T, so that T(s_eq - s_0) = g(x_0) - g_eq is the only budget of entropy that ends at equilibrium.

    Parameters
    ----------
    mu0 : array_like, shape (n,)
        Standard chemical potentials; a shift common to all of them changes nothing where sum x is kept.
    kT : float
    """

    def __init__(self, mu0: ArrayLike, kT: float = 1.0) -> None:
        self.mu0: FloatArray = as_float_array(mu0, "mu0").copy()
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

    def excess(self, p: Populations, total: float) -> Any:
        """g - g_eq, a number a state, to the round-off of the potentials about their mean.

        g_eq is taken at the actual sum X of the populations, near `total`. The terms of
        kT [sum x_eq h(ln x/x_eq) - c h(ln X/c)], h(u) = u e^u - e^u + 1, are never negative, so that nothing cancels
        near equilibrium; x_eq and c are those of `total`.
        """
        if p.x.ndim == 2:
            states = zip(p.x.T, p.log_x.T, strict=True)
            return np.array([self.excess(Populations(p.time, *state), total) for state in states])
        log_eq = self.equilibrium(total)
        # A trial step of an integrator may overflow; it is then rejected.
        with np.errstate(all="ignore"):
            u, x_eq = p.log_x - log_eq, np.exp(log_eq)
            small = np.where(np.abs(u) < NEAR, u, 0.0)
            series = np.polyval(_SERIES, small) * small * small
            terms = np.where(np.abs(u) < NEAR, x_eq * series, p.x * u - (p.x - x_eq))
            if not (np.all(np.isfinite(terms)) and np.all(np.isfinite(p.x))):
                return math.nan
            more = math.fsum([*p.x, -total]) / total
            return self.kT * math.fsum([*terms, total * more, -total * (1.0 + more) * np.log1p(more)])
