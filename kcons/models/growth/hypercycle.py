"""The hypercycle of Eigen and Schuster, for any number of species (notes section 4.3.2).

    dx_i/dt = k_h x_i x_{i+1},  x_{n+1} = x_1   (eq. 142),     phi_i = k_h x_{i+1},  Psi = 0

held to a fixed sum of the populations (eqs. 143, 144), and to a production of entropy that relaxes to equilibrium (149)
or vanishes (150).

Towards equilibrium all chemical potentials become equal, the entropy row fades into the row of the sum, and the
direction of x - x_eq turns faster and faster towards the one in which the reactions push. Once it has got there,
nothing is left to integrate: ln x - ln x_eq is proportional to phi - lambda, and the two rows say how far. That is what
`settled` returns, so that the solution arrives at equilibrium instead of getting stuck before it.

References
----------
Horvath & Kneller, J. Chem. Phys. 131, 171101 (2009). Eigen & Schuster, The Hypercycle (Springer, 1979).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import numbers, whole_number
from kcons.errors import InputError
from kcons.models.growth.constrained import ACCEPTED, ConstrainedGrowth
from kcons.models.growth.entropy import EntropyLaw, EntropyRow, NoProduction, Relaxation
from kcons.models.growth.mixture import Mixture
from kcons.models.growth.model import FloatArray, GrowthModel, Populations, common_lanes
from kcons.models.growth.rows import Row, TotalPopulation

#: Largest turning time of the direction, in parts of the other times, at which motion may count as settled.
SLOWNESS = 0.3
#: A motion counts as settled within this many times the tolerance: so far do integrators stray.
STRAYING = 20.0
#: Nor is it looked for before ln(x/x_eq) is this small.
NEARNESS = 0.1
#: Where the excess is this part of kT sum x, its direction no longer matters.
NEGLIGIBLE_EXCESS = 1e-22
#: Extinct is what lies below this part of the sum.
EXTINCT = 1e-24
#: Variance of mu over the populations, in kT^2, below which extinct species are about to return at once,
FADED = 1e-14
#: and ln x of the first of them when they are back: x (ln x)^2 = 1e-13.
RETURNED = -37.2


class Hypercycle(GrowthModel):
    """n species, each of which helps to make the one before it.

    Parameters
    ----------
    n : int
    k_h : float or array_like, shape (N,)
        Rate constant; one for each of N systems side by side, if wanted.
    mu0 : array_like, shape (n,) or (n, N), optional
        Standard chemical potentials; those of figure 11 where left out, (0.1 + 0.05 l) kT with l = 1..n.
    kT : float or array_like, shape (N,)

    Raises
    ------
    InputError
        If n < 2, or a rate constant is not a positive number.
    """

    def __init__(self, n: int = 5, k_h: ArrayLike = 3.0, mu0: ArrayLike | None = None, kT: ArrayLike = 1.0) -> None:
        n = whole_number(n, "n", 2)
        super().__init__(lambda t, x: self.k_h * np.roll(x, -1, axis=0), n=n, vectorized=True)
        self.k_h: FloatArray = numbers(k_h, "k_h").copy()
        if self.k_h.ndim > 1 or not np.all(np.isfinite(self.k_h) & (self.k_h > 0)):
            raise InputError(f"the rate constant k_h is positive and finite, not {self.k_h}", item="k_h")
        if mu0 is None:
            levels = 0.1 + 0.05 * np.arange(1, n + 1)
            mu0 = np.multiply.outer(levels, numbers(kT, "kT"))
        self.mixture = Mixture(mu0, kT)
        if self.mixture.n != n:
            raise InputError(f"{self.mixture.n} standard potentials for {n} species", item="mu0")
        self.lanes = common_lanes(k_h=self.k_h.shape, mixture=self.mixture.lanes)

    def take(self, lanes: NDArray[np.intp]) -> Hypercycle:
        taken = Hypercycle.__new__(Hypercycle)
        GrowthModel.__init__(taken, lambda t, x: taken.k_h * np.roll(x, -1, axis=0), n=self.n, vectorized=True)
        taken.k_h = self.k_h[lanes] if self.k_h.ndim else self.k_h
        taken.mixture = self.mixture.take(lanes)
        taken.lanes = lanes.shape if self.lanes else ()
        return taken

    # -- the three systems of figure 11 ----------------------------------------------------------------

    def with_fixed_total(self) -> ConstrainedHypercycle:
        """(a): sum x fixed (notes eq. 144)."""
        return ConstrainedHypercycle(self, [TotalPopulation(self.n)])

    def with_entropy_production(
        self, tau: ArrayLike, budget: float | None = None, *, partial: bool = False
    ) -> ConstrainedHypercycle:
        """(b): sum x fixed, and entropy produced at a rate that decays with the time tau (notes eq. 149).

        The budget T(s_eq - s_0) is computed from the start where it is not given, and checked against it where it is.
        """
        return self.with_law(Relaxation(numbers(tau, "tau"), budget, partial=partial))

    def without_entropy_production(self) -> ConstrainedHypercycle:
        """(c): sum x fixed, no entropy produced in all (notes eq. 150)."""
        return self.with_law(NoProduction())

    def with_law(self, law: EntropyLaw) -> ConstrainedHypercycle:
        """sum x fixed, and any law of entropy production."""
        return ConstrainedHypercycle(self, [TotalPopulation(self.n), EntropyRow(self.mixture, law)])

    # -- the closed form of the notes ------------------------------------------------------------------

    def closed_form_inverse(self, x: ArrayLike) -> FloatArray:
        """G_perp+ of the rows 1 and mu, shape (n, n) (notes eq. 151; for any sum M_0 of the populations).

        (M_0 mu_i mu_j - M_1(mu_i + mu_j) + M_2)/(M_0 M_2 - M_1^2); the notes have M_0 = 1.
        """
        p = Populations.from_values(0.0, x)
        mu = self.mixture.potentials(p)
        M0, M1, M2 = self.mixture.moments(p)
        return np.asarray((M0 * np.outer(mu, mu) - M1 * np.add.outer(mu, mu) + M2) / (M0 * M2 - M1 * M1))

    def closed_form_rates(self, x: ArrayLike, b2: ArrayLike = 0.0) -> FloatArray:
        """z of the rows sum dx/dt = 0, sum mu dx/dt = b2, shape of x (notes eq. 153; for any sum M_0)."""
        p = Populations.from_values(0.0, x)
        mu = self.mixture.potentials(p)
        M0, M1, M2 = self.mixture.moments(p)
        reactions = p.x * self.rates(p)
        eta0 = np.sum(reactions, axis=0)
        eta1 = b2 - np.sum(reactions * mu, axis=0)
        return np.asarray(((M0 * eta1 + eta0 * M1) * mu - (eta1 * M1 + eta0 * M2)) / (M0 * M2 - M1 * M1))

    def interior_eigenvalues(self, total: float = 1.0) -> NDArray[np.complex128]:
        """Eigenvalues at x_i = total/n with the sum fixed: (k_h total/n) exp(2 pi i j/n), j = 1..n-1."""
        return np.asarray(self.k_h * total / self.n * np.exp(2j * np.pi * np.arange(1, self.n) / self.n))


class ConstrainedHypercycle(ConstrainedGrowth):
    """A hypercycle with a fixed sum of populations and, perhaps, a law of entropy production."""

    model: Hypercycle

    def __init__(self, model: Hypercycle, rows: list[Row]) -> None:
        super().__init__(model, rows)

    @property
    def entropy_row(self) -> EntropyRow | None:
        return next((row for row in self.rows if isinstance(row, EntropyRow)), None)

    def bind(self, p: Populations) -> Self:
        bound = super().bind(p)
        return copy.copy(bound)

    def multipliers(self, t: float, x: ArrayLike) -> FloatArray:
        """lambda of the rows 1 and mu, as in the notes, shape (m,) or (m, N)."""
        found = np.array(super().multipliers(t, x))
        if self.entropy_row is not None:
            # The entropy row is kept as mu less the mu of the largest population.
            p = Populations.from_values(t, x)
            found[0] = found[0] - found[1] * np.max(
                np.where(p.x == np.max(p.x, axis=0), self.model.mixture.potentials(p), -np.inf), axis=0
            )
        return found

    # -- the return of extinct species -----------------------------------------------------------------

    def past_instants(self, time: float | FloatArray, log_x: FloatArray) -> FloatArray:
        """Bring extinct species back where entropy can be produced in no other way.

        With some species extinct, the others have an equilibrium of their own, at which the entropy row fades as it
        does at the true one. The law asks for more: lambda_2 grows like -1/(t* - t), and every ln x of an extinct
        species returns as (t* - t)^(1/2), from -1e8 or less, in less time than the last digit of t. In that time
        nothing else moves, and all of them keep their proportions mu_i - <mu>: they are taken to where the first of
        them counts again.
        """
        row = self.entropy_row
        if row is None:
            return log_x
        p = Populations.from_logarithms(time, log_x)
        total = np.sum(p.x, axis=0)
        extinct = p.x < EXTINCT * total
        if not extinct.any():
            return log_x
        kT = self.model.mixture.kT
        mu = row.gradient(p) / kT
        mean = np.sum(p.x * mu, axis=0) / total
        away = np.where(extinct, 0.0, mu - mean)
        faded = np.sum(p.x * away * away, axis=0) < FADED * total
        # lambda_2 < 0: towards the return, not into extinction.
        pull = row.rate(p) - kT * np.sum(p.x * away * self.model.rates(p), axis=0)
        level = np.max(np.where(extinct, log_x - np.log(total), -np.inf), axis=0)
        here = faded & (pull < 0) & extinct.any(axis=0) & (level < RETURNED)
        if not np.any(here):
            return log_x
        with np.errstate(all="ignore"):
            first = np.max(np.where(extinct, mu - mean, -np.inf), axis=0)
            share = (first + RETURNED - level) / first
            moved = np.where(extinct & here, log_x + (share - 1.0) * (mu - mean), log_x)
        projected, left = self.try_project(time, moved)
        return np.where(here & (left <= ACCEPTED), projected, log_x)

    # -- arrival at equilibrium ------------------------------------------------------------------------

    def slow_state(self, time: ArrayLike, accuracy: float = 0.0) -> FloatArray:
        """Where all is settled but the approach to equilibrium: ln x, shape (n, k), at times of shape (k,).

        d(ln x)/dt = phi + lambda_1 + lambda_2 mu. Close to x_eq, u = ln(x/x_eq) shrinks at the rate of the law,
        du/dt = -rho u, and mu is kT u but for a constant, so that u = s (phi(x) + lambda_1): its two unknowns come from
        the two rows, and x by iteration. The terms left out are of the order of rho r^3/|phi|, r the size of u.
        """
        row = self.entropy_row
        assert row is not None and row.total is not None
        times = np.atleast_1d(np.asarray(time, dtype=np.float64))
        log_eq, x_eq, size = self._near_equilibrium(times)
        y = np.array(log_eq)
        away = np.flatnonzero(size > 1e-15)
        part, when = self.take(away), times[away]
        for _ in range(60 if len(away) else 0):
            push, length = part._push(Populations.from_logarithms(when, y[:, away]), x_eq[:, away])
            trial, _ = part.try_project(when, log_eq[:, away] + size[away] / length * push)
            moved = np.max(np.abs(trial - y[:, away]) - 4e-16 * np.abs(trial), axis=0)
            y[:, away] = trial
            going = moved > accuracy
            if not going.any():
                break
            if not going.all():
                away, when, part = away[going], when[going], part.take(np.flatnonzero(going))
        return y

    def _near_equilibrium(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """ln x_eq, x_eq, shape (n, k), and the size of ln(x/x_eq) that belongs to the excess, shape (k,)."""
        row = self.entropy_row
        assert row is not None and row.total is not None
        log_eq = self.model.mixture.equilibrium(row.total)
        log_eq = np.broadcast_to(log_eq if log_eq.ndim == 2 else log_eq[:, None], (self.n, len(times)))
        excess = np.broadcast_to(np.maximum(row.law_excess(times), 0.0), times.shape)
        return log_eq, np.exp(log_eq), np.sqrt(2.0 * excess / (self.model.mixture.kT * row.total))

    def _push(self, p: Populations, x_eq: FloatArray) -> tuple[FloatArray, FloatArray]:
        """phi less its mean, shape (n, k), and the size of it, shape (k,)."""
        total = np.sum(x_eq, axis=0)
        push = self.model.rates(p)
        push = push - np.sum(x_eq * push, axis=0) / total
        return push, np.sqrt(np.sum(x_eq * push * push, axis=0) / total)

    def settled_lanes(self, time: FloatArray, log_x: FloatArray, tolerance: float) -> NDArray[np.bool_]:
        """Which of the systems log_x, shape (n, N), at times (N,), are on their slow motion to `tolerance`."""
        row = self.entropy_row
        settled = np.zeros(log_x.shape[1:], dtype=bool)
        rho = None if row is None else row.law.relaxation_rate()
        if row is None or rho is None or row.total is None or self.n < 3:
            return settled
        log_eq, x_eq, size = self._near_equilibrium(time)
        if not np.any(size < NEARNESS):
            return settled
        _, length = self._push(Populations.from_logarithms(time, log_eq), x_eq)
        with np.errstate(divide="ignore", invalid="ignore"):
            others = self.model.k_h * row.total + rho
            near = (size < NEARNESS) & (others * size < SLOWNESS * length) & (rho * size**3 < tolerance * length)
        lanes = np.flatnonzero(near)
        if len(lanes):
            y = self.take(lanes).slow_state(time[lanes], 0.1 * tolerance)
            settled[lanes] = np.max(np.abs(y - log_x[:, lanes]), axis=0) < STRAYING * tolerance
        return settled

    def arrived_lanes(self, time: FloatArray, log_x: FloatArray) -> NDArray[np.bool_]:
        """Which of the systems have no excess left that numbers could tell."""
        row = self.entropy_row
        if row is None or row.total is None or row.law.relaxation_rate() is None:
            return np.zeros(log_x.shape[1:], dtype=bool)
        few = NEGLIGIBLE_EXCESS * self.model.mixture.kT * row.total
        return np.broadcast_to(row.law_excess(time) <= few, log_x.shape[1:])

    def rest_state(self, time: FloatArray, log_x: FloatArray, later: FloatArray) -> FloatArray:
        """ln x at times `later`: the direction from equilibrium stays, its length shrinks with the law."""
        row = self.entropy_row
        assert row is not None and row.total is not None
        log_eq = self.model.mixture.equilibrium(row.total)
        log_eq = log_eq[:, None] if log_eq.ndim == 1 else log_eq
        excess = np.maximum(row.law_excess(time), np.finfo(np.float64).tiny)
        shrink = np.sqrt(np.maximum(row.law_excess(later), 0.0) / excess)
        return np.asarray(log_eq + (log_x - log_eq) * np.minimum(shrink, 1.0))

    def settled(self, time: float, log_x: FloatArray, tolerance: float) -> Callable[[FloatArray], FloatArray] | None:
        """The slow motion from here on, once the state is on it to `tolerance`; None before.

        Where the potentials mu0 are all equal nothing turns, and the motion counts as settled when the excess is
        negligible; its direction then stays.
        """
        row = self.entropy_row
        if row is None or row.total is None or row.law.relaxation_rate() is None:
            return None
        if self.settled_lanes(np.array([time]), log_x[:, None], tolerance)[0]:
            return self.slow_state
        when, start = np.array([time]), log_x[:, None]
        if not self.arrived_lanes(when, start)[0]:
            return None
        return lambda times: self.rest_state(when, start, times)
