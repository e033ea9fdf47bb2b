"""Rigid triangles: three held distances between three atoms, eight at a time.

The displacements that hold a triangle lie in the plane of its reference
shape, spanned by ``s01`` and ``s02``. Two bond vectors describe the triangle
(the third is their difference), so a Newton step is four scalar products, a
3-by-3 solve and four updates.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from kcons.solvers.distance_clusters import EightAtATime
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
from kcons.solvers.kernels.groups_of_eight import (
    MAX_ITERATIONS,
    OPEN,
    POSITION_TOLERANCE,
    SAVED,
    TANGENT_TOLERANCE,
    TINY,
    dot,
    lane_tables,
    lattice_numbers,
    minimum_image,
    restore_points,
    worst_row,
)

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Order of the three rows of a triangle, in local atoms."""


@njit(cache=True, fastmath=FASTMATH)
def project_triangles(
    points, references, velocities, inverse_dt, tangent, atoms, slots, inv_mass, given, lattice, kind, multipliers, undo
):
    """Project one group of eight triangles after another.

    `tangent` is None where `points` are positions, to be brought to the lengths `given`, and anything else where
    they are velocities, to be brought to these rates: a kernel is compiled for each.
    """
    move, report, driven = velocities.shape[0] > 0, multipliers.shape[0] > 0, given.shape[0] > 0
    w0, w1, w2 = inv_mass[0], inv_mass[1], inv_mass[2]
    w01, w02, w12 = w0 + w1, w0 + w2, w1 + w2
    cell = lattice_numbers(lattice)
    errors, sizes = np.empty(3 * WIDTH), np.empty(3 * WIDTH)
    worst, worst_at, most = 0.0, -1, 0
    # Points kept of a triangle, and what residuals are counted in.
    kept_points, unit = (6, 2.0) if tangent is None else (3, 1.0)
    for group in range(slots.shape[0] // WIDTH):
        at = group * 3 * WIDTH
        bt, ct = at + WIDTH, at + 2 * WIDTH
        # Reference bonds s, t; present bonds p, q; from atom 0 to 1 and to 2.
        sx, sy, sz = gather_differences(references, atoms, at, bt)
        tx, ty, tz = gather_differences(references, atoms, at, ct)
        saved = kept_points * group * SAVED
        ax, ay, az = keep_points(points, atoms, at, undo, saved)
        bx, by, bz = keep_points(points, atoms, bt, undo, saved + SAVED)
        cx, cy, cz = keep_points(points, atoms, ct, undo, saved + 2 * SAVED)
        px, py, pz = ax - bx, ay - by, az - bz
        qx, qy, qz = ax - cx, ay - cy, az - cz
        if kind != OPEN:
            sx, sy, sz = minimum_image(sx, sy, sz, cell, kind)
            tx, ty, tz = minimum_image(tx, ty, tz, cell, kind)
            if tangent is None:
                px, py, pz = minimum_image(px, py, pz, cell, kind)
                qx, qy, qz = minimum_image(qx, qy, qz, cell, kind)
        m0 = m1 = m2 = r0 = r1 = r2 = splat(0.0)
        c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = scale = m0
        # l: what the errors of the three rows are compared with.
        if tangent is None:
            l0, l1, l2 = gather_points(given, slots, group * WIDTH)
            l0, l1, l2 = l0 * l0, l1 * l1, l2 * l2
        else:
            vx, vy, vz = tx - sx, ty - sy, tz - sz
            l0, st = dot(sx, sy, sz, sx, sy, sz), dot(sx, sy, sz, tx, ty, tz)
            l1, l2 = dot(tx, ty, tz, tx, ty, tz), dot(vx, vy, vz, vx, vy, vz)
            size = dot(px, py, pz, px, py, pz) + dot(qx, qy, qz, qx, qy, qz)
            if driven:
                r0, r1, r2 = gather_points(given, slots, group * WIDTH)
                size = size + (r0 * r0 + r1 * r1 + r2 * r2)
                r0, r1, r2 = r0 * square_root(l0), r1 * square_root(l1), r2 * square_root(l2)
            size = size * (TANGENT_TOLERANCE * TANGENT_TOLERANCE)
            a00, a01, a02 = w01 * l0, w0 * st, w1 * (l0 - st)
            a11, a12, a22 = w02 * l1, w2 * (l1 - st), w12 * l2
            c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
            c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
            c10, c20, c21 = c01, c02, c12
            scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
        iteration = 0
        ok = False
        while True:
            ux, uy, uz = qx - px, qy - py, qz - pz
            if tangent is None:
                e0 = l0 - dot(px, py, pz, px, py, pz)
                e1 = l1 - dot(qx, qy, qz, qx, qy, qz)
                e2 = l2 - dot(ux, uy, uz, ux, uy, uz)
                if iteration >= 3:
                    ok = (
                        all_within(absolute(e0), l0 * (2.0 * POSITION_TOLERANCE))
                        and all_within(absolute(e1), l1 * (2.0 * POSITION_TOLERANCE))
                        and all_within(absolute(e2), l2 * (2.0 * POSITION_TOLERANCE))
                    )
                    if ok or iteration == MAX_ITERATIONS:
                        break
                # A factor serves two steps: Newton, then chord; order three for both.
                if iteration % 2 == 0:
                    ps, pt = dot(px, py, pz, sx, sy, sz), dot(px, py, pz, tx, ty, tz)
                    qs, qt = dot(qx, qy, qz, sx, sy, sz), dot(qx, qy, qz, tx, ty, tz)
                    us, ut = qs - ps, qt - pt
                    a00, a01, a02 = w01 * ps, w0 * pt, w1 * (ps - pt)
                    a10, a11, a12 = w0 * qs, w02 * qt, w2 * (qt - qs)
                    a20, a21, a22 = w1 * us, w2 * ut, w12 * (ut - us)
                    c00, c01, c02 = a11 * a22 - a12 * a21, a02 * a21 - a01 * a22, a01 * a12 - a02 * a11
                    c10, c11, c12 = -(a12 * a20 + a10 * a22), a00 * a22 + a02 * a20, a02 * a10 - a00 * a12
                    c20, c21, c22 = a10 * a21 + a11 * a20, -(a01 * a20 + a00 * a21), a00 * a11 - a01 * a10
                    scale = 0.5 / (a00 * c00 + a01 * c10 + a02 * c20)
            else:
                e0, e1 = r0 - dot(px, py, pz, sx, sy, sz), r1 - dot(qx, qy, qz, tx, ty, tz)
                e2 = r2 - dot(ux, uy, uz, vx, vy, vz)
                if iteration > 0:
                    ok = (
                        all_within(e0 * e0, size * l0)
                        and all_within(e1 * e1, size * l1)
                        and all_within(e2 * e2, size * l2)
                    )
                    if ok or iteration == MAX_ITERATIONS:
                        break
            f0, f1, f2 = e0 * scale, e1 * scale, e2 * scale
            d0 = c00 * f0 + c01 * f1 + c02 * f2
            d1 = c10 * f0 + c11 * f1 + c12 * f2
            d2 = c20 * f0 + c21 * f1 + c22 * f2
            m0, m1, m2 = m0 + d0, m1 + d1, m2 + d2
            f, g = w01 * d0 + w1 * d2, w0 * d1 - w1 * d2
            px, py, pz = px + f * sx + g * tx, py + f * sy + g * ty, pz + f * sz + g * tz
            f, g = w0 * d0 - w2 * d2, w02 * d1 + w2 * d2
            qx, qy, qz = qx + f * sx + g * tx, qy + f * sy + g * ty, qz + f * sz + g * tz
            iteration += 1
        if tangent is None:
            # A bond that turned round has found the wrong root.
            ps, qt = dot(px, py, pz, sx, sy, sz), dot(qx, qy, qz, tx, ty, tz)
            us = dot(ux, uy, uz, tx - sx, ty - sy, tz - sz)
            e0, e1, e2 = absolute(e0), absolute(e1), absolute(e2)
        else:
            ps, qt, us = l0, l1, l2
            e0, e1, e2 = e0 * e0, e1 * e1, e2 * e2
        kept = all_within(TINY, ps) and all_within(TINY, qt) and all_within(TINY, us)
        most = max(most, iteration)
        bound = unit * worst
        if not (
            ok and kept and all_within(e0, l0 * bound) and all_within(e1, l1 * bound) and all_within(e2, l2 * bound)
        ):
            store_triple(errors, 0, e0, e1, e2)
            store_triple(sizes, 0, unit * l0, unit * l1, unit * l2)
            if ok and not kept:
                store_triple(errors, 0, not_positive(ps), not_positive(qt), not_positive(us))
                store_triple(sizes, 0, splat(1.0), splat(1.0), splat(1.0))
            worst, worst_at = worst_row(errors, sizes, 3)
            worst_at += group * 3 * WIDTH
            if not (ok and kept):
                restore_points(points, atoms, undo, group, 3, kept_points, 0)
                if move:
                    restore_points(velocities, atoms, undo, group, 3, kept_points, 3)
                return False, worst if tangent is None else np.sqrt(worst), most, worst_at
        f, g = w0 * m0, w0 * m1
        x, y, z = f * sx + g * tx, f * sy + g * ty, f * sz + g * tz
        scatter_points(points, atoms, at, ax + x, ay + y, az + z)
        if tangent is None and move:
            ax, ay, az = keep_points(velocities, atoms, at, undo, saved + 3 * SAVED)
            x, y, z = ax + x * inverse_dt, ay + y * inverse_dt, az + z * inverse_dt
            scatter_points(velocities, atoms, at, x, y, z)
        f, g = -w1 * (m0 + m2), w1 * m2
        x, y, z = f * sx + g * tx, f * sy + g * ty, f * sz + g * tz
        scatter_points(points, atoms, bt, bx + x, by + y, bz + z)
        if tangent is None and move:
            bx, by, bz = keep_points(velocities, atoms, bt, undo, saved + 4 * SAVED)
            x, y, z = bx + x * inverse_dt, by + y * inverse_dt, bz + z * inverse_dt
            scatter_points(velocities, atoms, bt, x, y, z)
        f, g = w2 * m2, -w2 * (m1 + m2)
        x, y, z = f * sx + g * tx, f * sy + g * ty, f * sz + g * tz
        scatter_points(points, atoms, ct, cx + x, cy + y, cz + z)
        if tangent is None and move:
            cx, cy, cz = keep_points(velocities, atoms, ct, undo, saved + 5 * SAVED)
            x, y, z = cx + x * inverse_dt, cy + y * inverse_dt, cz + z * inverse_dt
            scatter_points(velocities, atoms, ct, x, y, z)
        if report:
            ux, uy, uz = tx - sx, ty - sy, tz - sz
            if tangent is not None:
                m0, m1, m2 = -m0, -m1, -m2
            scatter_points(
                multipliers, slots, group * WIDTH,
                m0 * square_root(dot(sx, sy, sz, sx, sy, sz)),
                m1 * square_root(dot(tx, ty, tz, tx, ty, tz)),
                m2 * square_root(dot(ux, uy, uz, ux, uy, uz)),
            )  # fmt: skip
    return True, worst if tangent is None else np.sqrt(worst), most, worst_at


class RigidTriangles(EightAtATime):
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

    name = "water"
    _kernel = staticmethod(project_triangles)

    def __init__(self, rows: ArrayLike, atoms: ArrayLike, lengths: ArrayLike, inv_mass: ArrayLike) -> None:
        super().__init__(rows, lengths, 3)
        slots, corners = lane_tables(np.asarray(atoms).reshape(-1, 3), 3)
        self._tables = corners, slots, np.array(inv_mass, dtype=np.float64)
        self._sizes = (6 * len(corners),)

    def tables(self) -> tuple[NDArray[Any], ...]:
        """What kernels that call `project_triangles` need.

        Returns
        -------
        tuple of ndarray
            Atoms, slots, lengths, inverse masses, flat; and the room to undo in, of which only the size counts.
        """
        atoms, slots, inv_mass = self._tables
        return atoms, slots, self.lengths, inv_mass, np.broadcast_to(0.0, self._sizes)
