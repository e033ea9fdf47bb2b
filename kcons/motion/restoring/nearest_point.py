"""Positions that are far off, brought onto the constraints, and steps along these; for starts, not for time steps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import ConvergenceError, KconsError
from kcons.motion.solver_sequence import FAILED, IterationBudget, SolverSequence
from kcons.plan.clusters import atom_labels
from kcons.solvers.tolerances import EPS

#: Rounds of the search for the nearest point on the constraints, and steps towards any point on them.
NEAREST_ROUNDS = 200
#: What is left along the constraints is rounding below so much of the size of the system, or of the distance from the
#: origin.
_STILL, _ROUNDING = 1e-12, 16 * EPS
#: Of least squares: the damping that keeps free motions out, in parts of the largest square of a slope; how often a
#: step is damped more; and what is no step, in parts of the size of the system.
LEAST, TRIES, _REACHED = 1e-10, 12, 1e-10
#: Steps towards any point on the constraints are at first no longer than this part of what rows are off by: longer ones
#: end in more places from which there is no way on.
SHORT_STEPS = 0.2
#: Part of the way to the start that may be along the constraints where the search ends.
_FOOT = 1e-12
#: Part of the way to the nearest point that may be left along the constraints without a word.
LEFT_OVER = 1e-6
#: Steps that are remembered for the curvature.
MEMORY = 20
#: Of the slope at the start, what a step must gain at least.
GAIN = 1e-4
#: Shortenings of one step.
SHORTENINGS = 20


class FarStart:
    """Search for a point on the constraints, with the projections of a `Motion` as its tools.

    Parameters
    ----------
    sequence : SolverSequence
    time : float

    Attributes
    ----------
    left : float
        Of the last search, the part of the way that leads along the constraints: 0 where it has found the nearest
        point, and not where all searches have cost what they may.
    """

    def __init__(self, sequence: SolverSequence, time: float) -> None:
        self._sequence, self._budget, self._time = sequence, IterationBudget(sequence.plan), time
        self.left = 0.0
        self._rows, self._plan, self._failures = sequence.rows, sequence.plan, sequence.failures
        self._labels = atom_labels(self._rows, self._plan.labels, self._plan.inverse_masses)

    def _positions(self, x: FloatArray, reference: FloatArray) -> None:
        """Project in place along the gradients at `reference`."""
        self._budget.iterations -= FAILED
        self._sequence.positions(x, reference, self._time, self._time, None, 0.0, None)
        self._budget.iterations += FAILED - max(self._sequence.iterations, default=0)

    def _tangents(self, x: FloatArray, y: FloatArray) -> None:
        self._sequence.tangents(x, y, None, self._time, None, "position")

    def restore(self, x: FloatArray) -> None:
        """Bring `x` onto the constraints in place, or raise `InfeasibleError`."""
        plan, fallback = self._plan, self._sequence.fallback
        if len(plan.pinned):
            x[plan.pinned] = plan.pinned_targets(self._rows.target(self._time) if self._rows.moving else None)
        fallback.budget = self._budget
        try:
            self._search(x)
        finally:
            fallback.budget = None

    def _search(self, x: FloatArray) -> None:
        start, here = x.copy(), x.copy()
        try:
            self._positions(here, start)
        except ConvergenceError:
            self._reach(here)
        self._descend(start, here)
        np.copyto(x, here)
        held = self._labels >= 0
        along = np.where(held[:, None], start - x, 0.0)
        size = float(np.max(np.abs(along), initial=0.0))
        self._tangents(x, along)
        left = float(np.max(np.abs(along), initial=0.0))
        self.left = left / size if left > max(_STILL * extent(start[held]), _rounding(start[held])) else 0.0

    def _reach(self, x: FloatArray) -> None:
        """Some point on the constraints, for starts too far off for one projection, in place."""
        start, held, time = x.copy(), self._rows, self._time
        error = self._failures.not_finite(positions=start)
        if error is not None:
            raise error
        rows = np.flatnonzero((self._plan.labels >= 0) & held.holonomic)
        atoms = np.flatnonzero(self._labels >= 0)
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

    def _descend(self, start: FloatArray, x: FloatArray) -> None:
        """Walk along the constraints towards the start in place, to the foot of a perpendicular from there."""
        away = self._labels < 0
        inverse = self._plan.inverse_masses
        mass = np.divide(1.0, inverse, out=np.zeros(len(x)), where=inverse > 0)[:, None]

        def apart(y: FloatArray) -> FloatArray:
            return np.where(away[:, None], 0.0, start - y)

        def along(y: FloatArray, move: FloatArray) -> FloatArray:
            move = move.copy()
            self._tangents(y, move)
            return move

        def onto(y: FloatArray, reference: FloatArray) -> FloatArray:
            self._positions(y, reference)
            return y

        descent = Descent(apart, along, onto, mass)
        left = descent.downhill(x)
        longest = largest(left)
        for _ in range(NEAREST_ROUNDS):
            if self._budget.iterations <= 0 or largest(left) <= max(_FOOT * largest(apart(x)), _rounding(start[~away])):
                return
            ahead, left, gained = descent.advanced(x, left, longest)
            if not gained:
                return
            np.copyto(x, ahead)


class Descent:
    """Steps that lower a potential, all on the constraints; vectors are compared in the mass metric.

    Parameters
    ----------
    acceleration : callable
        Downhill at given positions: the force of the potential by the masses, shape (n_atoms, 3).
    along : callable
        ``along(x, move)``: what of a move is along the constraints at x.
    onto : callable
        ``onto(x, reference)``: positions on the constraints; raises where there are none near.
    mass : ndarray, shape (n_atoms, 1)
    """

    def __init__(
        self,
        acceleration: Callable[[FloatArray], FloatArray],
        along: Callable[[FloatArray, FloatArray], FloatArray],
        onto: Callable[[FloatArray, FloatArray], FloatArray],
        mass: FloatArray,
    ) -> None:
        self._acceleration, self._along, self._onto, self._mass = acceleration, along, onto, mass
        #: Moves and what the acceleration lost by them, both along the constraints.
        self._memory: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=MEMORY)

    def downhill(self, x: FloatArray) -> FloatArray:
        """The acceleration along the constraints."""
        return self._along(x, self._acceleration(x))

    def _product(self, a: FloatArray, b: FloatArray) -> float:
        return float(np.vdot(a, self._mass * b))

    def advanced(self, x: FloatArray, a: FloatArray, longest: float) -> tuple[FloatArray, FloatArray, bool]:
        """Positions and acceleration after a step that gains; those given, and False, if there is none."""
        while True:
            move = self._along(x, self._newton(a))
            if not self._product(a, move) > 0 or not self._memory:
                self._memory.clear()
                move = a * (longest / largest(a))
            move = move * min(1.0, longest / largest(move))
            slope, size = self._product(a, move), 1.0
            for _ in range(SHORTENINGS):
                try:
                    there = self._onto(x + size * move, x)
                except KconsError:  # too far for this place
                    size *= 0.25
                    continue
                if np.array_equal(there, x):  # all that is left is rounding
                    break
                after = self.downhill(there)
                left = self._product(after, move)
                # The potential falls by the mean of the slopes, to third order.
                if slope + left > GAIN * slope:
                    self._remember(there, size * move, a - after)
                    return there, after, True
                size *= max(0.1, min(0.7, slope / (slope - left)))
            if not self._memory:
                return x, a, False
            self._memory.clear()  # it led nowhere: once more downhill

    def _remember(self, x: FloatArray, move: FloatArray, lost: FloatArray) -> None:
        move, lost = self._along(x, move), self._along(x, lost)
        size = np.sqrt(self._product(move, move) * self._product(lost, lost))
        if self._product(move, lost) > 1e-10 * size:
            self._memory.append((move, lost))

    def _newton(self, a: FloatArray) -> FloatArray:
        """The move that the memory suggests (two-loop recursion)."""
        if not self._memory:
            return a
        q, parts = a.copy(), []
        for move, lost in reversed(self._memory):
            parts.append(self._product(move, q) / self._product(move, lost))
            q -= parts[-1] * lost
        move, lost = self._memory[-1]
        found = q * (self._product(move, lost) / self._product(lost, lost))
        for (move, lost), part in zip(self._memory, reversed(parts), strict=True):
            found += (part - self._product(lost, found) / self._product(move, lost)) * move
        return found


def largest(vectors: FloatArray) -> float:
    """The longest of some vectors."""
    return float(np.sqrt(np.max(np.einsum("ij,ij->i", vectors, vectors), initial=0.0)))


def _rounding(x: FloatArray) -> float:
    return _ROUNDING * float(np.abs(x).max(initial=0.0))


def least_squares(
    x: FloatArray,
    atoms: IntArray,
    residuals: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], sp.csr_array],
    *,
    steps: int,
    still: float,
    longest: float = np.inf,
    bold: bool = False,
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
    bold : bool
        Whether every step is made, whatever it gains: symmetric structures would stay as they are.

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
            farthest = float(np.abs(move).max(initial=0.0))
            trial = x.copy()
            trial.reshape(-1)[columns] += move * min(1.0, longest / farthest if farthest > 0 else 1.0)
            found = residuals(trial)
            if bold or farthest > longest or float(found @ found) < error:
                break
            damping = max(4 * damping, 1e-3)
        else:
            return step
        x[...], off = trial, found
        damping = 0.1 * damping if damping > 1e-7 else 0.0
        if not farthest > still:
            return step + 1
    return steps
