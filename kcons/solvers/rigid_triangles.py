"""Rigid triangles: three held distances between three atoms, eight at a time.

The displacements that hold a triangle lie in the plane of its reference shape, spanned by ``s01`` and ``s02``. Two bond
vectors describe the triangle (the third is their difference), so a Newton step is four scalar products, a 3-by-3 solve
and four updates.
"""

import numpy as np
from numba import types
from numpy.typing import ArrayLike

from kcons.constraints.compilation import njit
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.distance_clusters import (
    SAVED,
    difference,
    dot,
    lane_tables,
    minus,
    plus,
    product,
    restore_points,
    times,
    worst_row,
)
from kcons.solvers.kernels.aligned_memory import in_one_array, room
from kcons.solvers.kernels.any_width import arithmetic
from kcons.solvers.kernels.array_views import at_first, halves, integers, table_array
from kcons.solvers.kernels.eight_wide import (
    FASTMATH,
    TRIPLE,
    WIDTH,
    all_within,
    gather_differences,
    gather_points,
    keep_points,
    lanes_type,
    not_positive,
    scatter_points,
    splat,
    store_triple,
)
from kcons.solvers.kernels.lattices import OPEN, lattice_numbers, minimum_image
from kcons.solvers.tolerances import MAX_ITERATIONS, NEWTON_TOLERANCE, SPEED_TOLERANCE, TINY

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Order of the three rows of a triangle, in local atoms."""
#: Of the pieces of the tables, those that are named.
_SIDES, _UNDO = 3, 4
#: Not literal, since a function is compiled for each of its literal arguments.
_NONE, _CORNERS = np.int64(0), np.int64(3)
#: Rows of an adjugate, and what scales it.
_FACTOR = types.UniTuple(lanes_type, 10)

# Of a triangle: p, q are the bonds from atom 0 to 1 and to 2, s, t their references, w inverse masses; of its
# three rows e are errors, d and m multipliers, l squares of lengths.

_squared = arithmetic(TRIPLE)(lambda e: tuple(x * x for x in e))
_absolute = arithmetic(TRIPLE)(lambda e: tuple(x.unary("fabs") for x in e))
_roots = arithmetic(TRIPLE)(lambda l, r: tuple(y * x.unary("sqrt") for x, y in zip(l, r, strict=True)))


@arithmetic(TRIPLE)
def _products(p, q, s, t):
    """Of the three bonds with their references."""
    return product(p, s), product(q, t), product(difference(q, p), difference(t, s))


@arithmetic(TRIPLE)
def _length_errors(l, p, q):
    u = difference(q, p)
    return l[0] - product(p, p), l[1] - product(q, q), l[2] - product(u, u)


@arithmetic(_FACTOR)
def _tangent_factor(l, s, t, w):
    """Rows of the adjugate of the matrix for velocities, and what scales it."""
    (l0, l1, l2), (w0, w1, w2), st = l, w, product(s, t)
    a00, a01, a02 = (w0 + w1) * l0, w0 * st, w1 * (l0 - st)
    a11, a12, a22 = (w0 + w2) * l1, w2 * (l1 - st), (w1 + w2) * l2
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    return c00, c01, c02, c01, c11, c12, c02, c12, c22, 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)


@arithmetic(_FACTOR)
def _position_factor(p, q, s, t, w):
    """The same of Newton's matrix for positions."""
    ps, pt, qs, qt, (w0, w1, w2) = product(p, s), product(p, t), product(q, s), product(q, t), w
    us, ut = qs - ps, qt - pt
    a00, a01, a02 = (w0 + w1) * ps, w0 * pt, w1 * (ps - pt)
    a10, a11, a12 = w0 * qs, (w0 + w2) * qt, w2 * (qt - qs)
    a20, a21, a22 = w1 * us, w2 * ut, (w1 + w2) * (ut - us)
    c00, c01, c02 = a11 * a22 - a12 * a21, a02 * a21 - a01 * a22, a01 * a12 - a02 * a11
    c10, c11, c12 = -(a12 * a20 + a10 * a22), a00 * a22 + a02 * a20, a02 * a10 - a00 * a12
    c20, c21, c22 = a10 * a21 + a11 * a20, -(a01 * a20 + a00 * a21), a00 * a11 - a01 * a10
    return c00, c01, c02, c10, c11, c12, c20, c21, c22, 0.5 / (a00 * c00 + a01 * c10 + a02 * c20)


@arithmetic(TRIPLE)
def _solved(factor, e):
    scaled = tuple(x * factor[9] for x in e)
    return tuple(product(factor[k : k + 3], scaled) for k in (0, 3, 6))


@arithmetic(types.UniTuple(TRIPLE, 3))
def _stepped(p, q, m, d, w, s, t):
    """Bonds and multipliers after a step d."""
    (w0, w1, w2), (d0, d1, d2) = w, d
    pulls = (p, (w0 + w1) * d0 + w1 * d2, w0 * d1 - w1 * d2), (q, w0 * d0 - w2 * d2, (w0 + w2) * d1 + w2 * d2)
    p, q = (tuple(x + f * y + g * z for x, y, z in zip(bond, s, t, strict=True)) for bond, f, g in pulls)
    return p, q, tuple(x + y for x, y in zip(m, d, strict=True))


@arithmetic(types.UniTuple(TRIPLE, 3))
def _shifts(m, w, s, t):
    """How far the corners move."""
    (m0, m1, m2), (w0, w1, w2) = m, w
    factors = (w0 * m0, w0 * m1), (-w1 * (m0 + m2), w1 * m2), (w2 * m2, -w2 * (m1 + m2))
    return tuple(tuple(f * x + g * y for x, y in zip(s, t, strict=True)) for f, g in factors)


@arithmetic(TRIPLE)
def _unit_multipliers(sign, m, s, t):
    """Multipliers of unit gradients."""
    return tuple(sign * x * product(b, b).unary("sqrt") for x, b in zip(m, (s, t, difference(t, s)), strict=True))


# Spliced into the loop as they stand: what is compiled apart is rounded otherwise, and takes longer.


@njit(fastmath=FASTMATH, inline="always")
def _small(e, l, factor):
    limits = times(l, factor)
    return all_within(e[0], limits[0]) and all_within(e[1], limits[1]) and all_within(e[2], limits[2])


@njit(fastmath=FASTMATH, inline="always")
def _move(points, velocities, inverse_dt, atoms, corner, point, shift, move, undo, saved):
    """Move a corner of each triangle, and change its velocity."""
    scatter_points(points, atoms, corner, plus(point, shift, 1.0))
    if move:
        velocity = keep_points(velocities, atoms, corner, undo, saved + 3 * SAVED)
        scatter_points(velocities, atoms, corner, plus(velocity, shift, inverse_dt))


@njit(cache=True, fastmath=FASTMATH)
def _project(tangent, points, references, velocities, inverse_dt, given, lattice, kind, tables, multipliers):
    """Project one group of eight triangles after another; `distance_clusters` says what the arguments are."""
    header, words = integers(tables), halves(tables)
    atoms, slots = table_array(words, header, 0), table_array(words, header, 1)
    inv_mass, undo = table_array(tables, header, 2), table_array(tables, header, _UNDO)
    move, report, driven = tangent is None and inverse_dt != 0.0, multipliers.shape[0] > 0, given.shape[0] > 0
    n_groups, cell = slots.shape[0] // WIDTH, lattice_numbers(lattice)
    # Arrays that are handed on inside the loop would cost reference counting.
    changed, moving, table, room = at_first(points), at_first(velocities), at_first(atoms), at_first(undo)
    w, zero = (inv_mass[0], inv_mass[1], inv_mass[2]), splat(0.0)
    errors, sizes = table_array(tables, header, 5), table_array(tables, header, 6)
    worst, worst_at, most = 0.0, -1, 0
    # Points kept of a triangle, what residuals are counted in, and the sign of multipliers.
    kept_points, unit, sign = (2 * _CORNERS, 2.0, 1.0) if tangent is None else (_CORNERS, 1.0, -1.0)
    for group in range(n_groups):
        at, saved = group * 3 * WIDTH, kept_points * group * SAVED
        s = gather_differences(references, atoms, at, at + WIDTH)
        t = gather_differences(references, atoms, at, at + 2 * WIDTH)
        a = keep_points(points, atoms, at, undo, saved)
        b = keep_points(points, atoms, at + WIDTH, undo, saved + SAVED)
        c = keep_points(points, atoms, at + 2 * WIDTH, undo, saved + 2 * SAVED)
        p, q = minus(a, b), minus(a, c)
        if kind != OPEN:
            s, t = minimum_image(s, cell, kind), minimum_image(t, cell, kind)
            if tangent is None:
                p, q = minimum_image(p, cell, kind), minimum_image(q, cell, kind)
        m = r = (zero, zero, zero)
        factor, size = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero), zero
        # What the errors of the three rows are compared with.
        if tangent is None:
            l = _squared(gather_points(given, slots, group * WIDTH))
        else:
            l, size = _products(s, t, s, t), dot(p, p) + dot(q, q)
            if driven:
                r = gather_points(given, slots, group * WIDTH)
                size, r = size + dot(r, r), _roots(l, r)
            size = size * (SPEED_TOLERANCE * SPEED_TOLERANCE)
            factor = _tangent_factor(l, s, t, w)
        iteration, ok = 0, False
        while True:
            if tangent is None:
                e = _length_errors(l, p, q)
                if iteration >= 3:
                    ok = _small(_absolute(e), l, 2.0 * NEWTON_TOLERANCE)
                    if ok or iteration == MAX_ITERATIONS:
                        break
                # A factor serves two steps: Newton, then chord; order three for both.
                if iteration % 2 == 0:
                    factor = _position_factor(p, q, s, t, w)
            else:
                e = minus(r, _products(p, q, s, t))
                if iteration > 0:
                    ok = _small(_squared(e), l, size)
                    if ok or iteration == MAX_ITERATIONS:
                        break
            p, q, m = _stepped(p, q, m, _solved(factor, e), w, s, t)
            iteration += 1
        # A bond that turned round has found the wrong root.
        inner, e = (_products(p, q, s, t), _absolute(e)) if tangent is None else (l, _squared(e))
        most = iteration if iteration > most else most
        kept = all_within(TINY, inner[0]) and all_within(TINY, inner[1]) and all_within(TINY, inner[2])
        if not (ok and kept and _small(e, l, unit * worst)):
            store_triple(errors, 0, e)
            store_triple(sizes, 0, times(l, unit))
            if ok and not kept:
                store_triple(errors, 0, (not_positive(inner[0]), not_positive(inner[1]), not_positive(inner[2])))
                store_triple(sizes, 0, (splat(1.0), splat(1.0), splat(1.0)))
            worst, worst_at = worst_row(errors, sizes, 3, slots, group * WIDTH)
            if not (ok and kept):
                restore_points(points, atoms, undo, group, _CORNERS, kept_points, _NONE)
                if move:
                    restore_points(velocities, atoms, undo, group, _CORNERS, kept_points, _CORNERS)
                return False, worst if tangent is None else np.sqrt(worst), most, worst_at
        shifts = _shifts(m, w, s, t)
        _move(changed, moving, inverse_dt, table, at, a, shifts[0], move, room, saved)
        _move(changed, moving, inverse_dt, table, at + WIDTH, b, shifts[1], move, room, saved + SAVED)
        _move(changed, moving, inverse_dt, table, at + 2 * WIDTH, c, shifts[2], move, room, saved + 2 * SAVED)
        if report:
            scatter_points(at_first(multipliers), at_first(slots), group * WIDTH, _unit_multipliers(sign, m, s, t))
    return True, worst if tangent is None else np.sqrt(worst), most, worst_at


@njit(cache=True)
def _positions(alone, x, x_ref, v, inv_dt, wanted, lattice, kind, tables, numbers):
    """This and the next two as `kcons.solvers.addressable_solvers` says."""
    sides = wanted if wanted.size else table_array(tables, integers(tables), _SIDES)
    return _project(None, x, x_ref, v, inv_dt, sides, lattice, kind, tables, numbers)


@njit(cache=True)
def _tangents(alone, y, x, v, inv_dt, wanted, lattice, kind, tables, numbers):
    return _project((), y, x, v, inv_dt, wanted, lattice, kind, tables, numbers)


@njit(cache=True, nogil=True)
def _undo(points, tangents, velocities, tables):
    h, u = integers(tables), halves(tables)
    groups, kept, first = table_array(u, h, 1).size // WIDTH, 3 if tangents else 6, 3 if velocities else 0
    restore_points(points, table_array(u, h, 0), table_array(tables, h, _UNDO), groups, _CORNERS, kept, first)


class RigidTriangles(AddressableSolver):
    """Triangles of equal masses held rigid by three distances each.

    Parameters
    ----------
    rows : array_like of int, shape (n, 3)
        Global row numbers, in the order of `PAIRS`.
    atoms : array_like of int, shape (n, 3)
        Atoms of each triangle.
    lengths : array_like of float, shape (n, 3)
        Lengths used where a request names none.
    inv_mass : array_like of float, shape (3,)
        Inverse masses of the three atoms; 0 for a pinned one.
    """

    name = "RigidTriangles"
    kernels = Kernels(_positions, _tangents, undo=_undo)

    def __init__(self, rows: ArrayLike, atoms: ArrayLike, lengths: ArrayLike, inv_mass: ArrayLike) -> None:
        self._made_of = rows, atoms, lengths, inv_mass
        self.rows = np.array(rows, dtype=np.int64).reshape(-1)
        slots, corners = lane_tables(np.asarray(atoms).reshape(-1, 3), 3)
        given = np.array(inv_mass, dtype=np.float64), np.array(lengths, dtype=np.float64).reshape(-1)
        self.tables = in_one_array(
            (corners, slots, *given, room(6 * len(corners)), *(room(3 * WIDTH) for _ in range(2)))
        )
