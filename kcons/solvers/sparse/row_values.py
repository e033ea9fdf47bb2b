"""Values and gradients of compiled rows: distances, angles, linear rows, functions, rows of velocities.

Scalar code for one row at a time. Positions are held as ``base + moves`` so that differences of atoms that
lie far from the origin keep their digits while moves are small; both as quads (x, y, z, any) by atom.

A gradient is stored by slot (one atom of one row). The line of a slot holds two gradients number by number,
now and at the reference, then the atom's inverse mass: n0 r0 n1 r1 n2 r2 w -.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import RowKind
from kcons.constraints.internal import angle_between
from kcons.solvers.called_solvers import address_of, caller_of
from kcons.solvers.kernels.array_views import INDICES, NUMBERS
from kcons.solvers.kernels.two_and_four_wide import (
    dot,
    entry,
    first_vector,
    lane,
    load_quad,
    number,
    put,
    quad,
    rolled,
    second_vector,
)
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.sparse.row_functions import COUNT, FUNCTION, ROOM, VELOCITY, call_row
from kcons.solvers.tolerances import FLAT

DISTANCE = int(RowKind.DISTANCE)
ANGLE = int(RowKind.ANGLE)
LINEAR = int(RowKind.LINEAR)

_PLACE, _CELL = types.int64, (types.float64[:, :, ::1], types.boolean)
# `evaluate` is called by address: it is compiled once, and not into each of its callers. So are functions: where there
# are none, nothing is compiled for them.
_EVALUATE = types.none(*(3 * (_PLACE,)), *(3 * (INDICES,)), *(5 * (NUMBERS,)), *_CELL, NUMBERS, NUMBERS, _PLACE)
_FUNCTION = types.float64(*(3 * (_PLACE,)), INDICES, NUMBERS, _PLACE, *(4 * (NUMBERS,)), *_CELL, NUMBERS, _PLACE)
call_evaluate, _call_function = caller_of(_EVALUATE), caller_of(_FUNCTION)

#: Which of the two gradients in a slot's line: as numbers of NumPy, for which `evaluate` is compiled once.
NOW, REFERENCE = np.int64(0), np.int64(1)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _difference(i, j, base, moves, cell, inverse, periodic):  # type: ignore[no-untyped-def]
    """Vector from atom j to atom i, as three numbers."""
    return near(
        load_quad(base, 4 * i) - load_quad(base, 4 * j),
        load_quad(moves, 4 * i) - load_quad(moves, 4 * j),
        cell, inverse, periodic,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def cell_of(lattice):  # type: ignore[no-untyped-def]
    """A cell and its inverse as tuples, as `near` takes them."""
    cell = (
        (lattice[0, 0, 0], lattice[0, 0, 1], lattice[0, 0, 2]),
        (lattice[0, 1, 0], lattice[0, 1, 1], lattice[0, 1, 2]),
        (lattice[0, 2, 0], lattice[0, 2, 1], lattice[0, 2, 2]),
    )
    inverse = (
        (lattice[1, 0, 0], lattice[1, 0, 1], lattice[1, 0, 2]),
        (lattice[1, 1, 0], lattice[1, 1, 1], lattice[1, 1, 2]),
        (lattice[1, 2, 0], lattice[1, 2, 1], lattice[1, 2, 2]),
    )
    return cell, inverse


@njit(cache=True, fastmath=FAST, error_model="numpy")
def near(whole, change, cell, inverse, periodic):  # type: ignore[no-untyped-def]
    # No arrays come here: one that passes a branch costs reference counting.
    x, y, z = lane(whole, 0), lane(whole, 1), lane(whole, 2)
    if periodic:
        a = np.rint(x * inverse[0][0] + y * inverse[1][0] + z * inverse[2][0])
        b = np.rint(x * inverse[0][1] + y * inverse[1][1] + z * inverse[2][1])
        c = np.rint(x * inverse[0][2] + y * inverse[1][2] + z * inverse[2][2])
        x -= a * cell[0][0] + b * cell[1][0] + c * cell[2][0]
        y -= a * cell[0][1] + b * cell[1][1] + c * cell[2][1]
        z -= a * cell[0][2] + b * cell[1][2] + c * cell[2][2]
    return x + lane(change, 0), y + lane(change, 1), z + lane(change, 2)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _put(lines, place, x, y, z):  # type: ignore[no-untyped-def]
    put(lines, place, x)
    put(lines, place + 2, y)
    put(lines, place + 4, z)


_angle = njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")(angle_between)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _function(  # type: ignore[no-untyped-def]
    kind, slot, end, slot_atoms, parameters, offset, base, moves, origin, moved, lattice, periodic, lines, which
):
    """Value of a row that is a function, see `row_functions`; the gradient goes into the lines of its slots.

    A row of velocities is taken at the middle of the way from `origin`, and is zero throughout where it does not count.
    """
    cell, inverse = cell_of(lattice)
    size = 3 * (end - slot)
    rolls = kind >= VELOCITY
    at, out = ROOM, ROOM + 2 * size
    if rolls and number(parameters, COUNT) == 0.0:
        for p in range(ROOM, out + size + 1):
            rolled()
            put(parameters, p, 0.0)
    else:
        x, y, z = 0.0, 0.0, 0.0
        before, change_before = quad(0.0, 0.0, 0.0, 0.0), quad(0.0, 0.0, 0.0, 0.0)
        for p in range(slot, end):
            rolled()
            i = 4 * entry(slot_atoms, p)
            here, change = load_quad(base, i), load_quad(moves, i)
            if rolls:
                start = load_quad(origin, i)
                way = (here - start) + change
                here, change = start, 0.5 * way
                put(parameters, at + size, lane(way, 0))
                put(parameters, at + size + 1, lane(way, 1))
                put(parameters, at + size + 2, lane(way, 2))
            if kind in (FUNCTION, VELOCITY):
                r = (here - load_quad(moved, 4 * p)) + change
                x, y, z = lane(r, 0), lane(r, 1), lane(r, 2)
            elif p > slot:
                dx, dy, dz = near(here - before, change - change_before, cell, inverse, periodic)
                x, y, z = x + dx, y + dy, z + dz
            before, change_before = here, change
            put(parameters, at, x)
            put(parameters, at + 1, y)
            put(parameters, at + 2, z)
            at += 3
        time = number(parameters, which)
        if rolls:  # where the reference is asked for, the way is 0, and the time that of the reference
            time = 0.5 * (time + number(parameters, 1))
        call_row(parameters, offset, ROOM, offset + 2, time, out)
    at = out
    for p in range(slot, end):
        rolled()
        _put(lines, 8 * p + which, number(parameters, at + 1), number(parameters, at + 2), number(parameters, at + 3))
        at += 3
    return number(parameters, out)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def evaluate(  # type: ignore[no-untyped-def]
    function, first, last, kinds, links, slot_atoms, parameters, base, moves, origin, moved, lattice, periodic, values,
    lines, which,
):  # fmt: skip
    """Values and gradients of rows first to last; those of velocities for the way from `origin`.

    `function` is from `addresses_for`. ``links[4 k + 2]`` is the first slot of row k, ``links[4 k + 3]`` its
    first parameter. `moved` has, as quads by slot, what rows with a place in space take off positions.
    """
    cell, inverse = cell_of(lattice)
    for k in range(first, last):
        kind = entry(kinds, k)
        slot = entry(links, 4 * k + 2)
        place, offset = 8 * slot + which, entry(links, 4 * k + 3)
        i = entry(slot_atoms, slot)
        if kind == DISTANCE:
            x, y, z = _difference(i, entry(slot_atoms, slot + 1), base, moves, cell, inverse, periodic)
            value = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / value, y / value, z / value
            _put(lines, place, x, y, z)
            _put(lines, place + 8, -x, -y, -z)
        elif kind == ANGLE:
            j = entry(slot_atoms, slot + 1)
            x, y, z = _difference(i, j, base, moves, cell, inverse, periodic)
            wx, wy, wz = _difference(entry(slot_atoms, slot + 2), j, base, moves, cell, inverse, periodic)
            value, ax, ay, az, bx, by, bz = _angle(x, y, z, wx, wy, wz)
            _put(lines, place, ax, ay, az)
            _put(lines, place + 8, -(ax + bx), -(ay + by), -(az + bz))
            _put(lines, place + 16, bx, by, bz)
        elif kind == LINEAR:
            # sum c . r; small moves and large positions are summed apart.
            whole, change = 0.0, 0.0
            for p in range(slot, entry(links, 4 * k + 6)):
                i = 4 * entry(slot_atoms, p)
                c = quad(
                    number(parameters, offset), number(parameters, offset + 1), number(parameters, offset + 2), 0.0
                )
                _put(lines, 8 * p + which, lane(c, 0), lane(c, 1), lane(c, 2))
                whole += dot(c, load_quad(base, i) - load_quad(moved, 4 * p))
                change += dot(c, load_quad(moves, i))
                offset += 3
            value = whole + change
        else:
            value = _call_function(function, (
                kind, slot, entry(links, 4 * k + 6), slot_atoms, parameters, offset, base, moves, origin, moved,
                lattice, periodic, lines, which,
            ))  # fmt: skip
        put(values, k, value)


def addresses_for(kinds: NDArray[np.uint32]) -> tuple[int, int]:
    """Of `evaluate`, and of the function that it takes for rows of such kinds: 0 where none is a function."""
    return address_of(evaluate, _EVALUATE), address_of(_function, _FUNCTION) if (kinds >= FUNCTION).any() else 0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def first_flat(first, last, links, lines):  # type: ignore[no-untyped-def]
    """The first row whose gradient has less than `FLAT` of that at the reference along it; -1 if none has."""
    for k in range(first, last):
        along, size = 0.0, 0.0
        for p in range(entry(links, 4 * k + 2), entry(links, 4 * k + 6)):
            rolled()
            g = second_vector(lines, 8 * p)
            along += dot(first_vector(lines, 8 * p), g)
            size += dot(g, g)
        if along < FLAT * size:
            return k
    return -1


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def miss(value, target, period):  # type: ignore[no-untyped-def]
    """target - value, where there is a period by the shorter way round."""
    difference = target - value
    if period > 0.0:
        difference -= period * np.rint(difference / period)
    return difference
