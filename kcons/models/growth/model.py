"""Growth models, the thermodynamics of their species, and rows: what a model is held to (notes sections 3 and 4.3).

    dx/dt = Psi(x) + G(x) phi(x),   G = diag(x),   Psi >= 0                          (notes eqs. 62, 124, 125)

phi are the relative rates of growth and Psi the sources. Where Psi = 0 the equation of ln x is d ln x/dt = phi(x):
it cannot make a population negative, and it goes on where x itself is below the smallest number of the machine.
For this reason mixtures and rows are handed `Populations`, which hold both x and ln x.

A row asks  sum_j A_j(x, t) dx_j/dt = b(x, t)  (notes eqs. 127, 128). A holonomic one has a value that it keeps, on
which the state is projected, sigma(x, t) = sigma0 (eq. 126): A = d sigma/dx and b = -d sigma/dt (eqs. 129, 130).

Entropy production is a row as well (eqs. 145-150). Closed system: T ds/dt = -sum mu dx/dt >= 0 (corrected: the notes
drop the sign in the middle of (149)). With a fixed sum of x, what has been produced until t, T(s(t) - s_0), is what the
excess E = g(x) - g_eq has lost since the start, where E_0 = T(s_eq - s_0). The row is sum mu dx/dt = dE/dt.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_softmax, logsumexp

from kcons.constraints.arguments import (
    FloatArray,
    as_float_array,
    check_call,
    finite_number,
    not_negative,
    positive,
    refuse_other,
    whole_number,
)
from kcons.constraints.target import WRONG, contradiction, first_derivative_4
from kcons.errors import BudgetError, ConstraintError, InputError, NonFiniteError
from kcons.models.integration import called, check_derivative, jacobian_by_differences

__all__ = ["EntropyRow", "GrowthModel", "HolonomicRow", "LinearRow", "Logistic", "LotkaVolterra", "Mixture"]
__all__ += ["Populations", "Row", "TotalPopulation", "VelocityRow"]

#: Below this |ln x/x_eq| the excess of a species is summed as a power series.
NEAR = 0.2
#: Of h(u)/u^2, h(u) = u^2/2 + u^3/3 + u^4/8 + ...: the sum over k >= 2 of (k - 1) u^k/k!.
_SERIES = [(k - 1) / math.factorial(k) for k in range(14, 1, -1)]
#: Step of differences, in ln x; they serve where half of it changes them by no more than this part.
STEP, SMOOTH = 0.005, 1e-6
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
        """Populations from ln x."""
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
            raise InputError(
                f"population {bad[0][0]} is {array[tuple(bad[0])]:.6g}; populations are positive and finite: "
                "leave a species that is zero out, or start it at a small positive number",
                item="x0",
            )
        return cls(time, array, np.log(array))


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
        """dx/dt without constraints, for any x (also negative), shape (n,) or (n, k): the field of a phase portrait."""
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
        times, x0 = as_float_array(t, "t"), positive(x0, "x0")
        with np.errstate(over="ignore"):
            left = 1.0 + (self.plateau / x0 - 1.0) * np.exp(-self.alpha * times)
        if not np.all(left > 0):
            raise InputError("x came from infinity after the first of these times; give later ones", item="t")
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
        prey = [self.alpha1 - self.beta1 * x2, -self.beta1 * x1]
        return np.array([prey, [self.alpha2 * x2, self.alpha2 * x1 - self.beta2]])


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

    def excess(self, p: Populations, total: float) -> float:
        """g - g_eq of one state, to the round-off of the potentials about their mean.

        g_eq is taken at the actual sum X of the populations, near `total`. The terms of
        kT [sum x_eq h(ln x/x_eq) - c h(ln X/c)], h(u) = u e^u - e^u + 1, are never negative, so that nothing cancels
        near equilibrium; x_eq and c are those of `total`.
        """
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


# -- rows ---------------------------------------------------------------------------------------------


class Row(ABC):
    """One row of A dx/dt = b."""

    #: Whether the row has a value that the state is projected on.
    holonomic: bool = False
    name: str = "row"

    @abstractmethod
    def gradient(self, p: Populations) -> FloatArray:
        """The row of A, shape (n,)."""

    @abstractmethod
    def rate(self, p: Populations) -> float:
        """b."""

    def value(self, p: Populations) -> float:
        """sigma - sigma0 of a holonomic row, 0 on the constraint."""
        raise NotImplementedError(f"{self.name} has no value")

    def size(self, p: Populations) -> float:
        """The size of the terms that `value` is the difference of: its round-off is some 1e-16 of this."""
        raise NotImplementedError(f"{self.name} has no value")

    def bind(self, p: Populations) -> Row:
        """The row that holds what it found at the start `p`."""
        return self

    def check_derivatives(self, p: Populations) -> None:
        """Refuse derivatives that differences contradict, if it has any."""


class HolonomicRow(Row):
    """sigma(t, x) = target (notes eq. 126).

    Parameters
    ----------
    function : callable (t, x) -> float
        sigma.
    gradient : callable (t, x) -> (n,), optional
        d sigma/dx; by central differences where it is not given.
    time_derivative : callable (t, x) -> float, optional
        d sigma/dt at fixed x; left out, sigma does not depend on t.
    target : float, optional
        The value to be kept; left out, the one found at the start.
    """

    holonomic = True

    def __init__(
        self,
        function: OfState,
        gradient: OfState | None = None,
        time_derivative: OfState | None = None,
        *,
        target: float | None = None,
        name: str = "holonomic row",
    ) -> None:
        for what, given in (("function", function), ("gradient", gradient), ("time_derivative", time_derivative)):
            check_call(f"{name}: {what}", given, ("t", "x"))
        self._function, self._gradient, self._time_derivative = function, gradient, time_derivative
        self.target = None if target is None else finite_number(target, "target")
        self.name, self.moving = name, time_derivative is not None

    def measure(self, p: Populations) -> float:
        """sigma itself."""
        return float(called(self.name, self._function, (), p.time, p.x))

    def value(self, p: Populations) -> float:
        if self.target is None:
            raise ConstraintError(f"{self.name} has no target yet: it is set by the start, see bind()")
        return self.measure(p) - self.target

    def size(self, p: Populations) -> float:
        return float(np.sum(np.abs(self.gradient(p)) * p.x)) + abs(self.target or 0.0)

    def gradient(self, p: Populations) -> FloatArray:
        if self._gradient is None:
            return self._by_differences(p, STEP) / p.x
        return called(f"gradient of {self.name}", self._gradient, p.x.shape, p.time, p.x, scalar=True)

    def rate(self, p: Populations) -> float:
        if self._time_derivative is None:
            return 0.0
        return -float(called(f"time derivative of {self.name}", self._time_derivative, (), p.time, p.x))

    def bind(self, p: Populations) -> Self:
        self.check_derivatives(p)
        bound = copy.copy(self)
        bound.target = self.measure(p) if self.target is None else self.target
        return bound

    def _by_differences(self, p: Populations, step: float) -> FloatArray:
        """d sigma/d ln x."""
        return jacobian_by_differences(
            lambda t, y: self.measure(Populations.from_logarithms(t, y)), p.time, p.log_x, np.full(len(p.x), step)
        )

    def check_derivatives(self, p: Populations) -> None:
        """Refuse derivatives that differences of sigma contradict: a wrong one moves off the row without a sign."""
        size = self.size(p)

        def rate(t: float) -> FloatArray:
            return np.array([-self.rate(Populations(t, p.x, p.log_x))])

        def value(t: float) -> FloatArray:
            return np.array([self.measure(Populations(t, p.x, p.log_x)) + size])

        given = None if self._gradient is None else self.gradient(p) * p.x
        coarse, fine = (self._by_differences(p, h) for h in (STEP, STEP / 2))
        rounding = 1e-12 * abs(self.measure(p))
        check_derivative("gradient", f"{self.name}, times x,", given, coarse, fine, rounding=rounding, smooth=SMOOTH)
        for step in (1e-2, 1e-8):
            found = contradiction(rate, value, p.time, step)
            if found is None:
                continue
            near = [float(first_derivative_4(value, found.time, h)[0]) for h in (1e-6, 1e-9)]  # of what changes faster
            if not any(abs(v - found.given) <= WRONG * max(abs(v), abs(found.given)) for v in near):
                raise InputError(
                    f"{self.name} changes with time by {found.found:.6g}, its time_derivative is {found.given:.6g}: "
                    "correct it, or give it where it was left out",
                    item="time_derivative",
                )


class LinearRow(HolonomicRow):
    """sum_i c_i x_i = target; left out, the target is what the start gives.

    Parameters
    ----------
    coefficients : array_like, shape (n,)
    target : float or callable t -> (value, rate), optional
        A moving target returns its value and its time derivative.
    """

    def __init__(
        self,
        coefficients: ArrayLike,
        target: float | Callable[[float], tuple[float, float]] | None = None,
        *,
        name: str = "linear row",
    ) -> None:
        c = as_float_array(coefficients, "coefficients").copy()
        if c.ndim != 1 or not np.all(np.isfinite(c)) or not np.any(c):
            raise InputError(f"{name}: give n finite coefficients that are not all zero", item="coefficients")
        self.coefficients: FloatArray = c
        if not callable(target):
            super().__init__(lambda t, x: c @ x, target=target, name=name)
            return
        check_call(f"{name}: target", target, ("t",))
        moved = partial(called, "target", target, (2,))
        super().__init__(lambda t, x: c @ x - moved(t)[0], None, lambda t, x: -moved(t)[1], target=0.0, name=name)

    def gradient(self, p: Populations) -> FloatArray:
        if len(p.x) != len(self.coefficients):
            raise InputError(
                f"{self.name} has {len(self.coefficients)} coefficients, there are {len(p.x)} species",
                item="coefficients",
            )
        return self.coefficients


class TotalPopulation(LinearRow):
    """sum_i x_i = target (notes eqs. 143, 144), for n species; left out, the target is the sum at the start."""

    def __init__(self, n: int, target: float | Callable[[float], tuple[float, float]] | None = None) -> None:
        super().__init__(np.ones(whole_number(n, "n")), target, name="total population")


class VelocityRow(Row):
    """sum_j A_j(t, x) dx_j/dt = b(t, x) (notes eq. 127), that need not come from any function of the state.

    Parameters
    ----------
    coefficients, rate : callable (t, x) -> (n,) and (t, x) -> float
        A and b.
    """

    def __init__(self, coefficients: OfState, rate: OfState = lambda t, x: 0.0, *, name: str = "velocity row") -> None:
        for what, given in (("coefficients", coefficients), ("rate", rate)):
            check_call(what, given, ("t", "x"), needed=True)
        self._coefficients, self._rate, self.name = coefficients, rate, name

    def gradient(self, p: Populations) -> FloatArray:
        return called(f"coefficients of {self.name}", self._coefficients, p.x.shape, p.time, p.x, scalar=True)

    def rate(self, p: Populations) -> float:
        return float(called(f"rate of {self.name}", self._rate, (), p.time, p.x))


# -- entropy production --------------------------------------------------------------------------------

#: A budget is consistent with the start where it differs by no more than this part.
BUDGET_TOLERANCE = 1e-9
#: Excess, as a part of the largest there is, that rounding leaves of none (it is quadratic in x - x_eq).
AT_EQUILIBRIUM = 1e-29


class EntropyRow(Row):
    """A mixture produces entropy that relaxes, or none in all; to be used together with `TotalPopulation`.

    s(t) = s_0 + (s_eq - s_0)(1 - exp(-t/tau))   (notes eqs. 148, 149)

    Its row of A is mu less the mu of the largest population: a constant common to all species drops out where sum x is
    kept. So the row fades cleanly where the rank is lost: at equilibrium, and where one species is nearly alone.

    Parameters
    ----------
    mixture : Mixture
    tau : float
        Relaxation time; infinite, as it is where left out, no entropy is produced (notes eq. 150).
    budget : float, optional
        T(s_eq - s_0), which has to be that of the start, g(x_0) - g_eq.
    """

    holonomic = True
    name = "entropy production"
    #: Of the start; the excess E = g - g_eq there is T(s_eq - s_0).
    start, total, excess0 = 0.0, math.nan, math.nan

    def __init__(self, mixture: Mixture, tau: float = math.inf, budget: float | None = None) -> None:
        refuse_other(mixture, Mixture, "mixture", "a kcons.models.growth.Mixture")
        self.mixture = mixture
        self.tau = math.inf if tau == math.inf else positive(tau, "tau")
        self.budget = None if budget is None else not_negative(budget, "budget")

    def produced(self, time: float) -> float:
        """T(s(t) - s_0), for a row that is bound to a start (notes eq. 148)."""
        return -self.excess0 * math.expm1((self.start - time) / self.tau)

    def law_excess(self, time: float) -> float:
        """E(t) = E_0 - T(s(t) - s_0) without the difference, for a row that is bound to a start."""
        return self.excess0 * math.exp((self.start - time) / self.tau)

    def gradient(self, p: Populations) -> FloatArray:
        return self.mixture.relative_potentials(p)

    def rate(self, p: Populations) -> float:
        # Told by the state instead of the time: the same on the constraint, but errors fade instead of piling up.
        total = float(np.sum(p.x)) if math.isnan(self.total) else self.total
        return -self.mixture.excess(p, total) / self.tau

    def value(self, p: Populations) -> float:
        return self.mixture.excess(p, self.total) - self.law_excess(p.time)

    def size(self, p: Populations) -> float:
        # ln x carries an error of some 1e-16 of itself, which enters through the gradient; squared where there is none.
        error = np.maximum(1.0, np.abs(p.log_x))
        epsilon = float(np.finfo(np.float64).eps)
        slope = float(np.sum(p.x * np.maximum(np.abs(self.gradient(p)), 4.0 * epsilon * error) * error))
        return max(4.0 * abs(self.law_excess(p.time)), slope)

    def bind(self, p: Populations) -> EntropyRow:
        if len(self.mixture.mu0) != len(p.x):
            raise InputError(f"the mixture has {len(self.mixture.mu0)} species, the start {len(p.x)}", item="mixture")
        bound = copy.copy(self)
        bound.start, bound.total = p.time, math.fsum(p.x)
        bound.excess0 = self.mixture.excess(p, bound.total)
        if self.tau < math.inf:
            bound._check_budget()
        return bound

    def _check_budget(self) -> None:
        """Refuse a start that has nothing to produce, or another amount than the budget."""
        excess0, budget = self.excess0, self.budget
        # g is convex, so that its largest values are where one species is alone.
        most = self.total * float(np.max(self.mixture.mu0)) - self.mixture.least_gibbs_energy(self.total)
        if excess0 <= AT_EQUILIBRIUM * abs(most):
            raise BudgetError(
                "the start is already at equilibrium, where no entropy is left to be produced and the row has no "
                "direction; start elsewhere, or hold the total population alone (with_fixed_total)",
                budget=budget or 0.0,
                consistent=0.0,
                time=0.0,
            )
        if budget is not None and abs(budget / excess0 - 1.0) > BUDGET_TOLERANCE:
            time = -self.tau * math.log1p(-excess0 / budget) if budget > excess0 else math.inf
            raise BudgetError(
                f"T(s_eq - s_0) = {budget:.10g} is not what the start can produce, "
                f"{excess0:.10g}; it would be used up at t = {time:.6g}. Leave the budget out; it is then computed",
                budget=budget,
                consistent=excess0,
                time=time,
            )
