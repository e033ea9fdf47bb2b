"""Growth under constraints (notes section 4.3.1).

    dx/dt = Psi + G (phi + z),   A dx/dt = b,   z = A^T lambda,   (A G A^T) lambda = b - A(Psi + G phi)

(eqs. 124-141). z acts as an additional relative rate, so that positivity is untouched: with Psi = 0,
d ln x/dt = phi + z.

The rows are made orthogonal in the scalar product <a, a'> = sum_i x_i a_i a'_i, one after another (Gram-Schmidt, each
row twice). This is a QR factorization of (A G^1/2)^T: it never forms A G A^T, whose condition number is the square.
For the rows 1 and mu it amounts to the centered moment sum x (mu - M1)^2 = M2 - M1^2, computed without cancellation.

References
----------
Horvath & Kneller, J. Chem. Phys. 131, 171101 (2009). Bott & Duffin, Trans. AMS 74, 99 (1953).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Self

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import projection
from kcons.constraints.arguments import FloatArray, refuse_other
from kcons.errors import (
    ConstraintError,
    ContradictionError,
    ConvergenceError,
    InputError,
    NonFiniteError,
    SingularGeometryError,
)
from kcons.models.growth.model import GrowthModel, Populations
from kcons.models.growth.rows import Row

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


class Rates(NamedTuple):
    """z and how it was found, for m rows and n species."""

    z: FloatArray
    #: z = A^T multipliers; 0 for a dependent row.
    multipliers: FloatArray
    dependent: NDArray[np.bool_]
    #: For dependent rows what is missing in its right side, in parts of the terms that it is made of.
    contradiction: FloatArray


def constraint_rates(x: FloatArray, rows: Sequence[FloatArray], right: Sequence[float], drift: FloatArray) -> Rates:
    """z with A (drift + G z) = right, drift = Psi + G phi; z lies in the space of the rows (notes eqs. 137, 138)."""
    m = len(rows)
    units, triangle = np.zeros((m, len(x))), np.eye(m)
    asked, along, contradiction = np.zeros(m), np.zeros(m), np.zeros(m)
    dependent = np.zeros(m, dtype=bool)
    for k in range(m):
        q, mixing = rows[k], np.zeros(k)
        for _ in range(2 if k else 0):
            part = units[:k] @ (x * q)
            q, mixing = q - part @ units[:k], mixing + part
        triangle[:k, k] = mixing
        b = right[k] - mixing @ asked[:k]
        missing, squared = b - q @ drift, float((x * q) @ q)
        if not np.isfinite(squared):  # a coefficient is not finite; nor is z
            along[k] = np.nan
        elif squared > LOST**2 * float((x * rows[k]) @ rows[k]):
            length = triangle[k, k] = np.sqrt(squared)
            units[k], asked[k], along[k] = q / length, b / length, missing / length
        else:
            dependent[k] = True
            contradiction[k] = abs(missing) / (float(np.abs(rows[k] * drift).sum()) + abs(right[k]) or 1.0)
    multipliers = scipy.linalg.solve_triangular(triangle, along, check_finite=False) if m else along
    return Rates(along @ units, multipliers, dependent, contradiction)


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
        If there are more rows than species.

    Examples
    --------
    >>> from kcons.models.growth import ConstrainedGrowth, GrowthModel, TotalPopulation
    >>> model = GrowthModel(lambda t, x: [1.0, 2.0], n=2)
    >>> system = ConstrainedGrowth(model, [TotalPopulation(2)])
    >>> system.velocity(0.0, [0.5, 0.5]).tolist()
    [-0.25, 0.25]
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

    @property
    def n(self) -> int:
        return self.model.n

    def bind(self, p: Populations) -> Self:
        """The same system with all targets set by the start `p`; refused if that is off a row, or rows contradict."""
        if p.x.shape != (self.n,):
            raise InputError(f"the start has populations of shape {p.x.shape}, the model {self.n}", item="x0")
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
        bad = bound.model.not_finite(p)
        if bad is not None:
            raise InputError(f"the {bad[0]} of species {bad[1]} at the start is not finite", item="rates")
        bound.held(p)
        return bound

    # -- the constrained equation of motion ----------------------------------------------------------

    def held(self, p: Populations, drift: FloatArray | None = None) -> Rates:
        """z; refused where the rank is lost and the rows contradict each other, or a row is not finite."""
        found = self._rates(p, self.model.drift(p) if drift is None else drift)
        if np.any(found.contradiction > SOLVABILITY_TOLERANCE):
            self._refuse(found, p)
        for number, row in enumerate(() if np.all(np.isfinite(found.z)) else self.rows):
            if not (np.all(np.isfinite(row.gradient(p))) and np.isfinite(row.rate(p))):
                raise NonFiniteError(
                    f"row {number} ({row.name}) has a coefficient or a rate that is not finite at t = {p.time:.8g}; "
                    "mend its functions, or end the run before (an event)",
                    item="rows",
                )
        return found

    def _rates(self, p: Populations, drift: FloatArray) -> Rates:
        """z, which may not be finite, of rows that may contradict each other."""
        with np.errstate(all="ignore"):
            return constraint_rates(p.x, [r.gradient(p) for r in self.rows], [r.rate(p) for r in self.rows], drift)

    def _refuse(self, found: Rates, p: Populations) -> None:
        """Raise where the rank is lost and the rows ask for the impossible."""
        row = int(np.argmax(found.contradiction > SOLVABILITY_TOLERANCE))
        message = (
            f"row {row} ({self.rows[row].name}) depends on the rows before it at t = {p.time:.8g} and contradicts "
            f"them: its right side is off by {found.contradiction[row]:.3g} of its terms"
        )
        # The same rows at a state some way off: dependent everywhere, or only here?
        shift = 0.1 * np.cos(np.arange(1.0, self.n + 1))
        away = Populations.from_logarithms(p.time, np.maximum(p.log_x, -30.0) + shift)
        if projection.rank(np.array([r.gradient(away) for r in self.rows])) < len(self.rows):
            raise ContradictionError(message + "; remove one of the rows or change its rate", rows=[row])
        raise SingularGeometryError(
            message + "; the rows are independent elsewhere: stop before this time (an event), or prescribe a rate "
            "that fades as the rank does",
            rows=[row],
        )

    def logarithmic_velocity(self, p: Populations) -> FloatArray:
        """d ln x/dt = phi + z + Psi/x, shape (n,); what `solve` integrates. NaN where rows contradict each other."""
        phi, psi = self.model.rates(p), self.model.sources(p)
        with np.errstate(all="ignore"):
            drift = p.x * phi if psi is None else p.x * phi + psi
            found = self._rates(p, drift)
            slope = phi + np.where(np.any(found.contradiction > SOLVABILITY_TOLERANCE), np.nan, found.z)
            if psi is not None:
                slope = slope + psi * np.exp(-p.log_x)
            return np.where(slope < 0, slope * np.maximum(1.0 - p.log_x / LEAST_LOGARITHM, 0.0), slope)

    def velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """dx/dt (notes eq. 133), shape (n,)."""
        p = self._at(t, x)
        drift = self.model.drift(p)
        return drift + p.x * self.held(p, drift).z

    def constraint_rates(self, t: float, x: ArrayLike) -> FloatArray:
        """z, shape (n,) (notes eqs. 137, 139)."""
        return self.held(self._at(t, x)).z

    def multipliers(self, t: float, x: ArrayLike) -> FloatArray:
        """lambda with z = A^T lambda, shape (m,) (notes eq. 138); of least norm where rows depend."""
        found = self.held(self._at(t, x))
        if not np.any(found.dependent):
            return found.multipliers
        return np.asarray(projection.pseudo_inverse(self.rows_and_rates(t, x)[0].T).matrix @ found.z)

    # -- the formulas of the notes, literally and densely ---------------------------------------------

    def rows_and_rates(self, t: float, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A, shape (m, n), and b, shape (m,) (notes eqs. 128-130)."""
        p = self._at(t, x)
        A = np.array([row.gradient(p) for row in self.rows]).reshape(-1, self.n)
        return A, np.array([row.rate(p) for row in self.rows])

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
        if p.x.shape != (self.n,):
            raise InputError(f"populations have shape ({self.n},), not {p.x.shape}", item="x")
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
        best, least = log_x, np.inf
        p = Populations.from_logarithms(time, log_x)
        for iteration in range(MOST_ITERATIONS + 1 if rows else 0):
            with np.errstate(all="ignore"):
                values = [row.value(p) for row in rows]
                left = max(abs(v) / (EPSILON * max(r.size(p), TINY)) for v, r in zip(values, rows, strict=True))
                if left < least:
                    best, least = p.log_x, left
                if least <= (1.0 if iteration < STALLED else ACCEPTED):
                    return best
                change = constraint_rates(p.x, [r.gradient(p) for r in rows], [-v for v in values], 0 * p.x).z
                # Populations change by no more than a factor e at once: Newton's steps are for small corrections.
                change = change / max(float(np.max(np.abs(change) * (p.x > 0))), 1.0)
            p = Populations.from_logarithms(time, p.log_x + np.where(np.isfinite(change), change, 0.0))
        if rows and not least <= ACCEPTED:
            raise ConvergenceError(
                f"the state at t = {time:.8g} cannot be projected on its rows ({', '.join(r.name for r in rows)}): "
                f"what is left is {least:.3g} times their round-off. "
                "Ask for a smaller rtol, or check that the rows have a solution",
                residual=least * EPSILON,
                tolerance=ACCEPTED * EPSILON,
                iterations=MOST_ITERATIONS,
            )
        return best

    # -- what systems of some kinds know about their motion -------------------------------------------

    def past_instant(self, time: float, log_x: FloatArray) -> FloatArray:
        """The state beyond what happens in less time than numbers can tell; the same state where nothing does."""
        return log_x

    def settled(self, time: float, log_x: FloatArray, tolerance: float) -> Callable[[float], FloatArray] | None:
        """How the motion goes on without integration, once nothing but the rows decides about it; None before.

        Returns ln x, shape (n,), as a function of time.
        """
        return None
