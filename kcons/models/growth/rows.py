"""Rows: what a growth model is held to.

A row asks  sum_j A_j(x, t) dx_j/dt = b(x, t)  (notes eqs. 127, 128). Holonomic rows come from a function of the
state that keeps its value, sigma(x, t) = sigma0 (eq. 126), so that A = d sigma/dx and b = -d sigma/dt (eqs. 129, 130);
because they have a value, the state can be projected back on them to round-off.

Entropy production is a row as well (eqs. 145-150). Closed system: T ds/dt = -sum mu dx/dt >= 0 (corrected: the notes
drop the sign in the middle of (149)). With a fixed sum of x, what has been produced until t, T(s(t) - s_0), is what the
excess E = g(x) - g_eq has lost since the start, where E_0 = T(s_eq - s_0). The row is sum mu dx/dt = dE/dt.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

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
from kcons.errors import BudgetError, ConstraintError, InputError
from kcons.models.growth.model import Mixture, OfState, Populations
from kcons.models.integration import called, check_derivative, jacobian_by_differences

#: Step of differences, in ln x; they serve where half of it changes them by no more than this part.
STEP, SMOOTH = 0.005, 1e-6


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
        self.name = name

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
        given = None if self._gradient is None else self.gradient(p) * p.x
        coarse, fine = (self._by_differences(p, h) for h in (STEP, STEP / 2))
        rounding = 1e-12 * abs(self.measure(p))
        check_derivative("gradient", f"{self.name}, times x,", given, coarse, fine, rounding=rounding, smooth=SMOOTH)
        self._check_rate(p)

    def _check_rate(self, p: Populations) -> None:
        """Compare the derivative in time with differences, slow and fast ones, where these are smooth."""
        size = self.size(p)

        def rate(t: float) -> FloatArray:
            return np.array([-self.rate(Populations(t, p.x, p.log_x))])

        def value(t: float) -> FloatArray:
            return np.array([self.measure(Populations(t, p.x, p.log_x)) + size])

        for step in (1e-2, 1e-8):
            found = contradiction(rate, value, p.time, step)
            if found is None:
                continue
            near = [float(first_derivative_4(value, found.time, h)[0]) for h in (1e-6, 1e-9)]  # of what changes faster
            if not any(abs(v - found.given) <= WRONG * max(abs(v), abs(found.given)) for v in near):
                said = (
                    "depends on time, but has no time_derivative: give it"
                    if self._time_derivative is None
                    else "changes with time at another rate than differences of it: correct it"
                )
                raise InputError(
                    f"{self.name} {said} ({found.given:.6g}; differences give {found.found:.6g})",
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

        def moved(t: float) -> FloatArray:
            """Target and rate."""
            pair = as_float_array(given := target(t), "target")
            if pair.shape != (2,):
                raise InputError(
                    f"target of {name} gives {given!r:.80} at t = {t:g}; give (value, rate)", item="target"
                )
            return pair

        super().__init__(lambda t, x: c @ x - moved(t)[0], None, lambda t, x: -moved(t)[1], target=0.0, name=name)

    def gradient(self, p: Populations) -> FloatArray:
        if len(p.x) != len(self.coefficients):
            raise InputError(
                f"{self.name} has {len(self.coefficients)} coefficients, there are {len(p.x)} species",
                item="coefficients",
            )
        return self.coefficients

    def check_derivatives(self, p: Populations) -> None:
        self._check_rate(p)


class TotalPopulation(LinearRow):
    """sum_i x_i = target (notes eqs. 143, 144), for n species; left out, the target is the sum at the start."""

    def __init__(self, n: int, target: float | Callable[[float], tuple[float, float]] | None = None) -> None:
        super().__init__(np.ones(whole_number(n, "n")), target, name="total population")


class VelocityRow(Row):
    """sum_j A_j(t, x) dx_j/dt = b(t, x) (notes eq. 127), that need not come from any function of the state.

    Parameters
    ----------
    coefficients : callable (t, x) -> (n,), or array_like, shape (n,)
        A.
    rate : callable (t, x) -> float, or float
        b.
    """

    def __init__(
        self, coefficients: OfState | ArrayLike, rate: OfState | float = 0.0, *, name: str = "velocity row"
    ) -> None:
        row = np.zeros(0) if callable(coefficients) else as_float_array(coefficients, "coefficients").copy()
        number = 0.0 if callable(rate) else finite_number(rate, "rate")
        self._coefficients = coefficients if callable(coefficients) else lambda t, x: row
        self._rate = rate if callable(rate) else lambda t, x: number
        for what, given in (("coefficients", self._coefficients), ("rate", self._rate)):
            check_call(f"{name}: {what}", given, ("t", "x"))
        self.name = name

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
        if self.mixture.n != len(p.x):
            raise InputError(f"the mixture has {self.mixture.n} species, the start {len(p.x)}", item="mixture")
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
        if budget is None or abs(budget / excess0 - 1.0) <= BUDGET_TOLERANCE:
            return
        if budget > excess0:
            time = -self.tau * math.log1p(-excess0 / budget)
            said = f"more than the start can produce: equilibrium would be reached at t = {time:.6g}, with"
        else:
            time, said = math.inf, "less than what lies between the start and equilibrium: it would stop with"
        raise BudgetError(
            f"T(s_eq - s_0) = {budget:.10g} is {said} {abs(excess0 - budget):.6g} still to be produced. Leave the "
            f"budget out; it is then computed, g(x_0) - g_eq = {excess0:.10g}",
            budget=budget,
            consistent=excess0,
            time=time,
        )
