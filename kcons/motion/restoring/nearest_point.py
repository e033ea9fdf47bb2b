"""Positions that are far off, brought onto the constraints; for starts, not for time steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import ConvergenceError, KconsError
from kcons.motion.solver_sequence import FAILED, IterationBudget, SolverSequence
from kcons.solvers.tolerances import EPS, MAX_HALVINGS

#: Rounds of the search for the nearest point on the constraints, and steps towards any point on them.
NEAREST_ROUNDS = 200
#: Moves that get no smaller are rounding below so much of the size of the system, or of the distance from the origin.
_STILL, _ROUNDING = 1e-12, 16 * EPS
#: Of least squares: the damping that keeps free motions out, in parts of the largest square of a slope; how often a
#: step is damped more; and what is no step, in parts of the size of the system.
LEAST, TRIES, _REACHED = 1e-10, 12, 1e-10
#: Steps towards any point on the constraints are at first no longer than this part of what rows are off by: longer ones
#: end in more places from which there is no way on.
SHORT_STEPS = 0.2
#: Rounds of the fixed-point iteration in which moves do not halve, after which it is accelerated, from how many rounds.
SLOW, MIXED = 3, 5
#: Part of the way to the nearest point that may be left along the constraints without a word.
LEFT_OVER = 1e-6


class FarStart:
    """Search for a point on the constraints, with the projections of a `Motion` as its tools.

    Parameters
    ----------
    sequence : SolverSequence
    budget : IterationBudget
        What the search may cost. A point on the constraints is returned as it is when this is used up.
    time : float
    """

    def __init__(self, sequence: SolverSequence, budget: IterationBudget, time: float) -> None:
        self._sequence, self._budget, self._time = sequence, budget, time
        self._rows, self._plan, self._failures = sequence.rows, sequence.plan, sequence.failures

    def _positions(self, x: FloatArray, reference: FloatArray) -> None:
        """Project in place along the gradients at `reference`."""
        self._budget.iterations -= FAILED
        self._sequence.positions(x, reference, self._time, self._time, None, 0.0, None)
        self._budget.iterations += FAILED - max(self._sequence.iterations, default=0)

    def _tangents(self, x: FloatArray, y: FloatArray, rates: FloatArray | None = None) -> None:
        self._sequence.tangents(x, y, rates, self._time, None, "position")

    def restore(self, x: FloatArray) -> float:
        """Bring `x` onto the constraints in place, or raise `InfeasibleError`.

        Returns
        -------
        float
            The part of the way that leads along the constraints: 0 where the search has found the nearest point.
        """
        plan, fallback = self._plan, self._sequence.fallback
        if len(plan.pinned):
            x[plan.pinned] = plan.pinned_targets(self._rows.target(self._time) if self._rows.moving else None)
        fallback.budget = self._budget
        try:
            return self._search(x)
        finally:
            fallback.budget = None

    def _search(self, x: FloatArray) -> float:
        start = x.copy()
        here = x.copy()
        try:
            self._positions(here, start)
        except ConvergenceError:
            self._reach(here)
        found = self._settle(start, here) or self._descend(start, here)
        found = found or self._settle(start, here, slow=SLOW)
        np.copyto(x, here)
        if found:
            return 0.0
        along = start - x
        along[self._atom_labels() < 0] = 0.0
        size = float(np.max(np.abs(along), initial=0.0))
        self._tangents(x, along)
        return float(np.max(np.abs(along), initial=0.0)) / size if size > 0.0 else 0.0

    def _reach(self, x: FloatArray) -> None:
        """Some point on the constraints, for starts too far off for one projection, in place."""
        start, held, time = x.copy(), self._rows, self._time
        error = self._failures.not_finite(positions=start)
        if error is not None:
            raise error
        rows = np.flatnonzero((self._plan.labels >= 0) & held.holonomic)
        atoms = np.flatnonzero(self._atom_labels() >= 0)
        with np.errstate(all="ignore"):
            table = held.jacobian(start, time)[rows]
            # By how far an atom is off: what rows measure has units of its own.
            slopes = np.maximum.reduceat(np.linalg.norm(table.data.reshape(-1, 3), axis=1), table.indptr[:-1] // 3)
            weights = np.where(np.isfinite(slopes) & (slopes > 0), 1.0 / slopes, 1.0)

            def misses(y: FloatArray) -> FloatArray:
                return np.asarray(weights * held.value(y, time)[rows])

            far = float(np.abs(misses(start)).max(initial=0.0))
            for part in SHORT_STEPS, np.inf:
                np.copyto(x, start)
                # Any point does: masses of many orders of magnitude would only spoil the condition.
                steps = least_squares(
                    x,
                    atoms,
                    misses,
                    lambda y: sp.diags_array(weights) @ held.jacobian(y, time)[rows],
                    steps=NEAREST_ROUNDS,
                    still=_REACHED * extent(start),
                    longest=part * far,
                )
                if np.all(np.abs(misses(x)) <= 1e-6 * far):
                    break
            off = np.where(np.isfinite(slopes), np.abs(held.value(x, time) / held.scale)[rows], np.inf)
        try:
            self._positions(x, x.copy())
        except KconsError as failure:
            worst = int(np.argmax(np.nan_to_num(off, nan=np.inf)))
            raise self._failures.start(x, start, int(rows[worst]), float(off[worst]), steps, time) from failure

    def _settle(self, start: FloatArray, x: FloatArray, slow: int = 0) -> bool:
        """x <- start + M^-1 A(x)^T Lambda by fixed-point iteration with the fast solvers, in place.

        Its fixed point is the foot of the mass-weighted perpendicular from the start. False where the iteration
        does not settle, and `x` as it was, or as near as the work came that was left. `slow` rounds count as slow.
        """
        here = reached = x
        mixed: _Mixed | None = None
        last = np.inf
        still = max(_STILL * extent(start), _ROUNDING * float(np.abs(start).max(initial=0.0)))
        first = np.inf
        for _ in range(NEAREST_ROUNDS):
            if self._budget.iterations <= 0:
                break
            ahead = start.copy()
            try:
                self._positions(ahead, here)
            except ConvergenceError:
                return False
            move = float(np.max(np.abs(ahead - here), initial=0.0))
            if move == 0.0 or (move > 0.5 * last and move < still):
                np.copyto(x, ahead)
                return True
            if move > 2 * last:
                return False
            if last == np.inf:
                first = move
            slow += move > 0.5 * last
            if slow >= SLOW:
                mixed = mixed or _Mixed(self._atom_labels())
                # Gradients are taken there, which need not be on the constraints.
                here = mixed.after(here, ahead)
            else:
                here = ahead
            reached, last = ahead, move
        if last < first:  # on its way to the foot, and nearer than where it began
            np.copyto(x, reached)
        return False

    def _descend(self, start: FloatArray, x: FloatArray) -> bool:
        """Walk along the constraints towards the start in place, as long as every cluster comes nearer to it.

        Steps are the tangential part of start - x; its end is the foot of a perpendicular from the start. Whether it
        was reached.
        """
        plan = self._plan
        atom_label = self._atom_labels()
        inside = atom_label >= 0
        mass = np.divide(1.0, plan.inverse_masses, out=np.zeros(len(x)), where=plan.inverse_masses > 0)[inside]
        clusters = int(plan.labels.max(initial=-1)) + 1

        def distance(y: FloatArray) -> FloatArray:
            square = mass * np.sum((y - start)[inside] ** 2, axis=1)
            return np.bincount(atom_label[inside], weights=square, minlength=clusters).astype(np.float64)

        away = distance(x)
        factor, last = np.ones(clusters), np.inf
        for _ in range(NEAREST_ROUNDS):
            step = start - x
            step[~inside] = 0.0
            size = float(np.max(np.abs(step), initial=0.0))
            self._tangents(x, step)
            slope = float(np.max(np.abs(step), initial=0.0))
            near = slope < 1e-6 * size  # where rounding hides which of two points is nearer
            if slope <= 1e-13 * size:
                return True
            if near and slope > 0.9 * last:  # swings about the foot
                factor *= 0.5
                if factor.max() < 0.05:
                    return False
            last = slope
            for _ in range(MAX_HALVINGS):
                if self._budget.iterations <= 0:
                    return False
                ahead = x + np.where(inside, factor[atom_label], 0.0)[:, None] * step
                try:
                    self._positions(ahead, x)
                except ConvergenceError as error:
                    factor[error.cluster if error.cluster >= 0 else slice(None)] *= 0.5
                    continue
                now = distance(ahead)
                worse = now > away * (1 + 1e-12) if near else now > away
                if not worse.any():
                    break
                factor[worse] *= 0.5
            else:
                return False
            np.copyto(x, ahead)
            away = now
            if not near:
                factor = np.minimum(1.0, 1.5 * factor)
        return False

    def _atom_labels(self) -> IntArray:
        """Cluster of each local atom, -1 for atoms that belong to none."""
        incidence, labels = self._rows.incidence, self._plan.labels
        entry_label = np.repeat(labels, np.diff(incidence.indptr))
        atom_label = np.full(self._rows.n_atoms, -1, dtype=np.int64)
        atom_label[incidence.indices[entry_label >= 0]] = entry_label[entry_label >= 0]
        atom_label[self._plan.inverse_masses == 0] = -1
        return atom_label


def least_squares(
    x: FloatArray,
    atoms: IntArray,
    residuals: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], sp.csr_array],
    *,
    steps: int,
    still: float,
    longest: float = np.inf,
) -> int:
    """Move some atoms so that a sum of squares becomes least, in place (Levenberg and Marquardt).

    Parameters
    ----------
    x : ndarray, shape (n_atoms, 3)
    atoms : ndarray of int
        Those that may move.
    residuals, slopes : callable
        What is squared, and its sparse Jacobian, at given positions.
    steps : int
        The most steps.
    still, longest : float
        No coordinate changes by more than the second in a step, and steps that would are made whatever they gain; where
        none changes by more than the first, all is done.

    Returns
    -------
    int
        Steps made. Where a number is not finite, or nothing is gained any more, they end where they are.
    """
    from scipy.sparse.linalg import splu  # slow to import, rarely needed

    columns = (3 * atoms[:, None] + np.arange(3)).ravel()
    damping, off = 0.0, residuals(x)
    for step in range(steps):
        table = sp.csr_array(slopes(x))[:, columns]
        error = float(off @ off)
        if not (0.0 < error < np.inf and np.isfinite(table.data).all()):
            return step
        normal, gradient = table.T @ table, table.T @ off
        size = float(normal.diagonal().max(initial=0.0))
        for _ in range(TRIES):
            try:
                factor = splu(sp.csc_array(normal + (LEAST + damping) * size * sp.eye_array(len(columns))))
            except RuntimeError:  # exactly singular: sizes that differ by more than double precision
                return step
            move = -factor.solve(gradient)
            largest = float(np.abs(move).max(initial=0.0))
            trial = x.copy()
            trial.reshape(-1)[columns] += move * min(1.0, longest / largest if largest > 0 else 1.0)
            found = residuals(trial)
            if largest > longest or float(found @ found) < error:
                break
            damping = max(4 * damping, 1e-3)
        else:
            return step
        x[...], off = trial, found
        damping = 0.1 * damping if damping > 1e-7 else 0.0
        if not largest > still:
            return step + 1
    return steps


class _Mixed:
    """Anderson's mixing of the last rounds of a fixed-point iteration, cluster by cluster.

    The next point is that combination of the last ones whose changes cancel best. D. G. Anderson, J. ACM 12, 547
    (1965).

    Parameters
    ----------
    label : ndarray of int, shape (n_atoms,)
        Cluster of each atom, -1 for atoms that belong to none.
    """

    def __init__(self, label: IntArray) -> None:
        self._inside = np.flatnonzero(label >= 0)
        self._label = label[self._inside]
        self._points: list[FloatArray] = []
        self._changes: list[FloatArray] = []

    def after(self, here: FloatArray, ahead: FloatArray) -> FloatArray:
        """Where to go on after `here` led to `ahead`."""
        inside = self._inside
        self._points = [*self._points[-MIXED:], ahead[inside]]
        self._changes = [*self._changes[-MIXED:], (ahead - here)[inside]]
        change, changes = self._changes[-1], np.diff(self._changes, axis=0)
        if not len(changes):
            return ahead
        products = np.array([[self._sums(a, b) for b in changes] for a in changes])
        with np.errstate(divide="ignore"):
            size = 1.0 / np.sqrt(np.einsum("aac->ac", products))
        size[~np.isfinite(size)] = 0.0
        inverse = np.linalg.pinv(np.einsum("ac,abc,bc->cab", size, products, size), rcond=1e-12, hermitian=True)
        right = size * np.array([self._sums(a, change) for a in changes])
        weights = size * np.einsum("cab,bc->ac", inverse, right)
        found = ahead.copy()
        found[inside] -= np.einsum("an,ani->ni", weights[:, self._label], np.diff(self._points, axis=0))
        return found

    def _sums(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Products of two sets of vectors by cluster."""
        return np.bincount(self._label, weights=np.einsum("ni,ni->n", a, b)).astype(np.float64)
