"""Descent along the constraints with a memory of its steps (L-BFGS in the tangent space)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import KconsError

#: Steps that are remembered for the curvature.
MEMORY = 20
#: Of the slope at the start, what a step must gain at least.
GAIN = 1e-4
#: Shortenings of one step.
SHORTENINGS = 20


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
