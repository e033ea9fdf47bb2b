"""Values and gradients of compiled rows: distances, angles, dihedrals, linear rows, spheres, cylinders.

Scalar code for one row at a time. Positions are held as ``base + moves`` so that differences of atoms that
lie far from the origin keep their digits while moves are small.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from kcons.constraints.constraint import RowKind
from kcons.solvers.elimination import FAST
from kcons.solvers.lattice import nearest_image

DISTANCE = int(RowKind.DISTANCE)
ANGLE = int(RowKind.ANGLE)
DIHEDRAL = int(RowKind.DIHEDRAL)
LINEAR = int(RowKind.LINEAR)
SPHERE = int(RowKind.SPHERE)
CYLINDER = int(RowKind.CYLINDER)
#: Parameters of a row: up to four atoms with three coefficients each.
PARAMETERS = 12


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _difference(i, j, base, moves, lattice, periodic):  # type: ignore[no-untyped-def]
    x = base[4 * i] - base[4 * j]
    y = base[4 * i + 1] - base[4 * j + 1]
    z = base[4 * i + 2] - base[4 * j + 2]
    if periodic:
        x, y, z = nearest_image(x, y, z, lattice)
    return (
        x + (moves[4 * i] - moves[4 * j]),
        y + (moves[4 * i + 1] - moves[4 * j + 1]),
        z + (moves[4 * i + 2] - moves[4 * j + 2]),
    )


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _put(gradient, slot, x, y, z):  # type: ignore[no-untyped-def]
    gradient[3 * slot] = x
    gradient[3 * slot + 1] = y
    gradient[3 * slot + 2] = z


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def value_and_gradient(kind, slot, slot_atoms, parameters, base, moves, lattice, periodic, gradient):  # type: ignore[no-untyped-def]
    """Natural coordinate of one row; writes its gradient into `gradient` from slot `slot` on.

    Angles: dtheta/dr_i = u x (u x w) / (u^2 |u x w|). Dihedrals: Blondel & Karplus,
    J. Comput. Chem. 17, 1132 (1996).
    """
    if kind == DISTANCE:
        x, y, z = _difference(slot_atoms[slot], slot_atoms[slot + 1], base, moves, lattice, periodic)
        length = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        _put(gradient, slot, x, y, z)
        _put(gradient, slot + 1, -x, -y, -z)
        return length
    if kind == ANGLE:
        j = slot_atoms[slot + 1]
        ux, uy, uz = _difference(slot_atoms[slot], j, base, moves, lattice, periodic)
        wx, wy, wz = _difference(slot_atoms[slot + 2], j, base, moves, lattice, periodic)
        cx, cy, cz = _cross(ux, uy, uz, wx, wy, wz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        fu = 1.0 / ((ux * ux + uy * uy + uz * uz) * c)
        fw = 1.0 / ((wx * wx + wy * wy + wz * wz) * c)
        ax, ay, az = _cross(ux, uy, uz, cx, cy, cz)
        bx, by, bz = _cross(cx, cy, cz, wx, wy, wz)
        ax, ay, az = fu * ax, fu * ay, fu * az
        bx, by, bz = fw * bx, fw * by, fw * bz
        _put(gradient, slot, ax, ay, az)
        _put(gradient, slot + 1, -(ax + bx), -(ay + by), -(az + bz))
        _put(gradient, slot + 2, bx, by, bz)
        return math.atan2(c, ux * wx + uy * wy + uz * wz)
    if kind == DIHEDRAL:
        j, k = slot_atoms[slot + 1], slot_atoms[slot + 2]
        fx, fy, fz = _difference(slot_atoms[slot], j, base, moves, lattice, periodic)
        gx, gy, gz = _difference(j, k, base, moves, lattice, periodic)
        hx, hy, hz = _difference(slot_atoms[slot + 3], k, base, moves, lattice, periodic)
        ax, ay, az = _cross(fx, fy, fz, gx, gy, gz)
        bx, by, bz = _cross(hx, hy, hz, gx, gy, gz)
        g = math.sqrt(gx * gx + gy * gy + gz * gz)
        a2 = ax * ax + ay * ay + az * az
        b2 = bx * bx + by * by + bz * bz
        sx, sy, sz = _cross(bx, by, bz, ax, ay, az)
        value = math.atan2((sx * gx + sy * gy + sz * gz) / g, ax * bx + ay * by + az * bz)
        ga, gb = g / a2, g / b2
        fa = (fx * gx + fy * gy + fz * gz) / (a2 * g)
        hb = (hx * gx + hy * gy + hz * gz) / (b2 * g)
        _put(gradient, slot, -ga * ax, -ga * ay, -ga * az)
        tx, ty, tz = fa * ax - hb * bx, fa * ay - hb * by, fa * az - hb * bz
        _put(gradient, slot + 1, ga * ax + tx, ga * ay + ty, ga * az + tz)
        _put(gradient, slot + 2, -tx - gb * bx, -ty - gb * by, -tz - gb * bz)
        _put(gradient, slot + 3, gb * bx, gb * by, gb * bz)
        return value
    i = slot_atoms[slot]
    x = base[4 * i] + moves[4 * i]
    y = base[4 * i + 1] + moves[4 * i + 1]
    z = base[4 * i + 2] + moves[4 * i + 2]
    if kind == SPHERE:
        x, y, z = x - parameters[0], y - parameters[1], z - parameters[2]
        length = math.sqrt(x * x + y * y + z * z)
        _put(gradient, slot, x / length, y / length, z / length)
        return length
    # Cylinder: distance from the axis through the point with the unit direction n.
    nx, ny, nz = parameters[3], parameters[4], parameters[5]
    x, y, z = x - parameters[0], y - parameters[1], z - parameters[2]
    along = x * nx + y * ny + z * nz
    x, y, z = x - along * nx, y - along * ny, z - along * nz
    length = math.sqrt(x * x + y * y + z * z)
    _put(gradient, slot, x / length, y / length, z / length)
    return length


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def linear_value(slot, end, slot_atoms, parameters, base, moves, gradient):  # type: ignore[no-untyped-def]
    """sum c . r of a linear row; small moves and large positions are summed apart."""
    whole, change = 0.0, 0.0
    for p in range(slot, end):
        a = slot_atoms[p]
        for axis in range(3):
            c = parameters[3 * (p - slot) + axis]
            gradient[3 * p + axis] = c
            whole += c * base[4 * a + axis]
            change += c * moves[4 * a + axis]
    return whole + change


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def evaluate(  # type: ignore[no-untyped-def]
    first, last, kinds, slots, slot_atoms, parameters, base, moves, lattice, periodic, values, gradient
):
    """Values and gradients of rows first to last."""
    for k in range(first, last):
        if kinds[k] == LINEAR:
            values[k] = linear_value(
                slots[k], slots[k + 1], slot_atoms, parameters[PARAMETERS * k :], base, moves, gradient
            )
        else:
            values[k] = value_and_gradient(
                kinds[k], slots[k], slot_atoms, parameters[PARAMETERS * k :], base, moves, lattice, periodic, gradient
            )


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def miss(kind, value, target):  # type: ignore[no-untyped-def]
    """target - value, for dihedrals by the shorter way round."""
    difference = target - value
    if kind == DIHEDRAL:
        difference -= 2 * np.pi * np.rint(difference / (2 * np.pi))
    return difference
