"""Rows of mixed kinds, coupled in any way: sparse elimination with general gradients.

The counterpart of `kcons.solvers.sparse.distances` for clusters that also hold angles, dihedrals, planes and other
compiled rows. Rows of velocities are solved with the positions where these are the end of a flight, see
`row_functions`.

Values are found for one row at a time. Positions are held as ``base + moves`` so that differences of atoms that lie far
from the origin keep their digits while moves are small; both as quads (x, y, z, any) by atom. A gradient is stored by
slot (one atom of one row). The line of a slot holds two gradients number by number, now and at the reference, then the
atom's inverse mass: n0 r0 n1 r1 n2 r2 w -.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.internal import angle_between
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import Kernels, address_of, caller_of
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import INDICES, NUMBERS, at_first, at_piece, halves, integers
from kcons.solvers.kernels.lattices import OPEN, TRICLINIC, lattice_numbers, minimum_image
from kcons.solvers.kernels.two_and_four_wide import (
    dot,
    extract,
    first_vector,
    keep_loop_rolled,
    load_double,
    load_index,
    load_pair,
    load_point,
    load_quad,
    pair,
    quad,
    second_vector,
    settled,
    store_double,
    store_pair,
    store_quad,
    swapped,
)
from kcons.solvers.sparse import newton
from kcons.solvers.sparse.elimination import FAST, make_pattern, make_triples, number_atoms
from kcons.solvers.sparse.newton import (
    SparseSolver,
    apply,
    common_pieces,
    eliminate_columns,
    solve_positions,
    solve_tangents,
    substitute_back,
    substitute_forward,
)
from kcons.solvers.sparse.row_functions import COUNT, FUNCTION, ROOM, VELOCITY, GivenRows, call_row
from kcons.solvers.tolerances import EPS, FLAT, MANY_ITERATIONS, PIVOT_TOLERANCE, ROUNDING

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
#: How much closer than positions rows of velocities are held: what they are off by is a speed times a short time.
CLOSER = 16.0
#: The pieces behind those that all tables have: atoms of slots, kinds of rows; of each entry the first of its pairs of
#: slots on one atom, these, and their inverse masses; scales and targets of rows, lines of slots; values, reciprocals
#: of roundings; where atoms were at the start, speeds of atoms, where they were at the reference; addresses of kernels;
#: and what `_take_off` says.
_OWN = range(newton.COMMON, newton.COMMON + 15)
_SLOT_ATOMS, _KINDS, _TRIPLE, _SIDES, _MASSES, _SCALE, _TARGET, _LINES = _OWN[:8]
_VALUES, _ROUNDINGS, _BASE, _SPEEDS, _ORIGIN, _FUNCTIONS, _MOVED = _OWN[8:]


class SparseRows(SparseSolver):
    """Solver for clusters of compiled rows of any kind.

    Parameters
    ----------
    constraint_set : ConstraintSet
    rows : ndarray of int64
        Row numbers, sorted; whole clusters only.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    eliminate_last : ndarray of bool, shape (len(rows),), optional
        Rows that depend on the others of their cluster, see `make_pattern`.
    """

    name = "SparseRows"

    def __init__(
        self,
        constraint_set: ConstraintSet,
        rows: IntArray,
        inverse_masses: FloatArray,
        eliminate_last: NDArray[np.bool_] | None = None,
    ) -> None:
        incidence = constraint_set.incidence[rows]
        start = incidence.indptr.astype(np.int64)
        atoms = incidence.indices.astype(np.int64)
        keep = inverse_masses[atoms] > 0
        counts = np.add.reduceat(keep, start[:-1]) if len(rows) else np.zeros(0, np.int64)
        starts = np.concatenate([[0], np.cumsum(counts)])
        pattern = make_pattern(starts, atoms[keep], constraint_set.n_atoms, eliminate_last)
        order = pattern.order
        self.rows: IntArray = rows[order]
        widths = np.diff(start)[order]
        slots = np.concatenate([[0], np.cumsum(widths)]).astype(np.int64)
        flat = np.concatenate([atoms[start[k] : start[k + 1]] for k in order]) if len(order) else atoms
        atom_numbers, atom_start, slot_atoms = number_atoms(flat, slots, pattern.clusters, len(inverse_masses))
        w = inverse_masses[atom_numbers]
        triple, sides, masses = make_triples(pattern.start, pattern.columns, slots, slot_atoms, w)
        # Row by row: its first entry, its first target, its first slot, its first parameter.
        links = np.zeros((len(rows) + 1, 4), np.uint32)
        links[:, 0], links[:, 1], links[:, 2] = pattern.start, pattern.target_start, slots
        self._made_of = constraint_set, rows, inverse_masses, eliminate_last
        self._given = GivenRows(constraint_set, self.rows, 9 * int(widths.max(initial=0)) + 1)
        links[:-1, 3] = self._given.starts
        self.kernels, self.numbers = Kernels(_positions, _tangents, apply), self._given.numbers
        self.refuse = self._given.refuse  # type: ignore[method-assign]
        n, numbers = len(rows), 4 * len(atom_numbers)
        lines = np.zeros(8 * int(slots[-1]))
        lines[6::8] = w[slot_atoms]
        self.tables = in_one_array(
            (
                *(pattern.clusters, atom_numbers, atom_start, room(numbers), room(n), room(n), links.ravel()),
                *(pattern.columns, pattern.targets, room(2 * n), room(4 * len(pattern.columns))),
                *(slot_atoms, self._given.kinds, triple, sides, masses, constraint_set.scale[self.rows]),
                *(np.where(constraint_set.holonomic, constraint_set.target(0.0), 0.0)[self.rows], lines),
                *(room(n), room(n), room(numbers), room(numbers), room(numbers)),
                *(_addresses(self._given.kinds), room(4 * int(slots[-1]))),
            )
        )
        self._solution = part_of(self.tables, newton.SOLUTION)
        placed = [np.full(c.n_rows, not c.relative) for c in constraint_set.constraints] or [np.zeros(0, np.bool_)]
        self._placed = np.flatnonzero(np.repeat(np.concatenate(placed)[self.rows], widths))
        self._placed_atoms = flat[self._placed]

    def _take_off(self, moved: FloatArray | None) -> None:
        cells = part_of(self.tables, _MOVED).reshape(-1, 4)
        cells[self._placed, :3] = 0.0 if moved is None else moved[self._placed_atoms]
        self._moved = moved is not None


def _addresses(kinds: NDArray[np.uint32]) -> IntArray:
    """Of `evaluate` and of `_function`; 0 for that where no row is one."""
    function = address_of(_function, _FUNCTION) if (kinds >= FUNCTION).any() else 0
    return np.array([address_of(evaluate, _EVALUATE), function], dtype=np.int64)


# -- values and gradients -------------------------------------------------------------------------------------


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _difference(i, j, base, moves, cell, periodic):
    """Vector from atom j to atom i, as three numbers."""
    return near(
        load_quad(base, 4 * i) - load_quad(base, 4 * j),
        load_quad(moves, 4 * i) - load_quad(moves, 4 * j),
        cell, periodic,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy")
def near(whole, change, cell, periodic):
    # No arrays come here: one that passes a branch costs reference counting.
    x, y, z = extract(whole, 0), extract(whole, 1), extract(whole, 2)
    if periodic:
        x, y, z = minimum_image((x, y, z), cell, TRICLINIC)
    return x + extract(change, 0), y + extract(change, 1), z + extract(change, 2)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _put(lines, place, x, y, z):
    store_double(lines, place, x)
    store_double(lines, place + 2, y)
    store_double(lines, place + 4, z)


_angle = njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")(angle_between)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _function(
    kind, slot, end, slot_atoms, parameters, offset, base, moves, origin, moved, lattice, periodic, lines, which
):
    """Value of a row that is a function, see `row_functions`; the gradient goes into the lines of its slots.

    A row of velocities is taken at the middle of the way from `origin`, and is zero throughout where it does not count.
    """
    cell = lattice_numbers(lattice)
    size = 3 * (end - slot)
    rolls = kind >= VELOCITY
    at, out = ROOM, ROOM + 2 * size
    if rolls and load_double(parameters, COUNT) == 0.0:
        for p in range(ROOM, out + size + 1):
            keep_loop_rolled()
            store_double(parameters, p, 0.0)
    else:
        x, y, z = 0.0, 0.0, 0.0
        before, change_before = quad(0.0, 0.0, 0.0, 0.0), quad(0.0, 0.0, 0.0, 0.0)
        for p in range(slot, end):
            keep_loop_rolled()
            i = 4 * load_index(slot_atoms, p)
            here, change = load_quad(base, i), load_quad(moves, i)
            if rolls:
                start = load_quad(origin, i)
                way = (here - start) + change
                here, change = start, 0.5 * way
                store_double(parameters, at + size, extract(way, 0))
                store_double(parameters, at + size + 1, extract(way, 1))
                store_double(parameters, at + size + 2, extract(way, 2))
            if kind in (FUNCTION, VELOCITY):
                r = (here - load_quad(moved, 4 * p)) + change
                x, y, z = extract(r, 0), extract(r, 1), extract(r, 2)
            elif p > slot:
                dx, dy, dz = near(here - before, change - change_before, cell, periodic)
                x, y, z = x + dx, y + dy, z + dz
            before, change_before = here, change
            store_double(parameters, at, x)
            store_double(parameters, at + 1, y)
            store_double(parameters, at + 2, z)
            at += 3
        time = load_double(parameters, which)
        if rolls:  # where the reference is asked for, the way is 0, and the time that of the reference
            time = 0.5 * (time + load_double(parameters, 1))
        call_row(parameters, offset, ROOM, offset + 2, time, out)
    at = out
    for p in range(slot, end):
        keep_loop_rolled()
        _put(
            lines,
            8 * p + which,
            load_double(parameters, at + 1),
            load_double(parameters, at + 2),
            load_double(parameters, at + 3),
        )
        at += 3
    return load_double(parameters, out)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def evaluate(
    function, first, last, kinds, links, slot_atoms, parameters, base, moves, origin, moved, lattice, periodic, values,
    lines, which,
):  # fmt: skip
    """Values and gradients of rows first to last; those of velocities for the way from `origin`.

    `function` is where `_function` is. ``links[4 k + 2]`` is the first slot of row k, ``links[4 k + 3]`` its
    first parameter. `moved` has, as quads by slot, what rows with a place in space take off positions.
    """
    cell = lattice_numbers(lattice)
    for k in range(first, last):
        kind = load_index(kinds, k)
        slot = load_index(links, 4 * k + 2)
        place, offset = 8 * slot + which, load_index(links, 4 * k + 3)
        i = load_index(slot_atoms, slot)
        if kind == DISTANCE:
            x, y, z = _difference(i, load_index(slot_atoms, slot + 1), base, moves, cell, periodic)
            value = math.sqrt(x * x + y * y + z * z)
            x, y, z = x / value, y / value, z / value
            _put(lines, place, x, y, z)
            _put(lines, place + 8, -x, -y, -z)
        elif kind == ANGLE:
            j = load_index(slot_atoms, slot + 1)
            x, y, z = _difference(i, j, base, moves, cell, periodic)
            wx, wy, wz = _difference(load_index(slot_atoms, slot + 2), j, base, moves, cell, periodic)
            value, ax, ay, az, bx, by, bz = _angle(x, y, z, wx, wy, wz)
            _put(lines, place, ax, ay, az)
            _put(lines, place + 8, -(ax + bx), -(ay + by), -(az + bz))
            _put(lines, place + 16, bx, by, bz)
        elif kind == LINEAR:
            # sum c . r; small moves and large positions are summed apart.
            whole, change = 0.0, 0.0
            for p in range(slot, load_index(links, 4 * k + 6)):
                i = 4 * load_index(slot_atoms, p)
                one, two = load_double(parameters, offset), load_double(parameters, offset + 1)
                c = quad(one, two, load_double(parameters, offset + 2), 0.0)
                _put(lines, 8 * p + which, extract(c, 0), extract(c, 1), extract(c, 2))
                whole += dot(c, load_quad(base, i) - load_quad(moved, 4 * p))
                change += dot(c, load_quad(moves, i))
                offset += 3
            value = whole + change
        else:
            value = _call_function(function, (
                kind, slot, load_index(links, 4 * k + 6), slot_atoms, parameters, offset, base, moves, origin, moved,
                lattice, periodic, lines, which,
            ))  # fmt: skip
        store_double(values, k, value)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def first_flat(first, last, links, lines):
    """The first row whose gradient has less than `FLAT` of that at the reference along it; -1 if none has."""
    for k in range(first, last):
        along, size = 0.0, 0.0
        for p in range(load_index(links, 4 * k + 2), load_index(links, 4 * k + 6)):
            keep_loop_rolled()
            g = second_vector(lines, 8 * p)
            along += dot(first_vector(lines, 8 * p), g)
            size += dot(g, g)
        if along < FLAT * size:
            return k
    return -1


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def miss(value, target, period):
    """target - value, where there is a period by the shorter way round."""
    difference = target - value
    if period > 0.0:
        difference -= period * np.rint(difference / period)
    return difference


# -- elimination and substitution ----------------------------------------------------------------------------

_Pieces = namedtuple(  # type: ignore[misc]
    "_Pieces",
    newton.COMMON_NAMES + " slot_atoms kinds triple sides masses scale lines values roundings base speeds origin"
    " functions moved parameters wanted x ref lattice periodic driven",
)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor(p, first, last):
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep; changes are left at zero."""
    links, lines, state, entries = p.links, p.lines, p.state, p.entries
    begin, t, slot = load_index(links, 4 * first), load_index(links, 4 * first + 1), load_index(links, 4 * first + 2)
    for k in range(first, last):
        whole = 0.0
        stop = load_index(links, 4 * k + 6)
        while slot < stop:
            keep_loop_rolled()
            line = 8 * slot
            inner = load_double(lines, line) * load_double(lines, line + 1)
            inner += load_double(lines, line + 2) * load_double(lines, line + 3)
            inner += load_double(lines, line + 4) * load_double(lines, line + 5)
            whole += load_double(lines, line + 6) * inner
            slot += 1
        d = whole + load_double(state, 2 * k)
        store_double(state, 2 * k, 0.0)
        right = load_double(state, 2 * k + 1)
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        store_double(p.pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        u = load_index(p.triple, begin)
        for e in range(begin, end):
            keep_loop_rolled()
            both = load_pair(entries, 4 * e + 2)
            stop2 = load_index(p.triple, e + 1)
            while u < stop2:
                keep_loop_rolled()
                a, b = 8 * load_index(p.sides, 2 * u), 8 * load_index(p.sides, 2 * u + 1)
                inner2 = swapped(load_pair(lines, a)) * load_pair(lines, b)
                inner2 = inner2 + swapped(load_pair(lines, a + 2)) * load_pair(lines, b + 2)
                inner2 = inner2 + swapped(load_pair(lines, a + 4)) * load_pair(lines, b + 4)
                both = both + load_double(p.masses, u) * inner2
                u += 1
            l = 2 * load_index(p.columns, e)
            low, up = inverse * extract(both, 0), extract(both, 1)
            store_quad(entries, 4 * e, settled(pair(low, up)))
            store_pair(state, l, load_pair(state, l) - low * pair(up, right))
        t = eliminate_columns(begin, end, t, p.targets, entries)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _forward(p, first, last):
    substitute_forward(first, last, p.links, p.columns, p.state, p.entries, 2)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _backward(p, first, last):
    """Backward substitution; adds to the multipliers and moves the atoms along the reference gradients."""
    links, lines, moves = p.links, p.lines, p.moves
    end, slot = load_index(links, 4 * last), load_index(links, 4 * last + 2)
    for back in range(last - first):
        k = last - 1 - back
        begin = load_index(links, 4 * k)
        step = substitute_back(k, begin, end, p.columns, p.state, p.entries, p.pivots, p.solution, 2)
        end = begin
        stop = load_index(links, 4 * k + 2)
        while slot > stop:
            keep_loop_rolled()
            slot -= 1
            a = 4 * load_index(p.slot_atoms, slot)
            f = step * load_double(lines, 8 * slot + 6)
            store_quad(moves, a, load_quad(moves, a) + f * second_vector(lines, 8 * slot))


# -- what Newton's method asks for ---------------------------------------------------------------------------


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _evaluated(p, first, last, base, origin, which):
    call_evaluate(p.functions[0], (
        p.functions[1], first, last, p.kinds, p.links, p.slot_atoms, p.parameters, base, p.moves, origin, p.moved,
        p.lattice, p.periodic, p.values, p.lines, which,
    ))  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin(p, first, last, first_atom, last_atom):
    """Gradients at the reference, and the reciprocal of what rounding leaves of each row."""
    for a in range(first_atom, last_atom):
        store_quad(p.origin, 4 * a, load_point(p.ref, 3 * load_index(p.atoms, a)))
        store_quad(p.moves, 4 * a, quad(0.0, 0.0, 0.0, 0.0))
    _evaluated(p, first, last, p.origin, p.origin, REFERENCE)
    for a in range(first_atom, last_atom):
        point = load_point(p.x, 3 * load_index(p.atoms, a))
        store_quad(p.base, 4 * a, point)
        store_double(p.base, 4 * a + 3, np.sqrt(dot(point, point)))
    for k in range(first, last):
        store_double(p.solution, k, 0.0)
        # Of absolute positions for rows on space, of the row's own size for others.
        reach = 0.0
        for slot in range(load_index(p.links, 4 * k + 2), load_index(p.links, 4 * k + 6)):
            keep_loop_rolled()
            size = load_double(p.base, 4 * load_index(p.slot_atoms, slot) + 3)
            if load_index(p.kinds, k) != DISTANCE:
                g = second_vector(p.lines, 8 * slot)
                size *= np.sqrt(dot(g, g))
            reach += size
        store_double(p.roundings, k, 1.0 / max(ROUNDING * load_double(p.scale, k), 2 * EPS * reach))
    return _measure(p, first, last)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _measure(p, first, last):
    """Values, gradients and right-hand sides."""
    _evaluated(p, first, last, p.base, p.origin, NOW)
    error, total = 0.0, 0.0
    for k in range(first, last):
        period = 0.0
        if load_index(p.kinds, k) >= FUNCTION:
            period = load_double(p.parameters, load_index(p.links, 4 * k + 3) + 1)
        store_double(p.state, 2 * k + 1, miss(load_double(p.values, k), load_double(p.wanted, k), period))
        e = _size(p, k)
        total += e
        error = max(error, e)
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _size(p, k):
    e = abs(load_double(p.state, 2 * k + 1)) / load_double(p.scale, k)
    return e * CLOSER if load_index(p.kinds, k) >= VELOCITY else e


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _in_roundings(p, k):
    return abs(load_double(p.state, 2 * k + 1)) * load_double(p.roundings, k)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _turned(p, first, last, iteration):
    """The first row whose gradient has flattened out on the way, or turned by 90 degrees or more; -1 if none has."""
    bad = first_flat(first, last, p.links, p.lines) if iteration > MANY_ITERATIONS else -1
    if bad >= 0:
        return bad
    for k in range(first, last):
        along = 0.0
        for slot in range(load_index(p.links, 4 * k + 2), load_index(p.links, 4 * k + 6)):
            keep_loop_rolled()
            along += dot(first_vector(p.lines, 8 * slot), second_vector(p.lines, 8 * slot))
        if not (along > 0.0) and (load_index(p.kinds, k) < VELOCITY or load_double(p.parameters, COUNT) != 0.0):
            return k
    return -1


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin_tangents(p, first, last, first_atom, last_atom):
    """Gradients, speeds, and what these are off by."""
    for a in range(first_atom, last_atom):
        g = 3 * load_index(p.atoms, a)
        store_quad(p.base, 4 * a, load_point(p.ref, g))
        store_quad(p.speeds, 4 * a, load_point(p.x, g))
        store_quad(p.moves, 4 * a, quad(0.0, 0.0, 0.0, 0.0))
    _evaluated(p, first, last, p.base, p.base, REFERENCE)
    largest, total = 0.0, 0.0
    for k in range(first, last):
        goal = load_double(p.wanted, k) if p.driven else 0.0
        off, size = goal, abs(goal)
        for slot in range(load_index(p.links, 4 * k + 2), load_index(p.links, 4 * k + 6)):
            keep_loop_rolled()
            g = second_vector(p.lines, 8 * slot)
            _put(p.lines, 8 * slot, extract(g, 0), extract(g, 1), extract(g, 2))
            part = g * load_quad(p.speeds, 4 * load_index(p.slot_atoms, slot))
            off -= extract(part, 0) + extract(part, 1) + extract(part, 2)
            size += abs(extract(part, 0)) + abs(extract(part, 1)) + abs(extract(part, 2))
        store_double(p.state, 2 * k, 0.0)
        store_double(p.state, 2 * k + 1, off)
        largest = max(largest, size)
        total += size
        store_double(p.solution, k, 0.0)
    return largest, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _measure_tangents(p, first, last):
    error, total = 0.0, 0.0
    for k in range(first, last):
        off = load_double(p.wanted, k) if p.driven else 0.0
        for slot in range(load_index(p.links, 4 * k + 2), load_index(p.links, 4 * k + 6)):
            keep_loop_rolled()
            a = 4 * load_index(p.slot_atoms, slot)
            off -= dot(second_vector(p.lines, 8 * slot), load_quad(p.speeds, a) + load_quad(p.moves, a))
        store_double(p.state, 2 * k + 1, off)
        total += abs(off)
        error = max(error, abs(off))
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _speed(p, k):
    return abs(load_double(p.state, 2 * k + 1))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _pieces(tables, numbers, wanted, x, x_ref, lattice, kind, driven):
    t, h, u = tables, integers(tables), halves(tables)
    atoms, moves, solution, pivots, links, columns, targets, state, entries = common_pieces(tables)
    return _Pieces(
        atoms, moves, solution, pivots, links, columns, targets, state, entries, at_piece(u, h, _SLOT_ATOMS),
        at_piece(u, h, _KINDS), at_piece(u, h, _TRIPLE), at_piece(u, h, _SIDES), at_piece(t, h, _MASSES),
        at_piece(t, h, _SCALE), at_piece(t, h, _LINES), at_piece(t, h, _VALUES), at_piece(t, h, _ROUNDINGS),
        at_piece(t, h, _BASE), at_piece(t, h, _SPEEDS), at_piece(t, h, _ORIGIN), at_piece(h, h, _FUNCTIONS),
        at_piece(t, h, _MOVED), at_first(numbers), wanted, at_first(x), at_first(x_ref), lattice, kind != OPEN, driven,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(alone, x_new, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    goals = at_first(wanted) if wanted.size else at_piece(tables, integers(tables), _TARGET)
    p = _pieces(tables, numbers, goals, x_new, x_ref, lattice, kind, False)
    return solve_positions(
        alone, x_new, velocities, inv_dt, tables, p, _begin, _measure, _size, _in_roundings, _factor, _forward,
        _backward, _turned,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, y, x, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    p = _pieces(tables, numbers, at_first(wanted), y, x, lattice, kind, wanted.size > 0)
    return solve_tangents(alone, y, tables, p, _begin_tangents, _measure_tangents, _speed, _factor, _forward, _backward)
