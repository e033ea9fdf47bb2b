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

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, positive, whole_number
from kcons.errors import ConvergenceError, InputError
from kcons.models.growth.constrained import ConstrainedGrowth
from kcons.models.growth.model import EntropyRow, GrowthModel, Mixture, Populations, TotalPopulation

__all__ = ["ConstrainedHypercycle", "Hypercycle"]

#: A motion may count as settled where ln(x/x_eq) is this small and the direction turns this slowly, in parts of the
#: other times; it does within so many times the tolerance, since so far do integrators stray.
NEARNESS, SLOWNESS, STRAYING = 0.1, 0.3, 20.0
#: Where the excess is this part of kT sum x, its direction no longer matters.
NEGLIGIBLE_EXCESS = 1e-22


class Hypercycle(GrowthModel):
    """n species, each of which helps to make the one before it.

    Parameters
    ----------
    n : int
    k_h : float
        Rate constant.
    mu0 : array_like, shape (n,), optional
        Standard chemical potentials; those of figure 11 where left out, (0.1 + 0.05 l) kT with l = 1..n.
    kT : float
    """

    def __init__(self, n: int = 5, k_h: float = 3.0, mu0: ArrayLike | None = None, kT: float = 1.0) -> None:
        super().__init__(lambda t, x: self.k_h * np.roll(x, -1), n=whole_number(n, "n", 2))
        self.k_h = positive(k_h, "k_h")
        self.mixture = Mixture((0.1 + 0.05 * np.arange(1, n + 1)) * positive(kT, "kT") if mu0 is None else mu0, kT)
        if self.mixture.n != n:
            raise InputError(f"{self.mixture.n} standard potentials for {n} species", item="mu0")

    # -- the three systems of figure 11 ----------------------------------------------------------------

    def with_fixed_total(self) -> ConstrainedHypercycle:
        """(a): sum x fixed (notes eq. 144)."""
        return ConstrainedHypercycle(self, [TotalPopulation(self.n)])

    def with_entropy_production(self, tau: float, budget: float | None = None) -> ConstrainedHypercycle:
        """(b): sum x fixed, and entropy produced at a rate that decays with the time tau (notes eq. 149).

        The budget T(s_eq - s_0) is computed from the start where it is not given, and checked against it where it is.
        """
        return ConstrainedHypercycle(self, [TotalPopulation(self.n), EntropyRow(self.mixture, tau, budget)])

    def without_entropy_production(self) -> ConstrainedHypercycle:
        """(c): sum x fixed, no entropy produced in all (notes eq. 150)."""
        return ConstrainedHypercycle(self, [TotalPopulation(self.n), EntropyRow(self.mixture)])

    # -- the closed form of the notes ------------------------------------------------------------------

    def closed_form_inverse(self, x: ArrayLike) -> FloatArray:
        """G_perp+ of the rows 1 and mu, shape (n, n) (notes eq. 151; for any sum M_0 of the populations).

        (M_0 mu_i mu_j - M_1(mu_i + mu_j) + M_2)/(M_0 M_2 - M_1^2); the notes have M_0 = 1.
        """
        p = Populations.from_values(0.0, x)
        mu = self.mixture.potentials(p)
        M0, M1, M2 = self.mixture.moments(p)
        return np.asarray((M0 * np.outer(mu, mu) - M1 * np.add.outer(mu, mu) + M2) / (M0 * M2 - M1 * M1))

    def closed_form_rates(self, x: ArrayLike, b2: float = 0.0) -> FloatArray:
        """z of the rows sum dx/dt = 0, sum mu dx/dt = b2, shape of x (notes eq. 153; for any sum M_0)."""
        p = Populations.from_values(0.0, x)
        mu = self.mixture.potentials(p)
        M0, M1, M2 = self.mixture.moments(p)
        reactions = p.x * self.rates(p)
        eta0 = np.sum(reactions)
        eta1 = b2 - np.sum(reactions * mu)
        return np.asarray(((M0 * eta1 + eta0 * M1) * mu - (eta1 * M1 + eta0 * M2)) / (M0 * M2 - M1 * M1))


class ConstrainedHypercycle(ConstrainedGrowth):
    """A hypercycle with a fixed sum of populations and, perhaps, a law of entropy production."""

    model: Hypercycle

    def settled(self, time: float, log_x: FloatArray, tolerance: float) -> Callable[[float], FloatArray] | None:
        """The slow motion from here on, once the state is on it to `tolerance`; None before.

        d(ln x)/dt = phi + lambda_1 + lambda_2 mu. Close to x_eq, u = ln(x/x_eq) shrinks at the rate of the law,
        du/dt = -rho u, and mu is kT u but for a constant, so that u = s (phi(x) + lambda_1): its two unknowns come from
        the two rows, and x by iteration. The terms left out are of the order of rho r^3/|phi|, r the size of u.

        Where nothing turns (two species, potentials that are all equal) the motion counts as settled when the excess is
        negligible; its direction then stays.
        """
        row = self.entropy_row
        if row is None:
            return None
        rho = 0.5 / row.tau
        log_eq, scale = self.model.mixture.equilibrium(row.total), self.model.mixture.kT * row.total

        def size(t: float) -> float:
            """The size of ln(x/x_eq) that belongs to the excess."""
            return float(np.sqrt(2.0 * max(row.law_excess(t), 0.0) / scale))

        def push(y: FloatArray) -> tuple[FloatArray, float]:
            """phi less its mean, and the size of it."""
            phi = self.model.rates(Populations.from_logarithms(time, y))
            phi = phi - np.exp(log_eq) @ phi / row.total
            return phi, float(np.sqrt(np.exp(log_eq) @ phi**2 / row.total))

        def slow(t: float, accuracy: float = 0.0) -> FloatArray:
            y, small = log_eq, size(t)
            for _ in range(60 if small > 1e-15 else 0):
                phi, length = push(y)
                before, y = y, self.project(t, log_eq + small / length * phi)
                if np.max(np.abs(y - before) - 4e-16 * np.abs(y)) <= accuracy:
                    break
            return y

        small, length = size(time), push(log_eq)[1]
        others = self.model.k_h * row.total + rho
        near = small < NEARNESS and others * small < SLOWNESS * length and rho * small**3 < tolerance * length
        if self.n > 2 and near:
            try:
                if np.max(np.abs(slow(time, 0.1 * tolerance) - log_x)) < STRAYING * tolerance:
                    return slow
            except ConvergenceError:
                return None
        if row.law_excess(time) > NEGLIGIBLE_EXCESS * scale:
            return None
        left = size(time) or 1.0
        return lambda t: log_eq + (log_x - log_eq) * min(size(t) / left, 1.0)
