"""The isokinetic kick at fixed positions in closed form, for any strength of the force.

With u the velocities on the surface, F = M_par^+ f and 2K = u^T M u, the equation du/dt = F - (u.f/2K) u has the
solution u(t) = (u + s F)/s', where c^2 = f.F/2K, a = u.f/2K and

    s = (a/c^2)(cosh ct - 1) + sinh(ct)/c,    s' = (a/c) sinh ct + cosh ct.

Everything is divided by e^{ct}, which overflows for ct > 710. Only sums over the atoms enter: u^T M u, u.f and f.F.
"""

from __future__ import annotations

import math

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import MORE, packed_tangents
from kcons.solvers.kernels.array_views import flat, integers, table_array
from kcons.steppers.stages.compiled_operations import all_finite

#: Sums may be taken in any order, so that they are compiled to vector instructions; NaN stays NaN.
_SUMS = {"reassoc", "contract", "arcp", "nsz"}
#: Below this share of the terms, their sum has lost digits.
_CANCELS = 0.01
#: Square of a velocity across the constraints, relative to 2K, that is too much for a drift to take out exactly.
MANY = 1e4
#: What the numbers of a program begin with, as `State.thermostat`: 2K, the integral of alpha, f.M_par^+ f, and g; after
#: them the masses for each coordinate, 0 for fixed atoms, and room for accelerations.
TWICE, INTEGRAL, SQUARE, COUNT, SIZE = range(5)


@njit(cache=True, nogil=True)
def weights_of(aligned, square, twice, t):  # type: ignore[no-untyped-def]
    """Keep, push and log of the growth of the kick over a time t, which may be negative: u' = keep u + push F.

    Of u.f, f.F and 2K. Last, whether digits were lost, or c^2 is too large a number, so that `turned` must find u'.
    """
    a = aligned / twice
    c2 = square / twice if square > 0 else 0.0
    if not math.isfinite(c2):
        return math.nan, math.nan, math.nan, True
    z = math.sqrt(c2) * abs(t)
    decay = math.exp(-z)
    # sinh z/z, (cosh z - 1)/z^2 and cosh z, times e^-z; expm1 is exact near 0.
    sinh = -0.5 * math.expm1(-2 * z) / z if z > 0 else 1.0
    cosh_less = 0.5 * (math.expm1(-z) / z) ** 2 if z > 0 else 0.5
    cosh = 0.5 * (1 + decay * decay)
    growth = a * t * sinh + cosh
    if not growth > _CANCELS:
        return math.nan, math.nan, math.nan, True
    return decay / growth, t * (a * t * cosh_less + sinh) / growth, z + math.log(growth), False


def turned(u: FloatArray, pace: FloatArray, masses: FloatArray, twice: float, t: float) -> tuple[FloatArray, float]:
    """The kick of velocities that run against a strong force, and log of its growth.

    There u + s F and s' are differences of numbers that are nearly equal. The part of u across F decides how fast u
    turns round; with e = F/|F|, p = u.e/|u|, and q that part:

        u(t) = (q e^{-z} + e |u| [(1 + p) - (1 - p) e^{-2z}]/2)/g,    g = [(1 + p) + (1 - p) e^{-2z}]/2.
    """
    largest = float(np.abs(pace).max())
    axis = pace / largest  # squares of the strongest forces overflow
    length = math.sqrt(float((masses * axis * axis).sum()))
    axis *= math.copysign(1.0, t) / length
    speed = math.sqrt(twice)
    along = float((masses * u * axis).sum())
    across = u - along * axis
    across -= float((masses * across * axis).sum()) * axis  # what rounding left along the force
    q2 = min(float((masses * across * across).sum()) / twice, 1.0)
    p = math.copysign(math.sqrt(1.0 - q2), along)
    one_plus = q2 / (1.0 - p) if p < 0 else 1.0 + p
    z = largest * (length / speed * abs(t))
    decay = math.exp(-z)
    growth = 0.5 * (one_plus + (1.0 - p) * decay * decay)
    if growth == 0:  # exactly against the force, for longer than any rounding
        return -speed * axis, -z
    lead = 0.5 * (one_plus - (1.0 - p) * decay * decay) * speed
    after = (decay * across + lead * axis) / growth
    after *= math.sqrt(twice / float((masses * after * after).sum()))
    return after, z + math.log(growth)


# -- sums over the atoms ----------------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath=_SUMS)
def sums(u, pace, masses):  # type: ignore[no-untyped-def]
    """u^T M u, u^T M F and F^T M F, flat."""
    a, b, m = u.ravel(), pace.ravel(), masses.ravel()
    uu = up = pp = 0.0
    for i in range(a.size):
        w = m[i] * a[i]
        uu += w * a[i]
        up += w * b[i]
        pp += m[i] * b[i] * b[i]
    return uu, up, pp


@njit(cache=True, nogil=True, fastmath=_SUMS)
def square_sum(u, masses):  # type: ignore[no-untyped-def]
    """u^T M u."""
    a, m = u.ravel(), masses.ravel()
    uu = 0.0
    for i in range(a.size):
        uu += m[i] * a[i] * a[i]
    return uu


@njit(cache=True, nogil=True, fastmath=_SUMS)
def raw_sums(u, f, weights, masses):  # type: ignore[no-untyped-def]
    """u.f and f.M^-1 f of the atoms that move; `weights` is 1/m."""
    a, b, w, m = u.ravel(), f.ravel(), weights.ravel(), masses.ravel()
    uf = ff = 0.0
    for i in range(a.size):
        taken = m[i] * w[i]  # 1 or 0
        uf += taken * (a[i] * b[i])
        ff += taken * (w[i] * b[i] * b[i])
    return uf, ff


# -- kicks, in place --------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def before_drift(u, f, weights, masses, square, twice, t):  # type: ignore[no-untyped-def]
    """u = keep u + push M^-1 f, with forces that are not projected; log of the growth, and whether it was done.

    It is not where digits would be lost, or where a drift would have to take out more than `MANY` times 2K.
    """
    aligned, raw = raw_sums(u, f, weights, masses)
    keep, push, log_growth, cancels = weights_of(aligned, square, twice, t)
    if cancels or not push * push * raw <= MANY * twice:
        return 0.0, False
    a, b, w = flat(u), flat(f), flat(weights)
    for i in range(a.size):
        a[i] = keep * a[i] + push * (w[i] * b[i])
    return log_growth, True


@njit(cache=True, nogil=True)
def after_drift(u, pace, masses, twice, t):  # type: ignore[no-untyped-def]
    """Bring u to its length, and u = keep u + push F.

    Returns f.F, the factor of u, log of the growth, and whether it was done: it is not where digits would be lost.
    """
    uu, aligned, square = sums(u, pace, masses)
    factor = math.sqrt(twice / uu) if uu > 0 else math.nan
    aligned *= factor
    keep, push, log_growth, cancels = weights_of(aligned, square, twice, t)
    if cancels:
        return square, factor, -math.log(factor), False
    # What rounding has left to correct.
    got = keep * (keep * twice + 2 * push * aligned) + push * push * square
    right = math.sqrt(twice / got) if got > 0 else math.nan
    left, more = right * factor * keep, right * push
    a, b = flat(u), flat(pace)
    for i in range(a.size):
        a[i] = left * a[i] + more * b[i]
    return square, factor, log_growth - math.log(factor), True


# -- the same as operations of a program -------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def first_turn(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """`before_drift`, from velocities on the constraints."""
    n = v.size
    weights, masses = table_array(tables, integers(tables), MORE), numbers[SIZE : SIZE + n]
    if not all_finite(forces):
        return 1
    growth, done = before_drift(v, forces, weights, masses, numbers[SQUARE], numbers[TWICE], time)
    if not done:
        return 1
    numbers[INTEGRAL] += growth
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def turn(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """`after_drift`, from velocities on the constraints and forces, which are projected first."""
    n = v.size
    weights, masses = table_array(tables, integers(tables), MORE), numbers[SIZE : SIZE + n]
    if not all_finite(forces):
        return 1
    pace = numbers[SIZE + n : SIZE + 2 * n]
    for i in range(n):
        pace[i] = weights[i] * forces[i]
    if not packed_tangents(x, pace.reshape(v.shape), tables):
        return 1
    square, _, growth, done = after_drift(v, pace, masses, numbers[TWICE], time)
    if not done or not all_finite(v):
        return 1
    numbers[SQUARE] = square
    numbers[INTEGRAL] += growth
    return 0
