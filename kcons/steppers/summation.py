"""Positions and velocities on their way through a step, without adding up rounding errors.

A step of order 6 moves the atoms up to a hundred times. Each move rounds positions and velocities; kept in pairs
of numbers (value and what rounding took from it) only the last rounding of a step remains.
"""

from __future__ import annotations

import numba
import numpy as np

from kcons.constraints.target import FloatArray


class Point:
    """Where a step is: position x + x_low, velocity v + v_low + push; arrays of shape (n_atoms, 3).

    `x` is replaced and never written to, so that a force function may keep what it was given. Where a step has
    one drift only there is nothing to add up; `x_low` and `v_low` are then None, and `push` is `v` itself.
    """

    __slots__ = ("push", "v", "v_low", "weights", "x", "x_low")

    def __init__(self, x: FloatArray, v: FloatArray, weights: FloatArray, *, exact: bool) -> None:
        self.x = x
        self.v = v.copy()
        #: 1/m for each coordinate.
        self.weights = weights
        self.x_low: FloatArray | None = np.zeros_like(x) if exact else None
        self.v_low: FloatArray | None = np.zeros_like(x) if exact else None
        self.push = np.zeros_like(x) if exact else self.v

    def kick(self, h: float, f: FloatArray) -> None:
        """Change the velocity by h M^-1 f."""
        _kick(self.push, h, f, self.weights)

    def fly(self, h: float, out: FloatArray) -> FloatArray:
        """Put x + h v into `out`; returns the array that takes changes of the velocity on the way."""
        if self.x_low is None:
            _fly_once(self.x, self.v, h, out)
        else:
            _fly(self.x, self.x_low, self.v, self.v_low, self.push, h, out)
        return self.push

    def land(self) -> None:
        """Put the whole velocity into `v`, and forget what rounding takes."""
        if self.v_low is not None:
            self.push += self.v_low
            self.v += self.push
            self.push.fill(0.0)
            self.v_low.fill(0.0)

    def restart(self, v: FloatArray) -> None:
        """Go on with other velocities."""
        np.copyto(self.v, v)


# Flat loops over few arrays: only these are compiled to vector instructions.


@numba.njit(cache=True, nogil=True)
def _kick(push, h, f, weights):  # type: ignore[no-untyped-def]
    p, g, w = push.ravel(), f.ravel(), weights.ravel()
    for i in range(p.size):
        p[i] += h * w[i] * g[i]


@numba.njit(cache=True, nogil=True)
def _fly(x, x_low, v, v_low, push, h, out):  # type: ignore[no-untyped-def]
    """Take `push` into the velocity, then out = x + h v; sums by Knuth's exact addition."""
    a, a_low, b, b_low, p, c = x.ravel(), x_low.ravel(), v.ravel(), v_low.ravel(), push.ravel(), out.ravel()
    for i in range(a.size):
        change = p[i] + b_low[i]
        total = b[i] + change
        part = total - b[i]
        low = (b[i] - (total - part)) + (change - part)
        b[i] = total
        b_low[i] = low
        p[i] = 0.0
        change = h * total + (h * low + a_low[i])
        there = a[i] + change
        part = there - a[i]
        a_low[i] = (a[i] - (there - part)) + (change - part)
        c[i] = there


@numba.njit(cache=True, nogil=True)
def _fly_once(x, v, h, out):  # type: ignore[no-untyped-def]
    a, b, c = x.ravel(), v.ravel(), out.ravel()
    for i in range(a.size):
        c[i] = a[i] + h * b[i]
