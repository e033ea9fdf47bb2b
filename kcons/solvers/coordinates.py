"""Values and gradients of compiled rows: distances, angles, dihedrals, linear rows, spheres, cylinders.

Scalar code for one row at a time. Positions are held as ``base + moves`` so that differences of atoms that
lie far from the origin keep their digits while moves are small; both as quads (x, y, z, any) by atom.

A gradient is stored by slot (one atom of one row). The line of a slot holds two gradients number by number,
now and at the reference, then the atom's inverse mass: n0 r0 n1 r1 n2 r2 w -.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from kcons.constraints.constraint import RowKind
from kcons.solvers.elimination import FAST
from kcons.solvers.lattice import nearest_image
from kcons.solvers.narrow import dot, entry, lane, load_quad, number, put, quad

DISTANCE = int(RowKind.DISTANCE)
ANGLE = int(RowKind.ANGLE)
DIHEDRAL = int(RowKind.DIHEDRAL)
LINEAR = int(RowKind.LINEAR)
SPHERE = int(RowKind.SPHERE)
CYLINDER = int(RowKind.CYLINDER)
#: Parameters of a row: up to four atoms with three coefficients each.
PARAMETERS = 12


#: Which of the two gradients in a slot's line.
NOW, REFERENCE = 0, 1


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _difference(i, j, base, moves, lattice, periodic):  # type: ignore[no-untyped-def]
    d = load_quad(base, 4 * i) - load_quad(base, 4 * j)
    if periodic:
        x, y, z = nearest_image(lane(d, 0), lane(d, 1), lane(d, 2), lattice)
        d = quad(x, y, z, 0.0)
    d = d + (load_quad(moves, 4 * i) - load_quad(moves, 4 * j))
    return lane(d, 0), lane(d, 1), lane(d, 2)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _put(lines, place, x, y, z):  # type: ignore[no-untyped-def]
    put(lines, place, x)
    put(lines, place + 2, y)
    put(lines, place + 4, z)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def value_and_gradient(kind, slot, slot_atoms, parameters, offset, base, moves, lattice, periodic, lines, which):  # type: ignore[no-untyped-def]
    """Natural coordinate of a row that is neither a distance nor linear; writes its gradient into the lines.

    `offset` is where the row's parameters begin. Angles: dtheta/dr_i = u x (u x w) / (u^2 |u x w|).
    Dihedrals: Blondel & Karplus, J. Comput. Chem. 17, 1132 (1996).
    """
    place = 8 * slot + which
    if kind == ANGLE:
        j = entry(slot_atoms, slot + 1)
        ux, uy, uz = _difference(entry(slot_atoms, slot), j, base, moves, lattice, periodic)
        wx, wy, wz = _difference(entry(slot_atoms, slot + 2), j, base, moves, lattice, periodic)
        cx, cy, cz = _cross(ux, uy, uz, wx, wy, wz)
        c = math.sqrt(cx * cx + cy * cy + cz * cz)
        fu = 1.0 / ((ux * ux + uy * uy + uz * uz) * c)
        fw = 1.0 / ((wx * wx + wy * wy + wz * wz) * c)
        ax, ay, az = _cross(ux, uy, uz, cx, cy, cz)
        bx, by, bz = _cross(cx, cy, cz, wx, wy, wz)
        ax, ay, az = fu * ax, fu * ay, fu * az
        bx, by, bz = fw * bx, fw * by, fw * bz
        _put(lines, place, ax, ay, az)
        _put(lines, place + 8, -(ax + bx), -(ay + by), -(az + bz))
        _put(lines, place + 16, bx, by, bz)
        return math.atan2(c, ux * wx + uy * wy + uz * wz)
    if kind == DIHEDRAL:
        j, k = entry(slot_atoms, slot + 1), entry(slot_atoms, slot + 2)
        fx, fy, fz = _difference(entry(slot_atoms, slot), j, base, moves, lattice, periodic)
        gx, gy, gz = _difference(j, k, base, moves, lattice, periodic)
        hx, hy, hz = _difference(entry(slot_atoms, slot + 3), k, base, moves, lattice, periodic)
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
        _put(lines, place, -ga * ax, -ga * ay, -ga * az)
        tx, ty, tz = fa * ax - hb * bx, fa * ay - hb * by, fa * az - hb * bz
        _put(lines, place + 8, ga * ax + tx, ga * ay + ty, ga * az + tz)
        _put(lines, place + 16, -tx - gb * bx, -ty - gb * by, -tz - gb * bz)
        _put(lines, place + 24, gb * bx, gb * by, gb * bz)
        return value
    i = entry(slot_atoms, slot)
    r = load_quad(base, 4 * i) + load_quad(moves, 4 * i)
    cx, cy, cz = number(parameters, offset), number(parameters, offset + 1), number(parameters, offset + 2)
    x, y, z = lane(r, 0) - cx, lane(r, 1) - cy, lane(r, 2) - cz
    if kind == SPHERE:
        length = math.sqrt(x * x + y * y + z * z)
        _put(lines, place, x / length, y / length, z / length)
        return length
    # Cylinder: distance from the axis through the point with the unit direction n.
    nx, ny, nz = number(parameters, offset + 3), number(parameters, offset + 4), number(parameters, offset + 5)
    along = x * nx + y * ny + z * nz
    x, y, z = x - along * nx, y - along * ny, z - along * nz
    length = math.sqrt(x * x + y * y + z * z)
    _put(lines, place, x / length, y / length, z / length)
    return length


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def linear_value(slot, end, slot_atoms, parameters, offset, base, moves, lines, which):  # type: ignore[no-untyped-def]
    """sum c . r of a linear row; small moves and large positions are summed apart."""
    whole, change = 0.0, 0.0
    for p in range(slot, end):
        a = 4 * entry(slot_atoms, p)
        at = offset + 3 * (p - slot)
        c = quad(number(parameters, at), number(parameters, at + 1), number(parameters, at + 2), 0.0)
        _put(lines, 8 * p + which, lane(c, 0), lane(c, 1), lane(c, 2))
        whole += dot(c, load_quad(base, a))
        change += dot(c, load_quad(moves, a))
    return whole + change


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def evaluate(  # type: ignore[no-untyped-def]
    first, last, kinds, links, slot_atoms, parameters, base, moves, lattice, periodic, values, lines, which
):
    """Values and gradients of rows first to last; ``links[4 k + 2]`` is the first slot of row k."""
    for k in range(first, last):
        kind = entry(kinds, k)
        slot = entry(links, 4 * k + 2)
        if kind == DISTANCE:
            i, j = entry(slot_atoms, slot), entry(slot_atoms, slot + 1)
            x, y, z = _difference(i, j, base, moves, lattice, periodic)
            length = math.sqrt(x * x + y * y + z * z)
            inverse = 1.0 / length
            x, y, z = inverse * x, inverse * y, inverse * z
            _put(lines, 8 * slot + which, x, y, z)
            _put(lines, 8 * slot + 8 + which, -x, -y, -z)
            put(values, k, length)
        elif kind == LINEAR:
            end = entry(links, 4 * k + 6)
            put(values, k, linear_value(slot, end, slot_atoms, parameters, PARAMETERS * k, base, moves, lines, which))
        else:
            value = value_and_gradient(
                kind, slot, slot_atoms, parameters, PARAMETERS * k, base, moves, lattice, periodic, lines, which
            )
            put(values, k, value)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def miss(kind, value, target):  # type: ignore[no-untyped-def]
    """target - value, for dihedrals by the shorter way round."""
    difference = target - value
    if kind == DIHEDRAL:
        difference -= 2 * np.pi * np.rint(difference / (2 * np.pi))
    return difference
