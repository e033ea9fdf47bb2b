"""Growth under constraints (notes section 4.3.1).

    dx/dt = Psi + G (phi + z),   A dx/dt = b,   z = A^T lambda,   (A G A^T) lambda = b - A(Psi + G phi)

(eqs. 124-141). z acts as an additional relative rate, so that positivity is untouched: with Psi = 0,
d ln x/dt = phi + z.

References
----------
Horvath & Kneller, J. Chem. Phys. 131, 171101 (2009). Bott & Duffin, Trans. AMS 74, 99 (1953).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import projection
from kcons.constraints.arguments import refuse_other
from kcons.errors import (
    ConstraintError,
    ContradictionError,
    ConvergenceError,
    InputError,
    NonFiniteError,
    SingularGeometryError,
)
from kcons.models.growth import orthogonal_rows
from kcons.models.growth.model import FloatArray, GrowthModel, Populations
from kcons.models.growth.rows import EPSILON, Row

#: Newton iterations of a projection at most.
MOST_ITERATIONS = 25
#: A projection has arrived where what is left is this many times the round-off of the row.
ROUND_OFF = 1.0
#: Systems that have arrived part from the others where they are more than this share of them.
WORTH_PARTING = 0.3
#: After this many iterations, so many times the round-off are accepted.
STALLED, ACCEPTED = 4, 50.0
#: Least ln x. Where the rows press on a species that is extinct, ln x falls like -e^(lambda t), beyond all numbers of
#: the machine in finite time; x and x ln x are 0 long before. A fall fades out here; a return starts from here.
LEAST_LOGARITHM = -1e300


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
        self.model = model
        self.rows = _rows_in(rows, model.n)

    @property
    def n(self) -> int:
        return self.model.n

    # -- the start ----------------------------------------------------------------------------------

    def bind(self, p: Populations) -> Self:
        """The same system with all targets set by the start `p`.

        Raises
        ------
        ConstraintError
            If the start is off a row whose target was given.
        ContradictionError
            If the rows contradict each other at the start.
        """
        if len(p.x) != self.n:
            raise InputError(f"the start has {len(p.x)} populations, the model {self.n}", item="x0")
        check_lanes(self, p.x.shape[1:])
        bound = copy.copy(self)
        bound.rows = tuple(row.bind(p) for row in self.rows)
        for number, row in enumerate(bound.rows):
            row.check(p, number)
        bad = bound.model.not_finite(p)
        if bad is not None:
            raise InputError(f"the {bad[0]} of species {bad[1]} at the start is not finite", item="rates")
        if p.x.ndim == 2:
            _refuse_mixed(bound, p)
        bound._held(p)
        return bound

    def take(self, lanes: NDArray[np.intp]) -> Self:
        """Some of N systems side by side."""
        taken = copy.copy(self)
        taken.model = self.model.take(lanes)
        taken.rows = tuple(row.take(lanes) for row in self.rows)
        return taken

    # -- the constrained equation of motion ----------------------------------------------------------

    def _solve(self, p: Populations, drift: FloatArray) -> orthogonal_rows.Solution:
        return orthogonal_rows.solve(
            p.x, [row.gradient(p) for row in self.rows], [row.rate(p) for row in self.rows], drift
        )

    def _held(self, p: Populations, drift: FloatArray | None = None) -> orthogonal_rows.Solution:
        """z where the rows allow one."""
        found = self._solve(p, self.model.drift(p) if drift is None else drift)
        _refuse_not_finite(found.z, self.rows, p)
        self._refuse(found, p)
        return found

    def _refuse(self, found: orthogonal_rows.Solution, p: Populations) -> None:
        """Raise where the rank is lost and the rows ask for the impossible."""
        off = found.contradiction > orthogonal_rows.SOLVABILITY_TOLERANCE
        if not np.any(off):
            return
        index = np.argwhere(off)[0]
        row = int(index[0])
        time = float(np.broadcast_to(p.time, p.x.shape[1:])[tuple(index[1:])])
        message = (
            f"row {row} ({self.rows[row].name}) depends on the rows before it at t = {time:.8g} and contradicts them: "
            f"its right side is off by {found.contradiction[tuple(index)]:.3g} of its terms"
        )
        # The same rows at a state some way off: dependent everywhere, or only here?
        lane = index[1:2]
        here = self.take(lane) if len(lane) else self
        log_x = p.log_x[:, lane] if len(lane) else p.log_x
        shift = 0.1 * np.cos(np.arange(1.0, self.n + 1)).reshape(-1, *(1,) * (log_x.ndim - 1))
        away = Populations.from_logarithms(
            np.full(len(lane), time) if len(lane) else time, np.maximum(log_x, -30.0) + shift
        )
        gradients = np.array([r.gradient(away).reshape(self.n) for r in here.rows])
        if projection.rank(gradients) < len(self.rows):
            raise ContradictionError(message + "; remove one of the rows or change its rate", rows=[row])
        raise SingularGeometryError(
            message
            + "; the rows are independent elsewhere: stop before this time (an event), or prescribe a rate that "
            "fades as the rank does",
            rows=[row],
        )

    def logarithmic_velocity(self, p: Populations) -> FloatArray:
        """d ln x/dt = phi + z + Psi/x, shape of p.x; what `solve` integrates. NaN of systems whose rows contradict.

        Raises
        ------
        ContradictionError, SingularGeometryError
            Where the rank is lost and the rows contradict each other, for a single system.
        """
        phi = self.model.rates(p)
        psi = self.model.sources(p)
        with np.errstate(all="ignore"):
            drift = p.x * phi if psi is None else p.x * phi + psi
            if not self.rows:
                slope = np.array(phi)
            else:
                found = self._solve(p, drift)
                if p.x.ndim == 1:
                    self._refuse(found, p)
                off = np.any(found.contradiction > orthogonal_rows.SOLVABILITY_TOLERANCE, axis=0)
                slope = np.where(off, np.nan, phi + found.z)
            if psi is not None:
                slope = slope + psi * np.exp(-p.log_x)
            fallen = (p.log_x < 1e-17 * LEAST_LOGARITHM) & (slope < 0)
            if fallen.any():
                slope[fallen] *= np.maximum(1.0 - p.log_x[fallen] / LEAST_LOGARITHM, 0.0)
        return slope

    def velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """dx/dt (notes eq. 133), shape of x."""
        p = Populations.from_values(t, x)
        drift = self.model.drift(p)
        return drift + p.x * self._held(p, drift).z

    def constraint_rates(self, t: float, x: ArrayLike) -> FloatArray:
        """z, shape of x (notes eqs. 137, 139)."""
        p = Populations.from_values(t, x)
        return self._held(p).z

    def multipliers(self, t: float, x: ArrayLike) -> FloatArray:
        """lambda with z = A^T lambda, shape (m,) or (m, N) (notes eq. 138); of least norm where rows depend."""
        p = Populations.from_values(t, x)
        found = self._held(p)
        if p.x.ndim == 1 and np.any(found.dependent):
            A = np.array([row.gradient(p) for row in self.rows])
            return np.asarray(projection.pseudo_inverse(A.T).matrix @ found.z)
        return found.multipliers

    # -- the formulas of the notes, literally and densely, for one system ----------------------------

    def rows_and_rates(self, t: float, x: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A, shape (m, n), and b, shape (m,) (notes eqs. 128-130)."""
        p = self._one(t, x)
        A = np.array([row.gradient(p) for row in self.rows]).reshape(-1, self.n)
        return A, np.array([float(row.rate(p)) for row in self.rows])

    def constrained_inverse(self, t: float, x: ArrayLike) -> FloatArray:
        """G_perp+ = A^T (A G A^T)^-1 A = (P_perp G P_perp)+, shape (n, n) (notes eqs. 140, 141)."""
        p = self._one(t, x)
        A, _ = self.rows_and_rates(t, x)
        root = np.sqrt(p.x)
        # (A G A^T)+ = (C+)^T C+ with C = A G^1/2.
        C_plus = projection.pseudo_inverse(A * root).matrix
        return np.asarray(A.T @ (C_plus.T @ (C_plus @ A)))

    def least_rate(self, t: float, x: ArrayLike) -> FloatArray:
        """h = A+ b - Psi - G phi, shape (n,), so that z = G_perp+ h (notes eqs. 134, 139)."""
        p = self._one(t, x)
        A, b = self.rows_and_rates(t, x)
        return np.asarray(projection.pseudo_inverse(A).matrix @ b - self.model.drift(p))

    def perpendicular_velocity(self, t: float, x: ArrayLike) -> FloatArray:
        """A+ b, the part of dx/dt that the rows fix by themselves, shape (n,) (notes eqs. 131, 132)."""
        A, b = self.rows_and_rates(t, x)
        return np.asarray(projection.pseudo_inverse(A).matrix @ b)

    def _one(self, t: float, x: ArrayLike) -> Populations:
        p = Populations.from_values(t, x)
        if p.x.shape != (self.n,):
            raise InputError(f"this formula is for one system, shape ({self.n},), not {p.x.shape}", item="x")
        return p

    # -- the holonomic rows as conditions on the state ------------------------------------------------

    def residuals(self, p: Populations) -> FloatArray:
        """sigma - sigma0 of the holonomic rows, shape (m_h,) or (m_h, N)."""
        values = [np.broadcast_to(row.value(p), p.x.shape[1:]) for row in self.rows if row.holonomic]
        return np.array(values).reshape(len(values), *p.x.shape[1:])

    def project(self, time: float | FloatArray, log_x: FloatArray) -> FloatArray:
        """The state on the holonomic rows, ln x + A^T mu with the least mu; shape of log_x.

        Newton's iteration in the metric of the theory: x changes by G A^T mu, hence stays positive.

        Raises
        ------
        ConvergenceError
            If the rows cannot be met to round-off from here, for a single system.
        """
        projected, left = self.try_project(time, log_x)
        if np.ndim(left) == 0 and not left <= ACCEPTED:
            names = ", ".join(row.name for row in self.rows if row.holonomic)
            raise ConvergenceError(
                f"the state at t = {float(np.max(time)):.8g} cannot be projected on its rows ({names}): "
                f"what is left is {left:.3g} times their round-off. "
                "Ask for a smaller rtol, or check that the rows have a solution",
                residual=float(left) * EPSILON,
                tolerance=ACCEPTED * EPSILON,
                iterations=MOST_ITERATIONS,
            )
        return projected

    def try_project(self, time: float | FloatArray, log_x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`project` without raising: the state, and what is left in units of the round-off of the rows."""
        rows = [row for row in self.rows if row.holonomic]
        lanes = log_x.shape[1:]
        if not rows:
            return log_x, np.zeros(lanes)
        best = np.array(log_x)
        p = Populations.from_logarithms(time, best)
        values, best_left = _misses(rows, p, lanes)
        if not lanes:
            return self._iterate(p, values, best, best_left)
        # Most are there at once, or after one step: the others go on by themselves.
        open_ = np.flatnonzero(~(best_left <= ROUND_OFF))
        if len(open_):
            part = self.take(open_)
            times = np.broadcast_to(np.asarray(time, dtype=np.float64), lanes)[open_]
            p = Populations.from_logarithms(times, best[:, open_])
            found, left = part._iterate(p, [np.asarray(v)[open_] for v in values], best[:, open_], best_left[open_])
            best[:, open_], best_left[open_] = found, left
        return best, best_left

    def _iterate(
        self, p: Populations, values: list[FloatArray], best: FloatArray, best_left: FloatArray, iteration: int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Newton's iteration from `p` with the row values `values`; the best state on the way and what is left."""
        rows = [row for row in self.rows if row.holonomic]
        lanes = best.shape[1:]
        while iteration < MOST_ITERATIONS:
            change = orthogonal_rows.solve(
                p.x, [r.gradient(p) for r in rows], [-v for v in values], np.zeros_like(p.x)
            ).z
            # Populations change by no more than a factor e at once: Newton's steps are for small corrections.
            with np.errstate(all="ignore"):
                largest = np.max(np.abs(change) * (p.x > 0), axis=0)
                change = np.where(np.isfinite(change), change / np.maximum(largest, 1.0), 0.0)
            p = Populations.from_logarithms(p.time, p.log_x + change)
            values, left = _misses(rows, p, lanes)
            better = left < best_left
            best = np.where(better, p.log_x, best)
            best_left = np.where(better, left, best_left)
            there = best_left <= (ROUND_OFF if iteration < STALLED else ACCEPTED)
            iteration += 1
            if np.all(there):
                break
            if np.count_nonzero(there) > WORTH_PARTING * there.size:
                late = np.flatnonzero(~there)
                p = Populations(np.asarray(p.time)[late], p.x[:, late], p.log_x[:, late])
                best[:, late], best_left[late] = self.take(late)._iterate(
                    p, [v[late] for v in values], best[:, late], best_left[late], iteration
                )
                break
        return best, best_left

    def past_instants(self, time: float | FloatArray, log_x: FloatArray) -> FloatArray:
        """The state beyond what happens in less time than numbers can tell; the same state where nothing does."""
        return log_x

    def settled(self, time: float, log_x: FloatArray, tolerance: float) -> Callable[[FloatArray], FloatArray] | None:
        """How the motion goes on without integration, once nothing but the rows decides about it; None before.

        Returns a function of times, shape (k,), to ln x, shape (n, k).
        """
        return None

    def settled_lanes(self, time: FloatArray, log_x: FloatArray, tolerance: float) -> NDArray[np.bool_]:
        """Which of N systems have settled, see `settled`; those then go on as `slow_state` says."""
        return np.zeros(log_x.shape[1:], dtype=bool)

    def arrived_lanes(self, time: FloatArray, log_x: FloatArray) -> NDArray[np.bool_]:
        """Which of N systems are at rest but for what is beyond round-off; those go on as `rest_state` says."""
        return np.zeros(log_x.shape[1:], dtype=bool)

    def rest_state(self, time: FloatArray, log_x: FloatArray, later: FloatArray) -> FloatArray:
        """ln x, shape (n, N), at times `later`, shape (N,), of systems that have arrived in log_x at `time`."""
        raise NotImplementedError("a system that does not come to rest")

    def slow_state(self, time: ArrayLike, accuracy: float = 0.0) -> FloatArray:
        """ln x of a settled system, shape (n, k), at times of shape (k,)."""
        raise NotImplementedError("a system without a slow motion of its own")


def _misses(rows: Sequence[Row], p: Populations, lanes: tuple[int, ...]) -> tuple[list[FloatArray], FloatArray]:
    """Values of the rows, and the largest of them in units of their round-off."""
    values = [np.broadcast_to(row.value(p), lanes) for row in rows]
    with np.errstate(all="ignore"):
        sizes = [np.maximum(row.size(p), np.finfo(np.float64).tiny) for row in rows]
        left = np.max([np.abs(v) / (EPSILON * s) for v, s in zip(values, sizes, strict=True)], axis=0)
    return values, np.where(np.isfinite(left), left, np.inf)


def check_lanes(system: ConstrainedGrowth, lanes: tuple[int, ...]) -> None:
    """Refuse parameters that are for another number of systems than there are, () for a single one.

    Raises
    ------
    InputError
    """
    found = [(system.model.lanes, "the model"), *((row.lanes, f"row {row.name}") for row in system.rows)]
    for own, name in found:
        if own not in ((), lanes):
            raise InputError(
                f"parameters of {name} are for {own[0]} systems side by side, "
                f"the start is {f'of {lanes[0]}' if lanes else 'a single one'}: give one number for all, or as "
                "many as there are starts in solve_ensemble",
                item="x0",
            )


def _refuse_mixed(system: ConstrainedGrowth, p: Populations) -> None:
    """Refuse vectorized functions that give another result for the last of N systems when it is alone."""
    last = np.array([p.x.shape[1] - 1])
    alone, q = system.take(last), Populations(np.asarray(p.time)[last], p.x[:, last], p.log_x[:, last])
    pairs = [("the rates", system.model.rates(p), alone.model.rates(q))]
    if system.model.sources(p) is not None:
        pairs.append(("the sources", np.asarray(system.model.sources(p)), np.asarray(alone.model.sources(q))))
    for row, own in zip(system.rows, alone.rows, strict=True):
        pairs.append((f"the coefficients of {row.name}", row.gradient(p), own.gradient(q)))
        for what, both in (("rate", (row.rate(p), own.rate(q))), ("value", _values(row, p, own, q))):
            whole, part = (np.broadcast_to(b, s.x.shape[1:]) for b, s in zip(both, (p, q), strict=True))
            pairs.append((f"the {what} of {row.name}", whole, part))
    for what, whole, part in pairs:
        size = np.max(np.abs(part), initial=np.finfo(np.float64).tiny)
        if np.any(np.abs(whole[..., -1] - part[..., 0]) > 1e-6 * size):
            raise InputError(
                f"{what}: of several systems side by side, the last has another value than alone. A vectorized "
                "function takes x of shape (n, N): sum over axis 0, and nothing over systems",
                item="vectorized",
            )


def _values(row: Row, p: Populations, own: Row, q: Populations) -> tuple[FloatArray | float, FloatArray | float]:
    """Of one row in two ways, plus 1 lest rounding at 0 be compared; the same number where it has none."""
    return (row.value(p) / row.size(p) + 1.0, own.value(q) / own.size(q) + 1.0) if row.holonomic else (1.0, 1.0)


def _rows_in(given: Sequence[Row] | Row, n: int) -> tuple[Row, ...]:
    """The rows for n species."""
    refuse_other(given, (Row, Iterable), "rows", "rows of kcons.models.growth, or an empty list")
    rows = (given,) if isinstance(given, Row) else tuple(given)
    for row in rows:
        refuse_other(row, Row, "rows", "rows of kcons.models.growth, such as TotalPopulation(n)")
    if len(rows) > n:
        raise ConstraintError(
            f"{len(rows)} rows for {n} species: give at most as many rows as there are species",
            rows=range(n, len(rows)),
        )
    return rows


def _refuse_not_finite(z: FloatArray, rows: Sequence[Row], p: Populations) -> None:
    """Raise where z is not finite, for the first row of which a number is not."""
    if np.all(np.isfinite(z)):
        return
    for number, row in enumerate(rows):
        if not (np.all(np.isfinite(row.gradient(p))) and np.all(np.isfinite(row.rate(p)))):
            raise NonFiniteError(
                f"row {number} ({row.name}) has a coefficient or a rate that is not finite at "
                f"t = {float(np.max(p.time)):.8g}; mend its functions, or end the run before (an event)",
                item="rows",
            )
