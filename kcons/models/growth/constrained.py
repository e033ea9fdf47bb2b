"""Growth under constraints, its trajectories (notes section 4.3.1), and hypercycles (section 4.3.2).

    dx/dt = Psi + G (phi + z),   A dx/dt = b,   z = A^T lambda,   (A G A^T) lambda = b - A(Psi + G phi)

(eqs. 124-141). z acts as an additional relative rate, so that positivity is untouched: with Psi = 0,
d ln x/dt = phi + z.

The rows are made orthogonal in the scalar product <a, a'> = sum_i x_i a_i a'_i, one after another (Gram-Schmidt, each
row twice): a QR factorization of (A G^1/2)^T, which never forms A G A^T, whose condition number is the square.

Trajectories are those of SciPy's ``solve_ivp``. The unknown is y = ln x, dy/dt = phi + z + Psi exp(-y), so that x is
positive whatever the step; nothing is ever clipped. After each step the state is put back on the holonomic rows to
round-off, by y + A^T mu with Newton's iteration, and the next step starts from there; so are values between.

The hypercycle of Eigen and Schuster, for any number of species:

    dx_i/dt = k_h x_i x_{i+1},  x_{n+1} = x_1   (eq. 142),     phi_i = k_h x_{i+1},  Psi = 0

Towards equilibrium all chemical potentials become equal, the entropy row fades into the row of the sum, and the
direction of x - x_eq turns faster and faster towards the one in which the reactions push. Once it has got there,
ln x - ln x_eq is proportional to phi - lambda, and the two rows say how far: the state is projected on this slow
motion, so that the solution arrives at equilibrium instead of getting stuck before it.

References
----------
Horvath & Kneller, J. Chem. Phys. 131, 171101 (2009). Bott & Duffin, Trans. AMS 74, 99 (1953).
Eigen & Schuster, The Hypercycle (Springer, 1979).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import quad_vec
from scipy.optimize import OptimizeResult

from kcons.constraints import projection
from kcons.constraints.arguments import FloatArray, as_float_array, check_call, positive, refuse_other, whole_number
from kcons.errors import (
    ConstraintError,
    ContradictionError,
    ConvergenceError,
    InputError,
    NonFiniteError,
)
from kcons.models.growth.model import EntropyRow, GrowthModel, LinearRow, Mixture, Populations, Row, TotalPopulation
from kcons.models.integration import called, check_run, integrate

__all__ = ["ConstrainedGrowth", "ConstrainedHypercycle", "Hypercycle", "entropy_balance", "solve"]

Event = Callable[[float, FloatArray], float]
EPSILON = float(np.finfo(np.float64).eps)
TINY = float(np.finfo(np.float64).tiny)
#: A row depends on those before it where less than this part of its length is its own: rounding of sums, no rank of a
#: matrix, whose limit is that of `kcons.solvers.rank_revealing`.
LOST = 1e-12
#: A dependent row contradicts the others where its right side is off by more than this part of its terms.
SOLVABILITY_TOLERANCE = 1e-9
#: How far off, in parts of its own size, a start may lie from the rows that it is to keep.
START_TOLERANCE = 1e-10
#: Newton iterations of a projection at most. It has arrived at the round-off of the rows; after `STALLED` iterations
#: at `ACCEPTED` times that.
MOST_ITERATIONS, STALLED, ACCEPTED = 25, 4, 50.0
#: Least ln x. Where the rows press on a species that is extinct, ln x falls like -e^(lambda t), beyond all numbers of
#: the machine in finite time; x and x ln x are 0 long before. A fall fades out here; a return starts from here.
LEAST_LOGARITHM = -1e300
#: A motion may count as settled where ln(x/x_eq) is this small and the direction turns this slowly, in parts of the
#: other times; it does within so many times the tolerance, since so far do integrators stray.
NEARNESS, SLOWNESS, STRAYING = 0.1, 0.3, 20.0


def constraint_rates(
    x: FloatArray, rows: Sequence[FloatArray], right: Sequence[float], drift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """z with A (drift + G z) = right, drift = Psi + G phi, in the space of the rows, shape (n,) (notes eqs. 137, 138).

    And for rows that depend on those before them what is missing in the right side, in parts of the terms that it is
    made of, shape (m,); NaN for the others.
    """
    m = len(rows)
    units, asked, along, missing = np.zeros((m, len(x))), np.zeros(m), np.zeros(m), np.full(m, np.nan)
    b: Any
    for k, q in enumerate(rows):
        b = right[k]
        for _ in range(2 if k else 0):
            part = units[:k] @ (x * q)
            q, b = q - part @ units[:k], b - part @ asked[:k]
        left, squared = b - q @ drift, float((x * q) @ q)
        if not np.isfinite(squared):  # a coefficient is not finite; nor is z
            along[k] = np.nan
        elif squared > LOST**2 * float((x * rows[k]) @ rows[k]):
            length = np.sqrt(squared)
            units[k], asked[k], along[k] = q / length, b / length, left / length
        else:
            missing[k] = abs(left) / (float(np.abs(rows[k] * drift).sum()) + abs(right[k]) or 1.0)
    return along @ units, missing


class ConstrainedGrowth:
    """A growth model with rows that it is held to.

    Parameters
    ----------
    model : GrowthModel
    rows : sequence of Row
        Holonomic and velocity rows, in any order; none at all leaves the model free.

    Raises
    ------
    ConstraintError
        If there are more rows than species, or entropy has a law where the sum of populations is not kept.
    """

    def __init__(self, model: GrowthModel, rows: Sequence[Row] | Row = ()) -> None:
        refuse_other(model, GrowthModel, "model", "a kcons.models.growth.GrowthModel")
        refuse_other(rows, (Row, Iterable), "rows", "rows of kcons.models.growth, or an empty list")
        self.model = model
        self.rows: tuple[Row, ...] = (rows,) if isinstance(rows, Row) else tuple(rows)
        for row in self.rows:
            refuse_other(row, Row, "rows", "rows of kcons.models.growth, such as TotalPopulation(n)")
        if len(self.rows) > model.n:
            raise ConstraintError(
                f"{len(self.rows)} rows for {model.n} species: give at most as many rows as there are species",
                rows=range(model.n, len(self.rows)),
            )
        equal = (row for row in self.rows if isinstance(row, LinearRow) and np.ptp(row.coefficients) == 0)
        if self.entropy_row is not None and all(row.moving for row in equal):
            what = "EntropyRow is the law of a closed system, whose sum of populations is kept: add TotalPopulation(n)"
            raise ConstraintError(f"{what} with a target that rests", rows=[self.rows.index(self.entropy_row)])

    #: Least error of ln x that a run asks for, and from when on its motion is the slow one.
    tolerance, settled_time = 1e-9, math.inf

    @property
    def entropy_row(self) -> EntropyRow | None:
        return next((row for row in self.rows if isinstance(row, EntropyRow)), None)

    def bind(self, p: Populations) -> Self:
        """The same system with all targets set by the start `p`; refused if that is off a row, or rows contradict."""
        if p.x.shape != (self.model.n,):
            raise InputError(f"the start has populations of shape {p.x.shape}, the model {self.model.n}", item="x0")
        bound = copy.copy(self)
        bound.rows = tuple(row.bind(p) for row in self.rows)
        for number, row in enumerate(bound.rows):
            off = abs(row.value(p)) / max(row.size(p), TINY) if row.holonomic else 0.0
            if not off <= START_TOLERANCE:
                raise ConstraintError(
                    f"the start is off row {number} ({row.name}): relative deviation {off:.3g}. Start on it, or leave "
                    "the target out to keep the value found at the start",
                    rows=[number],
                )
        bound.held(p, bound.model.drift(p))
        return bound

    # -- the constrained equation of motion ----------------------------------------------------------

    def held(self, p: Populations, drift: FloatArray) -> FloatArray:
        """z; refused where the rank is lost and the rows contradict each other, or a number is not finite."""
        with np.errstate(all="ignore"):
            rows, right = [row.gradient(p) for row in self.rows], [row.rate(p) for row in self.rows]
            z, missing = constraint_rates(p.x, rows, right, drift)
        if np.any(missing > SOLVABILITY_TOLERANCE):
            number = int(np.argmax(missing > SOLVABILITY_TOLERANCE))
            raise ContradictionError(
                f"row {number} ({self.rows[number].name}) depends on the rows before it at t = {p.time:.8g} and "
                f"contradicts them: its right side is off by {missing[number]:.3g} of its terms. Remove one of them or "
                "change its rate; if they are independent elsewhere, stop before this time (an event)",
                rows=[number],
            )
        if np.all(np.isfinite(z)) and np.all(np.isfinite(drift)):
            return z
        here = [("rate", "rates", self.model.rates(p)), ("source", "sources", self.model.sources(p))]
        here += [
            (f"row {k} ({r.name}) at the place", "rows", a + b)
            for k, (r, a, b) in enumerate(zip(self.rows, rows, right, strict=True))
        ]
        for what, item, values in here:
            if values is not None and not np.all(np.isfinite(values)):
                species, t = int(np.argmin(np.isfinite(values))), f"t = {p.time:.8g}"
                remedy = "end the run before (an event), or mend the function"
                raise NonFiniteError(f"{what} of species {species} is not finite at {t}; {remedy}", item=item)
        return z

    def logarithmic_velocity(self, p: Populations) -> FloatArray:
        """d ln x/dt = phi + z + Psi/x, shape (n,); what `solve` integrates. NaN where x is beyond all numbers."""
        if not np.all(np.isfinite(p.x)):
            return np.full(self.model.n, np.nan)
        phi, psi = self.model.rates(p), self.model.sources(p)
        with np.errstate(all="ignore"):
            slope = phi + self.held(p, p.x * phi if psi is None else p.x * phi + psi)
            if psi is not None:
                slope = slope + psi * np.exp(-p.log_x)
            return np.where(slope < 0, slope * np.maximum(1.0 - p.log_x / LEAST_LOGARITHM, 0.0), slope)

    def velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """dx/dt (notes eq. 133), shape (n,)."""
        p = self._at(t, x)
        drift = self.model.drift(p)
        return drift + p.x * self.held(p, drift)

    def constraint_rates(self, t: float, x: ArrayLike) -> FloatArray:
        """z, shape (n,) (notes eqs. 137, 139)."""
        p = self._at(t, x)
        return self.held(p, self.model.drift(p))

    # -- the formulas of the notes, literally and densely ---------------------------------------------

    def multipliers(self, t: float, x: ArrayLike) -> FloatArray:
        """lambda with z = A^T lambda, shape (m,) (notes eq. 138); of least norm where rows depend."""
        A, _ = self.rows_and_rates(t, x)
        return np.asarray(projection.pseudo_inverse(A.T).matrix @ self.constraint_rates(t, x))

    def rows_and_rates(self, t: float, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A, shape (m, n), and b, shape (m,) (notes eqs. 128-130); the row of an `EntropyRow` is mu."""
        p = self._at(t, x)
        rows = [r.mixture.potentials(p) if isinstance(r, EntropyRow) else r.gradient(p) for r in self.rows]
        return np.array(rows).reshape(-1, self.model.n), np.array([row.rate(p) for row in self.rows])

    def constrained_inverse(self, t: float, x: ArrayLike) -> FloatArray:
        """G_perp+ = A^T (A G A^T)^-1 A = (P_perp G P_perp)+, shape (n, n) (notes eqs. 140, 141)."""
        A, _ = self.rows_and_rates(t, x)
        # (A G A^T)+ = (C+)^T C+ with C = A G^1/2.
        C_plus = projection.pseudo_inverse(A * np.sqrt(self._at(t, x).x)).matrix
        return np.asarray(A.T @ (C_plus.T @ (C_plus @ A)))

    def least_rate(self, t: float, x: ArrayLike) -> FloatArray:
        """h = A+ b - Psi - G phi, shape (n,), so that z = G_perp+ h (notes eqs. 134, 139)."""
        return self.perpendicular_velocity(t, x) - self.model.drift(self._at(t, x))

    def perpendicular_velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """A+ b, the part of dx/dt that the rows fix by themselves, shape (n,) (notes eqs. 131, 132)."""
        A, b = self.rows_and_rates(t, x)
        return np.asarray(projection.pseudo_inverse(A).matrix @ b)

    def _at(self, t: float, x: ArrayLike) -> Populations:
        p = Populations.from_values(t, x)
        if p.x.shape != (self.model.n,):
            raise InputError(f"populations have shape ({self.model.n},), not {p.x.shape}", item="x")
        return p

    # -- the holonomic rows as conditions on the state ------------------------------------------------

    def residuals(self, p: Populations) -> FloatArray:
        """sigma - sigma0 of the holonomic rows, shape (m_h,)."""
        return np.array([row.value(p) for row in self.rows if row.holonomic])

    def project(self, time: float, log_x: FloatArray) -> FloatArray:
        """The state on the holonomic rows, ln x + A^T mu with the least mu; shape (n,).

        Newton's iteration in the metric of the theory: x changes by G A^T mu, hence stays positive.
        """
        rows = [row for row in self.rows if row.holonomic]
        best, least = log_x, np.inf if rows else 0.0
        p = Populations.from_logarithms(time, log_x)
        for iteration in range(MOST_ITERATIONS + 1):
            with np.errstate(all="ignore"):
                values = [row.value(p) for row in rows]
                off = [abs(v) / (EPSILON * max(r.size(p), TINY)) for v, r in zip(values, rows, strict=True)]
                if rows and max(off) < least:
                    best, least = p.log_x, max(off)
                if least <= (1.0 if iteration < STALLED else ACCEPTED):
                    return best
                change, _ = constraint_rates(p.x, [r.gradient(p) for r in rows], [-v for v in values], 0 * p.x)
                # Populations change by no more than a factor e at once: Newton's steps are for small corrections.
                change = change / max(float(np.max(np.abs(change) * (p.x > 0))), 1.0)
            p = Populations.from_logarithms(time, p.log_x + np.where(np.isfinite(change), change, 0.0))
        raise ConvergenceError(
            f"the state at t = {time:.8g} cannot be projected on its rows ({', '.join(r.name for r in rows)}): "
            f"what is left is {least:.3g} times their round-off. "
            "Ask for a smaller rtol, or check that the rows have a solution",
            residual=least * EPSILON,
            tolerance=ACCEPTED * EPSILON,
            iterations=MOST_ITERATIONS,
        )


# -- trajectories ------------------------------------------------------------------------------------


def solve(
    system: ConstrainedGrowth,
    t_span: Sequence[float],
    x0: ArrayLike,
    method: str = "DOP853",
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    events: Event | Sequence[Event] | None = None,
    **options: Any,
) -> OptimizeResult:
    """Integrate a constrained growth model; arguments as in SciPy's ``solve_ivp``.

    Parameters
    ----------
    system : ConstrainedGrowth
    t_span : pair of float
    x0 : array_like, shape (n,)
        Start, on the constraints.
    method, t_eval, dense_output, events
        As in ``solve_ivp``, but LSODA; events are functions (t, x), with attributes `terminal` and `direction`.
    options
        rtol (by default 1e-9) and atol (1e-11) of ln x, so that atol is a relative error of x; max_step, first_step,
        jac and what else the method takes.

    Returns
    -------
    OptimizeResult
        All that ``solve_ivp`` returns: y, shape (n, k), and sol are x, 0 below the smallest number of the machine. And
        log_y and log_sol, ln x, always finite; system, with the targets that the start gave (a hypercycle knows its
        `settled_time`). Values between steps are on the constraints as well.

    Raises
    ------
    ConstraintError, BudgetError
        A start off the constraints, or a prescription that cannot be met from it.
    ContradictionError
        Rows that contradict each other, at the start or where their rank is lost on the way.
    NonFiniteError
        Rates, sources or rows that are not finite where the run has come to.
    """
    options = {"rtol": 1e-9, "atol": 1e-11} | {name: value for name, value in options.items() if value is not None}
    solver, span, times = check_run(t_span, t_eval, method, options, system.model.n)
    rtol, atol = (as_float_array(options[name], name) for name in ("rtol", "atol"))
    p0 = Populations.from_values(span[0], x0)
    bound, end = system.bind(p0), p0
    bound.tolerance, bound.settled_time = max(float(np.min(rtol + atol)), 1e-13), math.inf

    def slope(t: float, y: FloatArray) -> FloatArray:
        return bound.logarithmic_velocity(Populations.from_logarithms(t, y))

    def placed(t: float, y: FloatArray) -> FloatArray:
        nonlocal end
        y = bound.project(t, y)
        if abs(t - span[0]) >= abs(end.time - span[0]):
            end = Populations.from_logarithms(t, y)
        return y

    wrapped = None if events is None else [_of_logarithms(event) for event in np.atleast_1d(np.asarray(events, object))]
    options |= {"t_eval": times, "dense_output": dense_output, "events": wrapped}
    with np.errstate(all="ignore"):  # ln x may be -1e300, and trial steps go too far
        found = integrate(slope, span, placed(span[0], p0.log_x), solver, placed, **options)
        for row in bound.rows:  # derivatives of what depends on time may be wrong later only
            row.check_derivatives(end)
        found.t, log_sol = np.asarray(found.t), found.sol
        # A list where the run ended before the first time wanted.
        found.log_y = np.reshape(found.y, (system.model.n, -1))
        found.y = np.exp(found.log_y)
        found.y_events = None if found.y_events is None else [np.exp(y) for y in found.y_events]
    found.log_sol, found.sol = log_sol, None if log_sol is None else lambda t: np.exp(log_sol(t))
    return OptimizeResult(found, system=bound)


def _of_logarithms(event: Event) -> Event:
    """An event as a function of ln x, with its attributes."""
    check_call("event", event, ("t", "x"))
    return wraps(event)(lambda t, y: float(called("event", event, (), t, np.exp(y))))


def entropy_balance(solution: OptimizeResult) -> tuple[float, float]:
    """The entropy, times T, produced during a run by what the model does by itself, and by the constraints (eq. 145).

    These are the integrals of -sum mu (Psi + G phi) and of -sum mu G z along the solution. In an open system (eq. 150)
    they are the entropy produced inside and the one exchanged with the outside; in a closed one (eq. 149) nothing is
    exchanged, and their sum is produced inside: g(x_0) - g(x(t)).

    Parameters
    ----------
    solution : OptimizeResult
        Of `solve`, for a system with an `EntropyRow`, with dense_output=True.
    """
    system = solution.system
    row = system.entropy_row
    if row is None:
        raise InputError("the system of this solution has no row of entropy production", item="solution")
    if solution.sol is None:
        raise InputError(
            "the integral needs the solution between its times: solve(..., dense_output=True)", item="solution"
        )

    def production(t: float) -> FloatArray:
        """-sum mu dx/dt in all, and without the constraints."""
        p = Populations.from_logarithms(t, solution.log_sol(t))
        changes = np.array([p.x * system.logarithmic_velocity(p), system.model.drift(p)])
        return np.asarray(-changes @ row.mixture.potentials(p))

    t0, *between, t1 = solution.log_sol.ts.tolist()
    whole, reactions = quad_vec(production, t0, t1, epsabs=1e-10, epsrel=1e-9, points=between)[0].tolist()
    return reactions, whole - reactions


# -- hypercycles -------------------------------------------------------------------------------------


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
        if len(self.mixture.mu0) != n:
            raise InputError(f"{len(self.mixture.mu0)} standard potentials for {n} species", item="mu0")

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
        eta0, eta1 = np.sum(reactions), b2 - np.sum(reactions * mu)
        return np.asarray(((M0 * eta1 + eta0 * M1) * mu - (eta1 * M1 + eta0 * M2)) / (M0 * M2 - M1 * M1))


class ConstrainedHypercycle(ConstrainedGrowth):
    """A hypercycle with a fixed sum of populations and, perhaps, a law of entropy production."""

    model: Hypercycle

    def logarithmic_velocity(self, p: Populations) -> FloatArray:
        row = self.entropy_row
        if row is None or p.time < self.settled_time:
            return super().logarithmic_velocity(p)
        return (self.model.mixture.equilibrium(row.total) - p.log_x) * (0.5 / row.tau)

    def project(self, time: float, log_x: FloatArray) -> FloatArray:
        """The state on the rows; from `settled_time` on, which it sets, on the slow motion.

        d(ln x)/dt = phi + lambda_1 + lambda_2 mu. Close to x_eq, u = ln(x/x_eq) shrinks at the rate of the law,
        du/dt = -rho u, and mu is kT u but for a constant, so that u = s (phi(x) + lambda_1): its two unknowns come from
        the two rows, and x by iteration. The terms left out are of the order of rho r^3/|phi|, r the size of u.
        """
        row, settled = self.entropy_row, time >= self.settled_time
        y = log_x if settled else super().project(time, log_x)
        if row is None or math.isnan(row.total):
            return y
        log_eq, rho = self.model.mixture.equilibrium(row.total), 0.5 / row.tau
        weights = np.exp(log_eq) / row.total
        small = math.sqrt(2.0 * max(row.law_excess(time), 0.0) / (self.model.mixture.kT * row.total))

        def push(y: FloatArray) -> tuple[FloatArray, float]:
            """phi less its mean, and the size of it."""
            phi = self.model.rates(Populations.from_logarithms(time, y))
            phi = phi - weights @ phi
            return phi, math.sqrt(weights @ phi**2)

        slow, length = log_eq, push(log_eq)[1]
        near = small < NEARNESS and (self.model.k_h * row.total + rho) * small < SLOWNESS * length
        if not settled and not (near and rho * small**3 < self.tolerance * length):
            return y
        for _ in range(60 if small > 1e-15 else 0):
            phi, length = push(slow)
            before, slow = slow, super().project(time, log_eq + small / length * phi)
            if np.max(np.abs(slow - before) - 4e-16 * np.abs(slow)) <= 0:
                break
        if not settled and np.max(np.abs(slow - y)) >= STRAYING * self.tolerance:
            return y
        self.settled_time = min(time, self.settled_time)
        return slow
