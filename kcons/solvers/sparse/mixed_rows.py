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

import numpy as np
from numba import types
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.internal import angle_between
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels, address_of, caller_of
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import INDICES, NUMBERS, at_first, at_piece, halves, integers
from kcons.solvers.kernels.lattices import OPEN, TRICLINIC, lattice_numbers, minimum_image
from kcons.solvers.kernels.two_and_four_wide import (
    add_to_point,
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
from kcons.solvers.sparse.distances import factor_serves, hopeless, refines, stalled, update
from kcons.solvers.sparse.elimination import FAST, make_pattern, make_triples, number_atoms
from kcons.solvers.sparse.row_functions import COUNT, FUNCTION, ROOM, VELOCITY, GivenRows, call_row
from kcons.solvers.tolerances import (
    EPS,
    FLAT,
    MANY_ITERATIONS,
    NEWTON_TOLERANCE,
    PIVOT_TOLERANCE,
    ROUNDING,
    SPEED_ROUNDINGS,
    SPEED_TOLERANCE,
)

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
#: Of the pieces of `SparseRows.tables`, those that are named.
_PIVOTS, _MOVES, _SOLUTION, _FUNCTIONS, _MOVED = 16, 20, 21, 24, 25
#: Signatures of what `_positions` and `_tangents` call by address, so that it is compiled once and not into both.
_RANGE = types.int64, types.int64
_FACTOR = types.none(*_RANGE, *(5 * (INDICES,)), *(5 * (NUMBERS,)))
_FORWARD = types.none(*_RANGE, *(2 * (INDICES,)), *(2 * (NUMBERS,)))
_BACKWARD = types.none(*_RANGE, *(3 * (INDICES,)), *(6 * (NUMBERS,)))
_call_factor, _call_forward, _call_backward = map(caller_of, (_FACTOR, _FORWARD, _BACKWARD))


class SparseRows(AddressableSolver):
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
        self.kernels, self.numbers = Kernels(_positions, _tangents, _apply), self._given.numbers
        self.refuse = self._given.refuse  # type: ignore[method-assign]
        n, numbers = len(rows), 4 * len(atom_numbers)
        lines = np.zeros(8 * int(slots[-1]))
        lines[6::8] = w[slot_atoms]
        self.tables = in_one_array(
            (
                *(pattern.clusters, atom_numbers, atom_start, slot_atoms, self._given.kinds, links.ravel()),
                *(pattern.columns, pattern.targets, triple, sides, masses, constraint_set.scale[self.rows]),
                *(np.where(constraint_set.holonomic, constraint_set.target(0.0), 0.0)[self.rows], lines),
                # By row: accumulated change of the pivot and right-hand side; by entry as in `sparse.distances`.
                *(room(2 * n), room(4 * len(pattern.columns))),
                *(room(n), room(n), room(n), room(numbers), room(numbers), room(n), room(numbers), room(numbers)),
                _addresses(self._given.kinds),
                room(4 * int(slots[-1])),  # by slot, as quads: what `_take_off` says
            )
        )
        self._solution = part_of(self.tables, _SOLUTION)
        placed = [np.full(c.n_rows, not c.relative) for c in constraint_set.constraints] or [np.zeros(0, np.bool_)]
        self._placed = np.flatnonzero(np.repeat(np.concatenate(placed)[self.rows], widths))
        self._placed_atoms = flat[self._placed]

    @property
    def pivots(self) -> FloatArray:
        pivots: FloatArray = part_of(self.tables, _PIVOTS)
        return pivots

    def _take_off(self, moved: FloatArray | None) -> None:
        cells = part_of(self.tables, _MOVED).reshape(-1, 4)
        cells[self._placed, :3] = 0.0 if moved is None else moved[self._placed_atoms]
        self._moved = moved is not None


def _addresses(kinds: NDArray[np.uint32]) -> IntArray:
    """Of the kernels, in the order of `_FUNCTIONS`; 0 for that of functions where no row is one."""
    kernels = (evaluate, _EVALUATE), (_function, _FUNCTION), (_factor, _FACTOR), (_forward, _FORWARD)
    needed = [*kernels, (_backward, _BACKWARD)]
    some = (kinds >= FUNCTION).any()
    return np.array([address_of(*each) if some or each[0] is not _function else 0 for each in needed], dtype=np.int64)


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
        x, y, z = minimum_image(x, y, z, cell, TRICLINIC)
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
                c = quad(
                    load_double(parameters, offset),
                    load_double(parameters, offset + 1),
                    load_double(parameters, offset + 2),
                    0.0,
                )
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


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor(first, last, links, columns, targets, triple, sides, masses, lines, state, entries, pivots):
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep.

    Entries are stored as in `kcons.solvers.sparse.distances`; accumulated changes are left at zero.
    """
    begin, t, slot = (
        load_index(links, 4 * first),
        load_index(links, 4 * first + 1),
        8 * load_index(links, 4 * first + 2),
    )
    for k in range(first, last):
        stop = 8 * load_index(links, 4 * k + 6)
        whole = 0.0
        while slot < stop:
            keep_loop_rolled()
            inner = load_double(lines, slot) * load_double(lines, slot + 1)
            inner += load_double(lines, slot + 2) * load_double(lines, slot + 3)
            whole += load_double(lines, slot + 6) * (
                inner + load_double(lines, slot + 4) * load_double(lines, slot + 5)
            )
            slot += 8
        d = whole + load_double(state, 2 * k)
        store_double(state, 2 * k, 0.0)
        right = load_double(state, 2 * k + 1)
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        store_double(pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        u = load_index(triple, begin)
        for p in range(begin, end):
            keep_loop_rolled()
            both = load_pair(entries, 4 * p + 2)
            stop = load_index(triple, p + 1)
            while u < stop:
                keep_loop_rolled()
                a, b = 8 * load_index(sides, 2 * u), 8 * load_index(sides, 2 * u + 1)
                inner2 = swapped(load_pair(lines, a)) * load_pair(lines, b)
                inner2 = inner2 + swapped(load_pair(lines, a + 2)) * load_pair(lines, b + 2)
                inner2 = inner2 + swapped(load_pair(lines, a + 4)) * load_pair(lines, b + 4)
                both = both + load_double(masses, u) * inner2
                u += 1
            l = 2 * load_index(columns, p)
            low, up = inverse * extract(both, 0), extract(both, 1)
            store_quad(entries, 4 * p, settled(pair(low, up)))
            store_pair(state, l, load_pair(state, l) - low * pair(up, right))
        for p in range(begin, end - 1):
            keep_loop_rolled()
            mine = load_pair(entries, 4 * p)
            for q in range(p + 1, end):
                keep_loop_rolled()
                update(t, mine, load_pair(entries, 4 * q), targets, entries)
                t += 1
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _forward(first, last, links, columns, state, entries):
    begin = load_index(links, 4 * first)
    for k in range(first, last):
        right = load_double(state, 2 * k + 1)
        end = load_index(links, 4 * k + 4)
        for p in range(begin, end):
            keep_loop_rolled()
            l = 2 * load_index(columns, p) + 1
            store_double(state, l, load_double(state, l) - load_double(entries, 4 * p) * right)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _backward(first, last, links, columns, slot_atoms, lines, state, entries, pivots, moves, solution):
    """Backward substitution; adds to the multipliers and moves the atoms along the reference gradients."""
    end, slot = load_index(links, 4 * last), load_index(links, 4 * last + 2)
    for back in range(last - first):
        k = last - 1 - back
        step = load_double(state, 2 * k + 1)
        begin = load_index(links, 4 * k)
        for p in range(begin, end):
            keep_loop_rolled()
            step -= load_double(entries, 4 * p + 1) * load_double(state, 2 * load_index(columns, p) + 1)
        end = begin
        step *= load_double(pivots, k)
        store_double(state, 2 * k + 1, step)
        store_double(solution, k, load_double(solution, k) + step)
        stop = load_index(links, 4 * k + 2)
        while slot > stop:
            keep_loop_rolled()
            slot -= 1
            a = 4 * load_index(slot_atoms, slot)
            f = step * load_double(lines, 8 * slot + 6)
            store_quad(moves, a, load_quad(moves, a) + f * second_vector(lines, 8 * slot))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin(
    first, last, first_atom, last_atom, x_new, x_ref, lattice, periodic, atoms, slot_atoms, kinds, parameters, links,
    scale, lines, values, inverse_rounding, base, moves, origin, moved, solution, functions,
):  # fmt: skip
    """Gradients at the reference, and the reciprocal of what rounding leaves of each row."""
    zero = quad(0.0, 0.0, 0.0, 0.0)
    for a in range(first_atom, last_atom):
        store_quad(origin, 4 * a, load_point(x_ref, 3 * load_index(atoms, a)))
        store_quad(moves, 4 * a, zero)
    call_evaluate(functions[0], (
        functions[1], first, last, kinds, links, slot_atoms, parameters, origin, moves, origin, moved, lattice,
        periodic, values, lines, REFERENCE,
    ))  # fmt: skip
    for a in range(first_atom, last_atom):
        point = load_point(x_new, 3 * load_index(atoms, a))
        store_quad(base, 4 * a, point)
        store_double(base, 4 * a + 3, np.sqrt(dot(point, point)))
    for k in range(first, last):
        store_double(solution, k, 0.0)
        # Of absolute positions for rows on space, of the row's own size for others.
        reach = 0.0
        for p in range(load_index(links, 4 * k + 2), load_index(links, 4 * k + 6)):
            keep_loop_rolled()
            size = load_double(base, 4 * load_index(slot_atoms, p) + 3)
            if load_index(kinds, k) != DISTANCE:
                g = second_vector(lines, 8 * p)
                size *= np.sqrt(dot(g, g))
            reach += size
        store_double(inverse_rounding, k, 1.0 / max(ROUNDING * load_double(scale, k), 2 * EPS * reach))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _measure(first, last, kinds, parameters, links, wanted, scale, inverse_rounding, values, state):
    """Right-hand sides; largest and total error, the row with the largest, and the largest in units of its rounding."""
    error, total, excess = 0.0, 0.0, 0.0
    bad = first
    for k in range(first, last):
        period = 0.0
        if load_index(kinds, k) >= FUNCTION:
            period = load_double(parameters, load_index(links, 4 * k + 3) + 1)
        off = miss(load_double(values, k), load_double(wanted, k), period)
        store_double(state, 2 * k + 1, off)
        e = abs(off) / load_double(scale, k)
        if load_index(kinds, k) >= VELOCITY:
            e *= CLOSER
        total += e
        if e > error:
            error = e
            bad = k
        excess = max(excess, abs(off) * load_double(inverse_rounding, k))
    return error, total, excess, bad


@njit(cache=True, inline="always")
def _first_not_finite(first, last, state):
    for k in range(first, last):
        if not (abs(state[2 * k + 1]) < np.inf):
            return k
    return first


@njit(cache=True, fastmath=FAST)
def _apply(x, factor, tables):
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    atoms, moves = at_piece(halves(tables), h, 1), at_piece(tables, h, _MOVES)
    for a in range(h[3] - h[2]):
        add_to_point(x, 3 * load_index(atoms, a), factor * load_quad(moves, 4 * a))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(alone, x_new, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atom_start, atoms, slot_atoms = at_piece(h, h, 0), at_piece(h, h, 2), at_piece(u, h, 1), at_piece(u, h, 3)
    kinds, links, columns, targets = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(u, h, 7)
    triple, sides, masses, scale = at_piece(u, h, 8), at_piece(u, h, 9), at_piece(t, h, 10), at_piece(t, h, 11)
    lines, state, entries, pivots = at_piece(t, h, 13), at_piece(t, h, 14), at_piece(t, h, 15), at_piece(t, h, _PIVOTS)
    values, inverse_rounding, base = at_piece(t, h, 17), at_piece(t, h, 18), at_piece(t, h, 19)
    moves, solution = at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION)
    origin, functions = at_piece(t, h, 23), at_piece(h, h, _FUNCTIONS)
    moved, periodic = at_piece(t, h, _MOVED), kind != OPEN
    goals, parameters = at_first(wanted) if wanted.size else at_piece(t, h, 12), at_first(numbers)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        _begin(
            first, last, atom_start[c], atom_start[c + 1], x_new, x_ref, lattice, periodic, atoms, slot_atoms, kinds,
            parameters, links, scale, lines, values, inverse_rounding, base, moves, origin, moved, solution, functions,
        )  # fmt: skip
        matrix = first, last, links, columns, targets, triple, sides, masses, lines, state, entries, pivots
        error = np.inf
        factored = False
        iteration = 0
        while True:
            previous = error
            call_evaluate(functions[0], (
                functions[1], first, last, kinds, links, slot_atoms, parameters, base, moves, origin, moved,
                lattice, periodic, values, lines, NOW,
            ))  # fmt: skip
            error, total, excess, bad = _measure(
                first, last, kinds, parameters, links, goals, scale, inverse_rounding, values, state
            )
            if not (total < np.inf):
                return False, np.inf, iteration, _first_not_finite(first, last, state)
            if hopeless(iteration, error, previous):
                return False, error, iteration, bad
            # Go on to the rounding of the relative coordinates as long as Newton still gains.
            if excess <= 1.0 and (error <= NEWTON_TOLERANCE or error > 0.1 * previous):
                break
            if stalled(iteration, error, previous, excess, last - first):
                break
            if factor_serves(factored, error, previous):
                _call_forward(functions[3], (first, last, links, columns, state, entries))
            else:
                _call_factor(functions[2], matrix)
                factored = True
            _call_backward(
                functions[4], (first, last, links, columns, slot_atoms, lines, state, entries, pivots, moves, solution)
            )
            iteration += 1
        if iteration > MANY_ITERATIONS:
            bad_row = first_flat(first, last, links, lines)
            if bad_row >= 0:
                return False, np.inf, iteration, bad_row
        for k in range(first, last):
            along = 0.0
            for p in range(load_index(links, 4 * k + 2), load_index(links, 4 * k + 6)):
                keep_loop_rolled()
                along += dot(first_vector(lines, 8 * p), second_vector(lines, 8 * p))
            # A gradient must not have turned by 90 degrees or more within the step.
            if not (along > 0.0) and (load_index(kinds, k) < VELOCITY or load_double(parameters, COUNT) != 0.0):
                return False, np.inf, iteration, k
        if error >= worst:
            worst, worst_row = error, bad
        most = max(most, iteration)
    if alone:
        _apply(x_new, 1.0, tables)
        if inv_dt != 0.0:
            _apply(velocities, inv_dt, tables)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, y, x, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atom_start, atoms, slot_atoms = at_piece(h, h, 0), at_piece(h, h, 2), at_piece(u, h, 1), at_piece(u, h, 3)
    kinds, links, columns, targets = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(u, h, 7)
    triple, sides, masses, lines = at_piece(u, h, 8), at_piece(u, h, 9), at_piece(t, h, 10), at_piece(t, h, 13)
    state, entries, pivots, values = at_piece(t, h, 14), at_piece(t, h, 15), at_piece(t, h, _PIVOTS), at_piece(t, h, 17)
    base, moves, solution = at_piece(t, h, 19), at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION)
    speeds, functions, moved = at_piece(t, h, 22), at_piece(h, h, _FUNCTIONS), at_piece(t, h, _MOVED)
    driven, goals, parameters, periodic = wanted.size > 0, at_first(wanted), at_first(numbers), kind != OPEN
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = 3 * load_index(atoms, a)
            store_quad(base, 4 * a, load_point(x, g))
            store_quad(speeds, 4 * a, load_point(y, g))
            store_quad(moves, 4 * a, quad(0.0, 0.0, 0.0, 0.0))
        call_evaluate(functions[0], (
            functions[1], first, last, kinds, links, slot_atoms, parameters, base, moves, base, moved, lattice,
            periodic, values, lines, REFERENCE,
        ))  # fmt: skip
        largest, total = 0.0, 0.0
        for k in range(first, last):
            goal = load_double(goals, k) if driven else 0.0
            off, size = goal, abs(goal)
            for p in range(load_index(links, 4 * k + 2), load_index(links, 4 * k + 6)):
                keep_loop_rolled()
                g = second_vector(lines, 8 * p)
                store_double(lines, 8 * p, extract(g, 0))
                store_double(lines, 8 * p + 2, extract(g, 1))
                store_double(lines, 8 * p + 4, extract(g, 2))
                part = g * load_quad(speeds, 4 * load_index(slot_atoms, p))
                off -= extract(part, 0) + extract(part, 1) + extract(part, 2)
                size += abs(extract(part, 0)) + abs(extract(part, 1)) + abs(extract(part, 2))
            store_double(state, 2 * k, 0.0)
            store_double(state, 2 * k + 1, off)
            largest = max(largest, size)
            total += size
            store_double(solution, k, 0.0)
        if not (total < np.inf):
            return False, np.inf, 0, _first_not_finite(first, last, state)
        matrix = first, last, links, columns, targets, triple, sides, masses, lines, state, entries, pivots
        _call_factor(functions[2], matrix)
        allowed = SPEED_TOLERANCE * largest
        previous = np.inf
        iteration = 0
        while True:
            _call_backward(
                functions[4], (first, last, links, columns, slot_atoms, lines, state, entries, pivots, moves, solution)
            )
            iteration += 1
            error, total = 0.0, 0.0
            bad = first
            for k in range(first, last):
                off = load_double(goals, k) if driven else 0.0
                for p in range(load_index(links, 4 * k + 2), load_index(links, 4 * k + 6)):
                    keep_loop_rolled()
                    a = 4 * load_index(slot_atoms, p)
                    off -= dot(second_vector(lines, 8 * p), load_quad(speeds, a) + load_quad(moves, a))
                store_double(state, 2 * k + 1, off)
                total += abs(off)
                if abs(off) > error:
                    error = abs(off)
                    bad = k
            if not (total < np.inf):
                return False, np.inf, iteration, bad
            if not refines(iteration, error, previous, allowed):
                break
            previous = error
            _call_forward(functions[3], (first, last, links, columns, state, entries))
        if error > SPEED_ROUNDINGS * allowed:
            return False, error, iteration, bad
        if error >= worst:
            worst, worst_row = error, bad
        most = max(most, iteration)
    if alone:
        _apply(y, 1.0, tables)
    return True, worst, most, worst_row
