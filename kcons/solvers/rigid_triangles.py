"""Rigid triangles: three held distances between three atoms, eight at a time.

The displacements that hold a triangle lie in the plane of its reference shape, spanned by ``s01`` and ``s02``. Two bond
vectors describe the triangle (the third is their difference), so a Newton step is four scalar products, a 3-by-3 solve
and four updates.
"""

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.compilation import njit
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.distance_clusters import SAVED, dot, lane_tables, restore_points, worst_row
from kcons.solvers.kernels.aligned_memory import in_one_array, room
from kcons.solvers.kernels.array_views import at_first, halves, integers, table_array
from kcons.solvers.kernels.eight_wide import (
    FASTMATH,
    WIDTH,
    absolute,
    all_within,
    gather_differences,
    gather_points,
    keep_points,
    not_positive,
    scatter_points,
    splat,
    square_root,
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


# Spliced into the loop as they stand: what is compiled apart is rounded otherwise, and takes longer.


@njit(fastmath=FASTMATH, inline="always")
def _small(e0, e1, e2, l0, l1, l2, factor):
    return all_within(e0, l0 * factor) and all_within(e1, l1 * factor) and all_within(e2, l2 * factor)


@njit(fastmath=FASTMATH, inline="always")
def _length_errors(l0, l1, l2, px, py, pz, qx, qy, qz):
    ux, uy, uz = qx - px, qy - py, qz - pz
    e0, e1 = l0 - dot(px, py, pz, px, py, pz), l1 - dot(qx, qy, qz, qx, qy, qz)
    return e0, e1, l2 - dot(ux, uy, uz, ux, uy, uz)


@njit(fastmath=FASTMATH, inline="always")
def _products(px, py, pz, qx, qy, qz, sx, sy, sz, tx, ty, tz):
    """Of the three bonds with their references."""
    us = dot(qx - px, qy - py, qz - pz, tx - sx, ty - sy, tz - sz)
    return dot(px, py, pz, sx, sy, sz), dot(qx, qy, qz, tx, ty, tz), us


@njit(fastmath=FASTMATH, inline="always")
def _tangent_factor(l0, l1, l2, st, w0, w1, w2, w01, w02, w12):
    """Rows of the adjugate of the matrix for velocities, and what scales it."""
    a00, a01, a02 = w01 * l0, w0 * st, w1 * (l0 - st)
    a11, a12, a22 = w02 * l1, w2 * (l1 - st), w12 * l2
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    return c00, c01, c02, c01, c11, c12, c02, c12, c22, 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)


@njit(fastmath=FASTMATH, inline="always")
def _position_factor(px, py, pz, qx, qy, qz, sx, sy, sz, tx, ty, tz, w0, w1, w2, w01, w02, w12):
    """The same of Newton's matrix for positions."""
    ps, pt = dot(px, py, pz, sx, sy, sz), dot(px, py, pz, tx, ty, tz)
    qs, qt = dot(qx, qy, qz, sx, sy, sz), dot(qx, qy, qz, tx, ty, tz)
    us, ut = qs - ps, qt - pt
    a00, a01, a02 = w01 * ps, w0 * pt, w1 * (ps - pt)
    a10, a11, a12 = w0 * qs, w02 * qt, w2 * (qt - qs)
    a20, a21, a22 = w1 * us, w2 * ut, w12 * (ut - us)
    c00, c01, c02 = a11 * a22 - a12 * a21, a02 * a21 - a01 * a22, a01 * a12 - a02 * a11
    c10, c11, c12 = -(a12 * a20 + a10 * a22), a00 * a22 + a02 * a20, a02 * a10 - a00 * a12
    c20, c21, c22 = a10 * a21 + a11 * a20, -(a01 * a20 + a00 * a21), a00 * a11 - a01 * a10
    return c00, c01, c02, c10, c11, c12, c20, c21, c22, 0.5 / (a00 * c00 + a01 * c10 + a02 * c20)


@njit(fastmath=FASTMATH, inline="always")
def _product(c00, c01, c02, c10, c11, c12, c20, c21, c22, f0, f1, f2):
    d0 = c00 * f0 + c01 * f1 + c02 * f2
    d1 = c10 * f0 + c11 * f1 + c12 * f2
    d2 = c20 * f0 + c21 * f1 + c22 * f2
    return d0, d1, d2


@njit(fastmath=FASTMATH, inline="always")
def _pulled(px, py, pz, f, g, sx, sy, sz, tx, ty, tz):
    return px + f * sx + g * tx, py + f * sy + g * ty, pz + f * sz + g * tz


@njit(fastmath=FASTMATH, inline="always")
def _move(points, velocities, inverse_dt, atoms, at, k, ax, ay, az, f, g, sx, sy, sz, tx, ty, tz, move, undo, saved):
    """Move corner k of each triangle from a by f s + g t, and change its velocity."""
    corner = at + k * WIDTH
    x, y, z = f * sx + g * tx, f * sy + g * ty, f * sz + g * tz
    scatter_points(points, atoms, corner, ax + x, ay + y, az + z)
    if move:
        ax, ay, az = keep_points(velocities, atoms, corner, undo, saved + (3 + k) * SAVED)
        x, y, z = ax + x * inverse_dt, ay + y * inverse_dt, az + z * inverse_dt
        scatter_points(velocities, atoms, corner, x, y, z)


@njit(fastmath=FASTMATH, inline="always")
def _report(multipliers, slots, place, sign, m0, m1, m2, sx, sy, sz, tx, ty, tz):
    """Multipliers of unit gradients."""
    ux, uy, uz = tx - sx, ty - sy, tz - sz
    m0 = sign * m0 * square_root(dot(sx, sy, sz, sx, sy, sz))
    m1 = sign * m1 * square_root(dot(tx, ty, tz, tx, ty, tz))
    m2 = sign * m2 * square_root(dot(ux, uy, uz, ux, uy, uz))
    scatter_points(multipliers, slots, place, m0, m1, m2)


@njit(cache=True, fastmath=FASTMATH)
def _project(tangent, points, references, velocities, inverse_dt, given, lattice, kind, tables, multipliers):
    """Project one group of eight triangles after another; `distance_clusters` says what the arguments are."""
    t, h, u = tables, integers(tables), halves(tables)
    atoms, slots = table_array(u, h, 0), table_array(u, h, 1)
    inv_mass, undo = table_array(t, h, 2), table_array(t, h, _UNDO)
    move, report, driven = tangent is None and inverse_dt != 0.0, multipliers.shape[0] > 0, given.shape[0] > 0
    n_groups, cell = slots.shape[0] // WIDTH, lattice_numbers(lattice)
    # Arrays that are handed on inside the loop would cost reference counting.
    changed, moving, table, room = at_first(points), at_first(velocities), at_first(atoms), at_first(undo)
    w0, w1, w2 = inv_mass[0], inv_mass[1], inv_mass[2]
    w01, w02, w12 = w0 + w1, w0 + w2, w1 + w2
    errors, sizes, worst, worst_at, most = np.empty(3 * WIDTH), np.empty(3 * WIDTH), 0.0, -1, 0
    # Points kept of a triangle, what residuals are counted in, and the sign of multipliers.
    kept_points, unit, sign = (2 * _CORNERS, 2.0, 1.0) if tangent is None else (_CORNERS, 1.0, -1.0)
    for group in range(n_groups):
        at, saved = group * 3 * WIDTH, kept_points * group * SAVED
        # Reference bonds s, t; present bonds p, q; from atom 0 to 1 and to 2.
        sx, sy, sz = gather_differences(references, atoms, at, at + WIDTH)
        tx, ty, tz = gather_differences(references, atoms, at, at + 2 * WIDTH)
        ax, ay, az = keep_points(points, atoms, at, undo, saved)
        bx, by, bz = keep_points(points, atoms, at + WIDTH, undo, saved + SAVED)
        cx, cy, cz = keep_points(points, atoms, at + 2 * WIDTH, undo, saved + 2 * SAVED)
        px, py, pz = ax - bx, ay - by, az - bz
        qx, qy, qz = ax - cx, ay - cy, az - cz
        if kind != OPEN:
            sx, sy, sz = minimum_image(sx, sy, sz, cell, kind)
            tx, ty, tz = minimum_image(tx, ty, tz, cell, kind)
            if tangent is None:
                px, py, pz = minimum_image(px, py, pz, cell, kind)
                qx, qy, qz = minimum_image(qx, qy, qz, cell, kind)
        m0 = m1 = m2 = r0 = r1 = r2 = c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = scale = splat(0.0)
        # l: what the errors of the three rows are compared with.
        if tangent is None:
            l0, l1, l2 = gather_points(given, slots, group * WIDTH)
            l0, l1, l2 = l0 * l0, l1 * l1, l2 * l2
        else:
            l0, l1, l2 = _products(sx, sy, sz, tx, ty, tz, sx, sy, sz, tx, ty, tz)
            st = dot(sx, sy, sz, tx, ty, tz)
            size = dot(px, py, pz, px, py, pz) + dot(qx, qy, qz, qx, qy, qz)
            if driven:
                r0, r1, r2 = gather_points(given, slots, group * WIDTH)
                size = size + (r0 * r0 + r1 * r1 + r2 * r2)
                r0, r1, r2 = r0 * square_root(l0), r1 * square_root(l1), r2 * square_root(l2)
            size = size * (SPEED_TOLERANCE * SPEED_TOLERANCE)
            factor = _tangent_factor(l0, l1, l2, st, w0, w1, w2, w01, w02, w12)
            c00, c01, c02, c10, c11, c12, c20, c21, c22, scale = factor
        iteration, ok = 0, False
        while True:
            if tangent is None:
                e0, e1, e2 = _length_errors(l0, l1, l2, px, py, pz, qx, qy, qz)
                if iteration >= 3:
                    ok = _small(absolute(e0), absolute(e1), absolute(e2), l0, l1, l2, 2.0 * NEWTON_TOLERANCE)
                    if ok or iteration == MAX_ITERATIONS:
                        break
                # A factor serves two steps: Newton, then chord; order three for both.
                if iteration % 2 == 0:
                    factor = _position_factor(px, py, pz, qx, qy, qz, sx, sy, sz, tx, ty, tz, w0, w1, w2, w01, w02, w12)
                    c00, c01, c02, c10, c11, c12, c20, c21, c22, scale = factor
            else:
                ps, qt, us = _products(px, py, pz, qx, qy, qz, sx, sy, sz, tx, ty, tz)
                e0, e1, e2 = r0 - ps, r1 - qt, r2 - us
                if iteration > 0:
                    ok = _small(e0 * e0, e1 * e1, e2 * e2, l0, l1, l2, size)
                    if ok or iteration == MAX_ITERATIONS:
                        break
            d0, d1, d2 = _product(c00, c01, c02, c10, c11, c12, c20, c21, c22, e0 * scale, e1 * scale, e2 * scale)
            m0, m1, m2 = m0 + d0, m1 + d1, m2 + d2
            px, py, pz = _pulled(px, py, pz, w01 * d0 + w1 * d2, w0 * d1 - w1 * d2, sx, sy, sz, tx, ty, tz)
            qx, qy, qz = _pulled(qx, qy, qz, w0 * d0 - w2 * d2, w02 * d1 + w2 * d2, sx, sy, sz, tx, ty, tz)
            iteration += 1
        if tangent is None:
            # A bond that turned round has found the wrong root.
            ps, qt, us = _products(px, py, pz, qx, qy, qz, sx, sy, sz, tx, ty, tz)
            e0, e1, e2 = absolute(e0), absolute(e1), absolute(e2)
        else:
            ps, qt, us, e0, e1, e2 = l0, l1, l2, e0 * e0, e1 * e1, e2 * e2
        most, kept = max(most, iteration), all_within(TINY, ps) and all_within(TINY, qt) and all_within(TINY, us)
        if not (ok and kept and _small(e0, e1, e2, l0, l1, l2, unit * worst)):
            store_triple(errors, 0, e0, e1, e2)
            store_triple(sizes, 0, unit * l0, unit * l1, unit * l2)
            if ok and not kept:
                store_triple(errors, 0, not_positive(ps), not_positive(qt), not_positive(us))
                store_triple(sizes, 0, splat(1.0), splat(1.0), splat(1.0))
            worst, worst_at = worst_row(errors, sizes, 3, slots, group * WIDTH)
            if not (ok and kept):
                restore_points(points, atoms, undo, group, _CORNERS, kept_points, _NONE)
                if move:
                    restore_points(velocities, atoms, undo, group, _CORNERS, kept_points, _CORNERS)
                return False, worst if tangent is None else np.sqrt(worst), most, worst_at
        f0, g0, f1, g1, f2, g2 = w0 * m0, w0 * m1, -w1 * (m0 + m2), w1 * m2, w2 * m2, -w2 * (m1 + m2)
        _move(changed, moving, inverse_dt, table, at, 0, ax, ay, az, f0, g0, sx, sy, sz, tx, ty, tz, move, room, saved)
        _move(changed, moving, inverse_dt, table, at, 1, bx, by, bz, f1, g1, sx, sy, sz, tx, ty, tz, move, room, saved)
        _move(changed, moving, inverse_dt, table, at, 2, cx, cy, cz, f2, g2, sx, sy, sz, tx, ty, tz, move, room, saved)
        if report:
            _report(at_first(multipliers), at_first(slots), group * WIDTH, sign, m0, m1, m2, sx, sy, sz, tx, ty, tz)
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
        self.tables = in_one_array((corners, slots, *given, room(6 * len(corners))))
