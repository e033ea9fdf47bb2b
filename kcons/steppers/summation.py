"""Positions and velocities on their way through a step, without adding up rounding errors.

A step of order 6 moves the atoms up to a hundred times. Each move rounds positions and velocities; kept in pairs
of numbers (value and what rounding took from it) only the last rounding of a step remains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from kcons.constraints.target import FloatArray


@dataclass
class Point:
    """Arrays of shape (n_atoms, 3); the position is x + x_low, the velocity v + v_low + push.

    `x` is replaced and never written to, so that a force function may keep what it was given; the others are
    changed in place.
    """

    x: FloatArray
    x_low: FloatArray
    v: FloatArray
    v_low: FloatArray
    push: FloatArray

    @classmethod
    def at(cls, x: FloatArray, v: FloatArray) -> Point:
        return cls(x, np.zeros_like(x), v.copy(), np.zeros_like(x), np.zeros_like(x))

    def settle(self) -> None:
        """Put the whole velocity into `v`, and forget what rounding takes."""
        self.push += self.v_low
        self.v += self.push
        self.push.fill(0.0)
        self.v_low.fill(0.0)


@numba.njit(cache=True, nogil=True)
def fly(x, x_low, v, v_low, push, h, out):  # type: ignore[no-untyped-def]
    """Take `push` into the velocity, then out = x + h v; sums by Knuth's exact addition."""
    a, a_low, b, b_low, p, c = x.ravel(), x_low.ravel(), v.ravel(), v_low.ravel(), push.ravel(), out.ravel()
    for i in range(a.size):
        change = p[i] + b_low[i]
        total = b[i] + change
        part = total - b[i]
        b_low[i] = (b[i] - (total - part)) + (change - part)
        b[i] = total
        p[i] = 0.0
        change = h * total + (h * b_low[i] + a_low[i])
        there = a[i] + change
        part = there - a[i]
        a_low[i] = (a[i] - (there - part)) + (change - part)
        c[i] = there
