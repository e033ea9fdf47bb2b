"""Entropy production as a row (notes eqs. 145-150).

Closed system: T ds/dt = -sum mu dx/dt >= 0 (corrected: the notes drop the sign in the middle of (149)). A law says
what has been produced until t, T(s(t) - s_0); with a fixed sum of x it is the same as a law for the excess
E(t) = g(x) - g_eq, which falls from E_0 = T(s_eq - s_0). The row is sum mu dx/dt = dE/dt.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad

from kcons.constraints.arguments import check_call, finite_number, numbers, positive, refuse_other
from kcons.errors import BudgetError, InputError
from kcons.models.growth.compensated_sums import compensated_sum
from kcons.models.growth.mixture import Mixture
from kcons.models.growth.model import FloatArray, Populations, common_lanes, taken
from kcons.models.growth.rows import EPSILON, Row

if TYPE_CHECKING:
    from kcons.models.growth.integration import GrowthSolution

#: A budget is consistent with the start where it differs by no more than this part.
BUDGET_TOLERANCE = 1e-9
#: Excess, as a part of the largest there is, that rounding leaves of none (it is quadratic in x - x_eq).
AT_EQUILIBRIUM = 1e-29
#: Slope of the excess, as a part of the excess, below which the populations cannot mend its round-off.
FADED = 1e-2


class EntropyLaw(ABC):
    """What entropy, times T, has been produced since the start."""

    #: Whether `excess_rate` looks at the excess of the state.
    feedback: bool = False
    #: Shape of parameters that differ from system to system, (N,); () where none do.
    lanes: tuple[int, ...] = ()

    @abstractmethod
    def produced(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        """T(s(t) - s_0)."""

    def excess(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        """E(t) = E_0 - T(s(t) - s_0); laws that end at E = 0 write it without the difference."""
        return np.asarray(excess0 - self.produced(elapsed, excess0))

    @abstractmethod
    def excess_rate(self, elapsed: float | FloatArray, excess: FloatArray, excess0: FloatArray) -> FloatArray:
        """b = d(g - g_eq)/dt at a state whose excess is `excess`."""

    def check(self, excess0: FloatArray, most: FloatArray) -> None:
        """Refuse a law that the start cannot follow; `most` is the largest excess there is.

        Raises
        ------
        BudgetError
        """

    def relaxation_rate(self) -> float | FloatArray | None:
        """Rate at which a deviation from equilibrium decays, 0 if it stays; None if there is no such rate."""
        return None

    def take(self, lanes: NDArray[np.intp]) -> EntropyLaw:
        return self


class Relaxation(EntropyLaw):
    """s(t) = s_0 + (s_eq - s_0)(1 - exp(-t/tau)) (notes eqs. 148, 149).

    Parameters
    ----------
    tau : float or ndarray, shape (N,)
    budget : float, optional
        T(s_eq - s_0); left out, it is computed from the start, g(x_0) - g_eq.
    partial : bool
        Whether a smaller budget is meant: the system then stops short of equilibrium, in a state that keeps moving.

    Raises
    ------
    InputError
        If tau is not positive, or the budget negative or not finite.
    """

    feedback = True

    def __init__(self, tau: float | FloatArray, budget: float | None = None, *, partial: bool = False) -> None:
        self.tau: FloatArray = numbers(tau, "tau").copy()
        if self.tau.ndim > 1 or not np.all(np.isfinite(self.tau) & (self.tau > 0)):
            raise InputError(f"tau is a positive time, or one a system, not {tau}", item="tau")
        self.lanes = self.tau.shape
        self.budget = None if budget is None else finite_number(budget, "budget")
        if self.budget is not None and self.budget < 0:
            raise InputError(f"the budget T(s_eq - s_0) is not negative, so it cannot be {budget}", item="budget")
        self.partial = partial

    def _budget(self, excess0: FloatArray) -> FloatArray:
        # A budget that agrees with the start is the start's.
        return np.asarray(self.budget) if self.partial and self.budget is not None else excess0

    def produced(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        return -self._budget(excess0) * np.expm1(-np.asarray(elapsed) / self.tau)

    def excess(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        budget = self._budget(excess0)
        return np.asarray(budget * np.exp(-np.asarray(elapsed) / self.tau) + (excess0 - budget))

    def excess_rate(self, elapsed: float | FloatArray, excess: FloatArray, excess0: FloatArray) -> FloatArray:
        # Told by the state instead of the time: the same on the constraint, but errors fade instead of piling up.
        return -(excess - (excess0 - self._budget(excess0))) / self.tau

    def check(self, excess0: FloatArray, most: FloatArray) -> None:
        if np.all(excess0 <= AT_EQUILIBRIUM * np.abs(most)):
            raise BudgetError(
                "the start is already at equilibrium, where no entropy is left to be produced and the row has no "
                "direction; start elsewhere, or hold the total population alone (with_fixed_total)",
                budget=0.0 if self.budget is None else self.budget,
                consistent=0.0,
                time=0.0,
            )
        if self.budget is None:
            return
        allowed = float(np.max(excess0))
        share = self.budget / allowed if allowed > 0 else np.inf if self.budget else 1.0
        if share > 1.0 + BUDGET_TOLERANCE:
            time = float(-np.max(self.tau) * np.log1p(-1.0 / share)) if np.isfinite(share) else 0.0
            raise BudgetError(
                f"T(s_eq - s_0) = {self.budget:.10g} is more than the start can produce, g(x_0) - g_eq = {allowed:.10g}"
                f": equilibrium would be reached at t = {time:.6g} with entropy still to be produced. "
                "Leave the budget out, it is then computed",
                budget=self.budget,
                consistent=allowed,
                time=time,
            )
        if share < 1.0 - BUDGET_TOLERANCE and not self.partial:
            raise BudgetError(
                f"T(s_eq - s_0) = {self.budget:.10g} is less than what lies between the start and equilibrium, "
                f"g(x_0) - g_eq = {allowed:.10g}: the system would stop producing at an excess of "
                f"{allowed - self.budget:.6g}, and s_eq would not be the entropy at equilibrium. Leave the budget out, "
                "it is then computed, or say partial=True if this is meant",
                budget=self.budget,
                consistent=allowed,
                time=np.inf,
            )

    def relaxation_rate(self) -> float | FloatArray | None:
        return 1.0 / (2.0 * self.tau) if not self.partial else None

    def take(self, lanes: NDArray[np.intp]) -> Self:
        part = taken(self, lanes, "tau")
        part.lanes = part.tau.shape
        return part


class NoProduction(EntropyLaw):
    """ds = 0 (notes eq. 150)."""

    def produced(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        return np.zeros(np.broadcast_shapes(np.shape(elapsed), np.shape(excess0)))

    def excess_rate(self, elapsed: float | FloatArray, excess: FloatArray, excess0: FloatArray) -> FloatArray:
        return np.zeros(np.shape(excess))

    def relaxation_rate(self) -> float | FloatArray | None:
        return 0.0


class PrescribedProduction(EntropyLaw):
    """A production of your own.

    Parameters
    ----------
    produced : callable, t -> float
        T(s(t) - s_0), t counted from the start; 0 at t = 0. May fall (entropy taken from outside).
    rate : callable, t -> float
        Its time derivative.
    until : float
        The time up to which it will be asked for: so far it is checked.

    Raises
    ------
    InputError
        If `rate` is not the derivative of `produced`, or `until` is not positive.
    """

    #: Times at which a prescription is looked at before a run.
    LOOKS = 2001

    def __init__(self, produced: Callable[[float], float], rate: Callable[[float], float], *, until: float) -> None:
        check_call("produced", produced, ("t",))
        check_call("rate", rate, ("t",))
        self._produced, self._rate, self.until = produced, rate, positive(until, "until")
        if abs(produced(0.0)) > 1e-12:
            raise InputError(f"nothing has been produced at t = 0, not {produced(0.0):.6g}", item="produced")
        times = np.linspace(0.0, until, 101)
        pieces = [quad(rate, a, b, epsabs=1e-12, epsrel=1e-11)[0] for a, b in pairwise(times)]
        off = np.abs(np.cumsum(pieces) - [produced(t) for t in times[1:]])
        if not np.max(off) <= 1e-8 * max(1.0, float(np.max(np.abs(np.cumsum(pieces))))):
            k = int(np.argmax(~(off <= 1e-8)))
            raise InputError(
                f"the integral of the rate is not what is produced: at t = {times[k + 1]:.6g} they differ by "
                f"{off[k]:.3g}",
                item="rate",
            )

    def produced(self, elapsed: float | FloatArray, excess0: FloatArray) -> FloatArray:
        return np.vectorize(self._produced, otypes=[np.float64])(self._looked_at(elapsed))

    def _looked_at(self, elapsed: float | FloatArray) -> float | FloatArray:
        """Times from the start that lie in what was checked.

        Raises
        ------
        InputError
            They do not.
        """
        off = np.max(np.maximum(elapsed - self.until, -np.asarray(elapsed)), initial=0.0)
        if off > 1e-9 * self.until:
            raise InputError(
                f"the prescribed production is known from the start until {self.until:g} after it: end the run there, "
                "or raise `until`",
                item="until",
            )
        return elapsed

    def excess_rate(self, elapsed: float | FloatArray, excess: FloatArray, excess0: FloatArray) -> FloatArray:
        return -np.vectorize(self._rate, otypes=[np.float64])(self._looked_at(elapsed))

    def check(self, excess0: FloatArray, most: FloatArray) -> None:
        times = np.linspace(0.0, self.until, self.LOOKS)
        left = float(np.min(excess0)) - self.produced(times, excess0)
        for bad, reason in (
            (left < -1e-12 * np.max(excess0), "more than lies between the start and equilibrium"),
            (left > float(np.min(most)), "more entropy taken away than the populations can give up"),
        ):
            if np.any(bad):
                time = float(times[np.argmax(bad)])
                raise BudgetError(
                    f"the prescribed production asks for {reason} from t = {time:.6g} on; the start allows "
                    f"T(s - s_0) between {float(np.max(excess0) - np.min(most)):.6g} and {float(np.min(excess0)):.6g}",
                    budget=float(self.produced(time, excess0)),
                    consistent=float(np.min(excess0)),
                    time=time,
                )


class EntropyRow(Row):
    """The Gibbs energy of a mixture follows an entropy law; to be used together with `TotalPopulation`.

    Its row of A is mu less the mu of the largest population: a constant common to all species drops out where sum x is
    kept. So the row fades cleanly where the rank is lost: at equilibrium, and where one species is nearly alone.
    """

    holonomic = True
    name = "entropy production"

    def __init__(self, mixture: Mixture, law: EntropyLaw) -> None:
        refuse_other(mixture, Mixture, "mixture", "a kcons.models.growth.Mixture")
        refuse_other(law, EntropyLaw, "law", "a law such as kcons.models.growth.Relaxation(tau)")
        self.mixture = mixture
        self.law = law
        self.lanes = common_lanes(mixture=mixture.lanes, law=law.lanes)
        self.start: float | FloatArray = 0.0
        self.total: FloatArray | None = None
        self.excess0: FloatArray | None = None

    def _total(self, p: Populations) -> FloatArray:
        return np.asarray(np.sum(p.x, axis=0)) if self.total is None else self.total

    def law_excess(self, time: float | FloatArray) -> FloatArray:
        """E(t) = g - g_eq as the law has it, for a row that is bound to a start."""
        assert self.excess0 is not None
        return self.law.excess(np.asarray(time) - self.start, self.excess0)

    def gradient(self, p: Populations) -> FloatArray:
        return self.mixture.relative_potentials(p)

    def rate(self, p: Populations) -> FloatArray:
        if self.law.feedback or self.excess0 is None:
            excess = self.mixture.excess(p, self._total(p))
        else:
            excess = np.zeros(p.x.shape[1:])
        excess0 = excess if self.excess0 is None else self.excess0
        return self.law.excess_rate(np.asarray(p.time) - self.start, excess, excess0)

    def value(self, p: Populations) -> FloatArray:
        return self.mixture.excess_over(p, self._total(p), self.law_excess(p.time))

    def size(self, p: Populations) -> FloatArray:
        # ln x carries an error of some 1e-16 of itself, which enters through the gradient; squared where there is none.
        error = np.maximum(1.0, np.abs(p.log_x))
        slope = np.sum(p.x * np.maximum(np.abs(self.gradient(p)), 4.0 * EPSILON * error) * error, axis=0)
        excess = np.abs(self.law_excess(p.time))
        # Where one species is nearly alone, no ln x must be moved to mend what the rounding of sum x does here.
        slope = np.where(slope < FADED * excess, excess, slope)
        # Elsewhere the excess cancels, see Mixture.excess_over; terms of some kT sum x are left.
        return np.maximum(4.0 * np.minimum(excess, self.mixture.kT * self._total(p)), slope)

    def bind(self, p: Populations) -> EntropyRow:
        if self.mixture.n != len(p.x):
            raise InputError(f"the mixture has {self.mixture.n} species, the start {len(p.x)}", item="mixture")
        bound = copy.copy(self)
        bound.start = p.time
        bound.total = compensated_sum(p.x)
        # In two steps, the second of which sees what the first rounded off.
        about = self.mixture.excess(p, bound.total)
        bound.excess0 = about + self.mixture.excess_over(p, bound.total, about)
        most = self.mixture.largest_gibbs_energy(bound.total) - self.mixture.least_gibbs_energy(bound.total)
        self.law.check(bound.excess0, np.asarray(most))
        return bound

    def take(self, lanes: NDArray[np.intp]) -> EntropyRow:
        part = taken(self, lanes, "start", "total", "excess0")
        part.mixture, part.law = self.mixture.take(lanes), self.law.take(lanes)
        part.lanes = lanes.shape if self.lanes else ()
        return part


class EntropyBalance(NamedTuple):
    """Three ways to the entropy, times T, that a solution has produced, and where it went.

    Attributes
    ----------
    lost : float
        g(x_0) - g(x(t)), from the two ends alone.
    integrated : float
        The integral of -sum mu dx/dt along the solution.
    prescribed : float
        What the law says.
    reactions, exchanged : float
        The parts of `integrated` (notes eq. 145): of what the model does by itself, Psi + G phi, and of what the
        constraints add to it, G z. In an open system (eq. 150) these are the entropy produced inside and the one
        exchanged with the outside; in a closed one (eq. 149) nothing is exchanged, and their sum is produced inside.
    """

    lost: float
    integrated: float
    prescribed: float
    reactions: float
    exchanged: float


def entropy_balance(solution: GrowthSolution, nodes: int = 8) -> EntropyBalance:
    """Whether the entropy produced is the integral of its prescribed rate.

    Parameters
    ----------
    solution : GrowthSolution
        Of a system with an `EntropyRow`, with dense_output=True.
    nodes : int
        Gauss points between two times of the solution.

    Raises
    ------
    InputError
        If the solution has no interpolant, or its system no entropy row.
    """
    row = next((r for r in solution.system.rows if isinstance(r, EntropyRow)), None)
    if row is None or row.total is None or row.excess0 is None:
        raise InputError("the system of this solution has no row of entropy production", item="solution")
    if solution.sol is None:
        raise InputError(
            "the integral needs the solution between its times: solve(..., dense_output=True)", item="solution"
        )
    points, weights = np.polynomial.legendre.leggauss(nodes)
    integrated = reactions = 0.0
    for a, b in pairwise(solution.t):
        times = 0.5 * (a + b) + 0.5 * (b - a) * points
        for t, weight, log_x in zip(times, weights, solution.sol.logarithms(times).T, strict=True):
            p = Populations.from_logarithms(float(t), log_x)
            fall = -0.5 * (b - a) * weight * row.mixture.potentials(p)
            integrated += float(np.sum(fall * p.x * solution.system.logarithmic_velocity(p)))
            reactions += float(np.sum(fall * solution.system.model.drift(p)))
    ends = [Populations.from_logarithms(float(solution.t[k]), solution.log_y[:, k]) for k in (0, -1)]
    lost = float(row.mixture.excess(ends[0], row.total) - row.mixture.excess(ends[1], row.total))
    prescribed = float(row.excess0 - row.law_excess(float(solution.t[-1])))
    return EntropyBalance(lost, integrated, prescribed, reactions, integrated - reactions)
