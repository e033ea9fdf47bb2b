"""Positions and velocities on their way through a step, without adding up rounding errors.

A step of order 6 moves the atoms up to a hundred times. Each move rounds positions and velocities; kept in pairs
of numbers (value and what rounding took from it) only the last rounding of a step remains.
"""

from __future__ import annotations

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import NonFiniteError
from kcons.solvers.kernels.array_views import bits, flat

#: Stands for the work arrays where a step adds up nothing.
NO_WORK = np.empty((0, 0, 3))


class Point:
    """Where a step is: position x + x_low, velocity v + push; arrays of shape (n_atoms, 3).

    `x` is replaced and never written to, so that a force function may keep what it was given. Where a step has
    one drift only there is nothing to add up; `x_low` is then None, and `push` is `v` itself.

    A kick is kept until the next drift, which takes it in the same pass over the arrays.
    """

    __slots__ = ("_force", "_kick", "fresh", "push", "sound", "v", "weights", "work", "x", "x_low")

    def __init__(self, x: FloatArray, v: FloatArray, weights: FloatArray, *, exact: bool) -> None:
        self.x = x
        #: Velocities as they were given, not yet a copy, until the first drift.
        self.v = v
        #: Whether that is so; `x_low` and `push` then hold nothing yet.
        self.fresh = True
        #: 1/m for each coordinate.
        self.weights = weights
        self.x_low: FloatArray | None
        #: `x_low`, `push` and room for positions that nobody sees, shape (3, n_atoms, 3); else (0, 0, 3).
        if exact:
            self.work = np.empty((3, *x.shape))
            self.x_low, self.push = self.work[0], self.work[1]
        else:
            self.work, self.x_low, self.push = NO_WORK, None, v
        #: Whether the forces of all kicks that were done are finite.
        self.sound = True
        self._kick = 0.0
        self._force = weights  # any finite numbers: they are multiplied by 0

    def kick(self, h: float, f: FloatArray) -> None:
        """Change the velocity by h M^-1 f."""
        if self._kick:
            self.land()
        self._kick, self._force = h, f

    def take_kick(self) -> tuple[float, FloatArray]:
        """The kick that has not been done yet, for whoever does it now."""
        kick, force = self._kick, self._force
        self._kick, self._force = 0.0, self.weights
        return kick, force

    def fly(self, h: float, out: FloatArray) -> FloatArray:
        """Put x + h v into `out`; returns the array that takes changes of the velocity on the way."""
        kick, force = self.take_kick()
        if self.x_low is None:
            before = self.v
            if self.fresh:
                self.v = self.push = np.empty(before.shape)
            sound = fly_once(self.x, before, kick, force, self.weights, h, self.v, out)
        elif self.fresh:
            before, self.v = self.v, np.empty(self.v.shape)
            sound = fly_first(self.x, self.x_low, before, self.v, self.push, kick, force, self.weights, h, out)
        else:
            sound = fly(self.x, self.x_low, self.v, self.push, kick, force, self.weights, h, out)
        self.fresh = False
        if not sound:
            self.sound = False
        return self.push

    def remainder(self, atoms: IntArray) -> FloatArray:
        """What rounding has taken from the positions of some atoms so far, shape (len(atoms), 3)."""
        if self.fresh or self.x_low is None:
            return np.zeros((len(atoms), 3))
        return self.x_low[atoms]

    def land(self) -> None:
        """Put the whole velocity into `v`, and forget what rounding takes."""
        kick, force = self.take_kick()
        if self.fresh:
            self.v = self.v.copy()
            if self.x_low is None:
                self.push = self.v
            else:
                self.x_low.fill(0.0)
                self.push.fill(0.0)
            self.fresh = False
        if self.x_low is None:
            sound = not kick or add_kick(self.v, kick, force, self.weights)
        else:
            sound = land(self.v, self.push, kick, force, self.weights)
        if not sound:
            self.sound = False

    def restart(self, v: FloatArray) -> None:
        """Go on with other velocities, after `land`."""
        np.copyto(self.v, v)


# Flat loops over few arrays: only these are compiled to vector instructions. All say whether the force of the kick is
# finite: one more call for that, after a long calculation of forces, costs what the engine takes for ten molecules.


@njit(cache=True, nogil=True)
def all_finite(values):  # type: ignore[no-untyped-def]
    """Whether no number is NaN or infinite."""
    # The largest exponent is that of NaN and infinities; integers, so that the loop becomes vector instructions.
    numbers = bits(values)
    worst = np.int64(0)
    for i in range(numbers.size):
        worst = max(worst, numbers[i] & 0x7FF0000000000000)
    return worst != 0x7FF0000000000000


def check_finite(values: FloatArray, item: str, step: int) -> None:
    """Raise `NonFiniteError` unless every number is finite."""
    if all_finite(values):
        return
    atom = int(np.argmax(~np.isfinite(values).all(axis=1)))
    raise NonFiniteError(
        f"non-finite {item} at step {step} on atom {atom}: {values[atom]}. The state before this step is intact; "
        "check the geometry and the force function there, or use a smaller time step",
        item=item,
        atom=atom,
        step=step,
    )


@njit(cache=True, nogil=True, inline="always")
def add_kick(v, kick, f, weights):  # type: ignore[no-untyped-def]
    sound = kick == 0.0 or all_finite(f)
    b, g, w = flat(v), flat(f), flat(weights)
    for i in range(b.size):
        b[i] += kick * w[i] * g[i]
    return sound


@njit(cache=True, nogil=True)
def land(v, push, kick, f, weights):  # type: ignore[no-untyped-def]
    sound = kick == 0.0 or all_finite(f)
    b, p, g, w = flat(v), flat(push), flat(f), flat(weights)
    for i in range(b.size):
        b[i] += p[i] + kick * w[i] * g[i]
        p[i] = 0.0
    return sound


@njit(cache=True, nogil=True, fastmath={"contract"})
def fly(x, x_low, v, push, kick, f, weights, h, out):  # type: ignore[no-untyped-def]
    """Take the kick and `push` into the velocity, then out = x + h v; sums by Dekker's addition.

    It is exact where the change is the smaller number. Where a coordinate crosses 0 it is not; the error is then one
    of the rounding of the change, not of the coordinate.
    """
    sound = kick == 0.0 or all_finite(f)
    a, a_low, b, p, c = flat(x), flat(x_low), flat(v), flat(push), flat(out)
    g, w = flat(f), flat(weights)
    for i in range(a.size):
        change = p[i] + kick * w[i] * g[i]
        total = b[i] + change
        low = change - (total - b[i])
        b[i] = total
        p[i] = low
        change = h * total + (h * low + a_low[i])
        there = a[i] + change
        a_low[i] = change - (there - a[i])
        c[i] = there
    return sound


@njit(cache=True, nogil=True, fastmath={"contract"})
def fly_first(x, x_low, v0, v, push, kick, f, weights, h, out):  # type: ignore[no-untyped-def]
    """The same from a start without remainders; `x_low`, `v` and `push` are only written to."""
    sound = kick == 0.0 or all_finite(f)
    a, a_low, b0, b, p, c = flat(x), flat(x_low), flat(v0), flat(v), flat(push), flat(out)
    g, w = flat(f), flat(weights)
    for i in range(a.size):
        change = kick * w[i] * g[i]
        total = b0[i] + change
        low = change - (total - b0[i])
        b[i] = total
        p[i] = low
        change = h * total + h * low
        there = a[i] + change
        a_low[i] = change - (there - a[i])
        c[i] = there
    return sound


@njit(cache=True, nogil=True, fastmath={"contract"})
def fly_once(x, v0, kick, f, weights, h, v, out):  # type: ignore[no-untyped-def]
    sound = kick == 0.0 or all_finite(f)
    a, b0, b, c, g, w = flat(x), flat(v0), flat(v), flat(out), flat(f), flat(weights)
    for i in range(a.size):
        b[i] = b0[i] + kick * w[i] * g[i]
        c[i] = a[i] + h * b[i]
    return sound


@njit(cache=True, nogil=True)
def beyond(x, atoms, anchor, ratio):  # type: ignore[no-untyped-def]
    """Whether the anchor is farther from the origin than `ratio` times any atom is from the anchor."""
    a, b = flat(x), 3 * anchor
    far = max(abs(a[b]), abs(a[b + 1]), abs(a[b + 2])) / ratio
    for n in range(3 * atoms.size):
        k = n % 3
        if not abs(a[3 * atoms[n // 3] + k] - a[b + k]) < far:
            return False
    return True
