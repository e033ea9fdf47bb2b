"""What happens on spheres, compiled.

y = (u, w) of a sphere are its mass-weighted velocities and its auxiliary variables, |y| = R. Atoms enter by sums over
clusters alone; velocities are changed in place.
"""

from __future__ import annotations

import math

import numpy as np

from kcons.constraints.compilation import njit
from kcons.solvers.addressable_solvers import MORE, packed_tangents
from kcons.solvers.kernels.array_views import integers, table_array
from kcons.steppers.compiled_operations import all_finite
from kcons.thermostats.noise import fill_next

#: The arrays of a program's numbers, in `in_one_array`: those of `HEAD`, R^2, w, those of `SphereLayout`, 1/sqrt(m) for
#: each coordinate, and room for accelerations or noise.
HEAD, SQUARES, OWN, CLUSTER, SPHERES, MASSES, TOTALS, ROOTS, ROOM = range(9)
#: In the head: gamma and k_B T, the seed's halves, the number of the step, how often noise has been drawn in it, and
#: how often it is in each.
FRICTION, KT, SEED = 0, 1, 2


@njit(cache=True, nogil=True)
def centers(v, cluster, spheres, masses, totals):  # type: ignore[no-untyped-def]
    """Velocity of the center of mass of each cluster that has a sphere for it, else 0, shape (n_clusters, 3)."""
    found = np.zeros((len(totals), 3))
    for i in range(len(cluster)):
        c = cluster[i]
        if c >= 0 and spheres[c, 0] >= 0:
            for k in range(3):
                found[c, k] += masses[i] * v[i, k]
    for c in range(len(totals)):
        for k in range(3):
            found[c, k] /= totals[c]
    return found


@njit(cache=True, nogil=True)
def products(v, a, middle_v, middle_a, n_spheres, cluster, spheres, masses, totals):  # type: ignore[no-untyped-def]
    """u.u', mass-weighted, on each sphere."""
    found = np.zeros(n_spheres)
    for c in range(len(totals)):
        for k in range(3):
            if spheres[c, k] >= 0:
                found[spheres[c, k]] += totals[c] * middle_v[c, k] * middle_a[c, k]
    for i in range(len(cluster)):
        c = cluster[i]
        if c >= 0 and spheres[c, 3] >= 0:
            total = 0.0
            for k in range(3):
                total += (v[i, k] - middle_v[c, k]) * (a[i, k] - middle_a[c, k])
            found[spheres[c, 3]] += masses[i] * total
    return found


@njit(cache=True, nogil=True)
def combine(v, a, middle_v, middle_a, keep, push, cluster, spheres):  # type: ignore[no-untyped-def]
    """u = keep u + push u' on each sphere; what has no sphere stays."""
    for i in range(len(cluster)):
        c = cluster[i]
        if c < 0:
            continue
        rest = spheres[c, 3]
        for k in range(3):
            inner = v[i, k] - middle_v[c, k]
            if rest >= 0:
                inner = keep[rest] * inner + push[rest] * (a[i, k] - middle_a[c, k])
            s = spheres[c, k]
            if s >= 0:
                inner += keep[s] * middle_v[c, k] + push[s] * middle_a[c, k]
            v[i, k] = inner


@njit(cache=True, nogil=True)
def rescale(v, w, squares, with_w, cluster, spheres, masses, totals):  # type: ignore[no-untyped-def]
    """Bring y back onto its sphere: all of it, or u alone, with w as it is."""
    n = len(squares)
    middle = centers(v, cluster, spheres, masses, totals)
    has = products(v, v, middle, middle, n, cluster, spheres, masses, totals)
    keep, push = np.ones(n), np.zeros(n)
    for s in range(n):
        own = 0.0
        for k in range(w.shape[1]):
            own += w[s, k] * w[s, k]
        if with_w:
            if has[s] + own > 0:
                keep[s] = math.sqrt(squares[s] / (has[s] + own))
            for k in range(w.shape[1]):
                w[s, k] *= keep[s]
        elif has[s] > 0:
            keep[s] = math.sqrt(max(squares[s] - own, 0.0) / has[s])
    combine(v, v, middle, middle, keep, push, cluster, spheres)


@njit(cache=True, nogil=True)
def turn(v, w, a, t, squares, cluster, spheres, masses, totals):  # type: ignore[no-untyped-def]
    """The kick: y' = (1 - y y^T/R^2)(F, 0) over a time t, in closed form, with the accelerations a on the constraints.

    With e = F/|F|, c = u.e/R and z = |F| t/R, divided by e^z so that nothing overflows:

        y(t) = (y e^-z + e R [(1 - e^-2z) + c (1 - e^-z)^2]/2)/d,    d = [(1 + c) + (1 - c) e^-2z]/2.
    """
    n = len(squares)
    middle_v = centers(v, cluster, spheres, masses, totals)
    middle_a = centers(a, cluster, spheres, masses, totals)
    along = products(v, a, middle_v, middle_a, n, cluster, spheres, masses, totals)
    strength = products(a, a, middle_a, middle_a, n, cluster, spheres, masses, totals)
    keep, push = np.ones(n), np.zeros(n)
    for s in range(n):
        if not strength[s] > 0:
            continue
        force, radius = math.copysign(math.sqrt(strength[s]), t), math.sqrt(squares[s])
        cosine = min(max(along[s] / (force * radius), -1.0), 1.0)
        z = force * t / radius
        once, twice = math.expm1(-z), math.expm1(-2 * z)
        scale = 1.0 + 0.5 * (1.0 - cosine) * twice
        if not scale > 0:  # exactly against the force, for longer than any rounding
            continue
        keep[s] = (1.0 + once) / scale
        push[s] = 0.5 * radius / force * (cosine * once * once - twice) / scale
        for k in range(w.shape[1]):
            w[s, k] *= keep[s]
    combine(v, a, middle_v, middle_a, keep, push, cluster, spheres)
    rescale(v, w, squares, True, cluster, spheres, masses, totals)


@njit(cache=True, nogil=True)
def stir(v, w, noise, own_noise, keep, spread, squares, cluster, spheres, masses, totals):  # type: ignore[no-untyped-def]
    """y = R (keep y + spread xi)/|keep y + spread xi|, with noise that is on the constraints."""
    for i in range(len(cluster)):
        for k in range(3):
            v[i, k] = keep * v[i, k] + spread * noise[i, k]
    for s in range(w.shape[0]):
        for k in range(w.shape[1]):
            w[s, k] = keep * w[s, k] + spread * own_noise[s, k]
    rescale(v, w, squares, True, cluster, spheres, masses, totals)


# -- the same as operations of a program -------------------------------------------------------------


@njit(cache=True, nogil=True)
def unpacked(numbers):  # type: ignore[no-untyped-def]
    """w, R^2 and the arrays of the layout, as the kernels take them."""
    header = integers(numbers)
    squares, spheres = table_array(numbers, header, SQUARES), table_array(header, header, SPHERES)
    w = table_array(numbers, header, OWN)
    layout = table_array(header, header, CLUSTER), spheres.reshape(spheres.size // 4, 4)
    more = table_array(numbers, header, MASSES), table_array(numbers, header, TOTALS)
    return w.reshape(squares.size, w.size // squares.size), squares, *layout, *more


@njit(cache=True, nogil=True)
def restore(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """Velocities and auxiliary variables get the lengths of their spheres."""
    w, squares, cluster, spheres, masses, totals = unpacked(numbers)
    rescale(v, w, squares, True, cluster, spheres, masses, totals)
    return 0


@njit(cache=True, nogil=True)
def shorten(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """Velocities get the length they had before the drift."""
    w, squares, cluster, spheres, masses, totals = unpacked(numbers)
    rescale(v, w, squares, False, cluster, spheres, masses, totals)
    return 0


@njit(cache=True, nogil=True)
def turn_along(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """`turn` by forces, which are projected first; 1 where they cannot be."""
    w, squares, cluster, spheres, masses, totals = unpacked(numbers)
    pace, weights = table_array(numbers, integers(numbers), ROOM)[: v.size], table_array(tables, integers(tables), MORE)
    for i in range(v.size):
        pace[i] = weights[i] * forces[i]
    a = pace.reshape(v.shape)
    if not (all_finite(pace) and packed_tangents(x, a, tables)):
        return 1
    turn(v, w, a, time, squares, cluster, spheres, masses, totals)
    return 0


@njit(cache=True, nogil=True)
def exchange(x, v, forces, time, numbers, tables):  # type: ignore[no-untyped-def]
    """Friction and noise; 1 where noise cannot be projected."""
    w, squares, cluster, spheres, masses, totals = unpacked(numbers)
    header, n = integers(numbers), v.size
    head, roots = table_array(numbers, header, HEAD), table_array(numbers, header, ROOTS)
    drawn = table_array(numbers, header, ROOM)
    fill_next(head[SEED : SEED + 5], drawn)
    for i in range(n):
        drawn[i] *= roots[i]
    noise = drawn[:n].reshape(v.shape)
    if not packed_tangents(x, noise, tables):
        return 1
    decay = head[FRICTION] * time
    keep, spread = math.exp(-decay), math.sqrt(-math.expm1(-2 * decay) * head[KT])
    own = drawn[n:].reshape(w.shape)
    stir(v, w, noise, own, keep, spread, squares, cluster, spheres, masses, totals)
    return 0
