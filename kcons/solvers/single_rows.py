"""Rows that share no atom with another one, each a function: Newton's method for one multiplier after the other.

What one particle on a surface takes, and a hundred thousand. Values and gradients are called by address, see
`kcons.solvers.sparse.row_functions`.
"""

from __future__ import annotations

import math

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.solvers.called_solvers import CalledSolver, Kernels
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import halves, integers, piece
from kcons.solvers.kernels.lattices import OPEN
from kcons.solvers.kernels.two_and_four_wide import entry, lane, load_point, number, put, quad, rolled
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.sparse.row_functions import FUNCTION, ROOM, GivenRows, call_row
from kcons.solvers.sparse.row_values import cell_of, miss, near
from kcons.solvers.sparse.rows_at_once import BLOCK, call_rows
from kcons.solvers.tolerances import (
    EPS,
    FLAT,
    MANY_ITERATIONS,
    MAX_HALVINGS,
    MAX_ITERATIONS,
    NEAR,
    NEWTON_TOLERANCE,
    ROUNDING,
    SPEED_ROUNDINGS,
    SPEED_TOLERANCE,
)

#: What is known of one of them: the error that is rounding, the last one, the multiplier that had it, and how
#: often the step from there was halved, -1 once it has arrived.
WORDS, ALLOWED, PREVIOUS, LAST, HALVINGS = 4, 0, 1, 2, 3
#: Of the pieces of `SingleRows.tables`, those that are named.
_PUSHES, _SOLUTION, _RUNS = 7, 8, 9


class SingleRows(CalledSolver):
    """Solver for clusters of one row, which is a function.

    Parameters
    ----------
    constraint_set : ConstraintSet
    rows : ndarray of int64
        Row numbers, sorted.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    """

    name = "single"

    def __init__(self, constraint_set: ConstraintSet, rows: IntArray, inverse_masses: FloatArray) -> None:
        self.rows = rows
        incidence = constraint_set.incidence[rows]
        atoms = incidence.indices.astype(np.uint32)
        widest = int(np.diff(incidence.indptr).max(initial=0))
        # Of the rows that take their iterations together: places of all or of one, then values and gradients of all.
        places = 3 * max(widest, BLOCK)
        self._given = GivenRows(constraint_set, rows, places + BLOCK * (1 + 3 * widest))
        runs = np.append(ROOM + places, self._given.at_once(BLOCK).ravel())
        # Row by row: its first slot, its first parameter, its kind.
        links = np.zeros((len(rows) + 1, 3), np.uint32)
        links[:, 0], links[:-1, 1], links[:-1, 2] = incidence.indptr, self._given.starts, self._given.kinds
        self._links = links.ravel()
        self.tables = in_one_array(
            (
                *(self._links, atoms, inverse_masses[atoms], room(3 * widest * BLOCK), room(WORDS * BLOCK)),
                *(constraint_set.scale[rows], np.ascontiguousarray(constraint_set.target(0.0)[rows])),
                *(room(3 * len(atoms)), room(len(rows)), runs),
            )
        )
        self._pushes, self._solution = part_of(self.tables, _PUSHES), part_of(self.tables, _SOLUTION)
        self.kernels, self.numbers = Kernels(_positions, _tangents, _apply), self._given.numbers
        self.refuse = self._given.refuse  # type: ignore[method-assign]
        self._made_of = constraint_set, rows, inverse_masses

    def __reduce__(self) -> tuple[type[SingleRows], tuple[object, ...]]:
        return SingleRows, self._made_of  # addresses are of no use elsewhere

    @property
    def pivots(self) -> FloatArray:
        pushes: FloatArray = np.add.reduceat(np.abs(self._pushes), 3 * self._links[:-3:3].astype(np.int64))
        return pushes


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _gather(x, slot, end, atoms, relative, lattice, periodic, room, at):  # type: ignore[no-untyped-def]
    """Positions of a row's atoms from `room[at]` on, as its function gets them."""
    a, b, c = 0.0, 0.0, 0.0
    before = load_point(x, 3 * entry(atoms, slot))
    for p in range(slot, end):
        rolled()
        here = load_point(x, 3 * entry(atoms, p))
        if relative:
            cell, inverse = cell_of(lattice)
            dx, dy, dz = near(here - before, quad(0.0, 0.0, 0.0, 0.0), cell, inverse, periodic)
            a, b, c = a + dx, b + dy, c + dz
            before = here
        else:
            a, b, c = lane(here, 0), lane(here, 1), lane(here, 2)
        put(room, at, a)
        put(room, at + 1, b)
        put(room, at + 2, c)
        at += 3


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _places(x, begin, stop, first, atoms, numbers):  # type: ignore[no-untyped-def]
    """Positions of rows of one atom each, as `rows_at_once` takes them."""
    for i in range(stop - begin):
        g = 3 * entry(atoms, first + i)
        put(numbers, ROOM + i, number(x, g))
        put(numbers, ROOM + BLOCK + i, number(x, g + 1))
        put(numbers, ROOM + 2 * BLOCK + i, number(x, g + 2))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _pushed(begin, stop, first, base, pushes, solution, numbers):  # type: ignore[no-untyped-def]
    """The same of where the multipliers have moved them."""
    for i in range(stop - begin):
        lam, p = number(solution, begin + i), 3 * (first + i)
        put(numbers, ROOM + i, number(base, 3 * i) + lam * number(pushes, p))
        put(numbers, ROOM + BLOCK + i, number(base, 3 * i + 1) + lam * number(pushes, p + 1))
        put(numbers, ROOM + 2 * BLOCK + i, number(base, 3 * i + 2) + lam * number(pushes, p + 2))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _flat(slope, slot, count, masses, pushes):  # type: ignore[no-untyped-def]
    """Whether a gradient has less than `FLAT` of that at the reference along it; `slope` is their product."""
    size = 0.0
    for i in range(count):
        push = number(pushes, 3 * slot + i)
        if push != 0.0:
            size += push * push / number(masses, slot + i // 3)
    return slope < FLAT * size


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply(x, factor, tables):  # type: ignore[no-untyped-def]
    """As `kcons.solvers.called_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms, pushes, solution = piece(u, h, 0), piece(u, h, 1), piece(t, h, _PUSHES), piece(t, h, _SOLUTION)
    for k in range(len(solution)):
        change = factor * number(solution, k)
        for p in range(entry(links, 3 * k), entry(links, 3 * k + 3)):
            rolled()
            g = 3 * entry(atoms, p)
            for i in range(3):
                put(x, g + i, number(x, g + i) + change * number(pushes, 3 * p + i))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(  # type: ignore[no-untyped-def]
    careful, alone, x, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers
):
    """As `kcons.solvers.called_solvers` says; all is careful here."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms, masses, base = piece(u, h, 0), piece(u, h, 1), piece(t, h, 2), piece(t, h, 3)
    state, scale, pushes, solution = piece(t, h, 4), piece(t, h, 5), piece(t, h, _PUSHES), piece(t, h, _SOLUTION)
    if not wanted.size:
        wanted = piece(t, h, 6)
    runs, periodic = piece(h, h, _RUNS), kind != OPEN
    worst, worst_row, most, outs = 0.0, -1, 0, runs[0]
    for begin in range(0, len(solution), BLOCK):
        stop = min(begin + BLOCK, len(solution))
        first, shared = entry(links, 3 * begin), entry(links, 3 * begin + 1) + 2
        rows, apart = runs[1 + begin // (BLOCK // 2)], runs[2 + begin // (BLOCK // 2)]
        if rows != 0:
            _places(x_ref, begin, stop, first, atoms, numbers)
            call_rows(numbers, rows, stop - begin, ROOM, shared, apart, number(numbers, 1), outs)
        for k in range(begin, stop):
            slot, end, parameters = entry(links, 3 * k), entry(links, 3 * k + 3), entry(links, 3 * k + 1)
            relative = entry(links, 3 * k + 2) != FUNCTION
            out = outs + (k - begin) + 3 * (slot - first)
            if rows == 0:
                _gather(x_ref, slot, end, atoms, relative, lattice, periodic, numbers, ROOM)
                call_row(numbers, parameters, ROOM, parameters + 2, number(numbers, 1), out)
            reach = 0.0
            for p in range(slot, end):
                rolled()
                size, far = 0.0, 0.0
                for i in range(3):
                    g, r = number(numbers, out + 1 + 3 * (p - slot) + i), number(x, 3 * entry(atoms, p) + i)
                    put(pushes, 3 * p + i, g * number(masses, p))
                    size, far = size + g * g, far + r * r
                reach += math.sqrt(size * far)
            _gather(x, slot, end, atoms, relative, lattice, periodic, base, 3 * (slot - first))
            at = WORDS * (k - begin)
            put(state, at + ALLOWED, max(ROUNDING * number(scale, k), 2 * EPS * reach))
            put(state, at + PREVIOUS, np.inf)
            put(state, at + LAST, 0.0)
            put(state, at + HALVINGS, 0.0)
            put(solution, k, 0.0)
        # Rows of a block take each iteration together, so that the processor has several under way at once.
        iteration, left = 0, stop - begin
        while left > 0:
            left = 0
            if rows != 0:
                _pushed(begin, stop, first, base, pushes, solution, numbers)
                call_rows(numbers, rows, stop - begin, ROOM, shared, apart, number(numbers, 0), outs)
            for k in range(begin, stop):
                at = WORDS * (k - begin)
                halvings = number(state, at + HALVINGS)
                if halvings < 0.0:
                    continue
                slot, parameters, lam = entry(links, 3 * k), entry(links, 3 * k + 1), number(solution, k)
                count = 3 * (entry(links, 3 * k + 3) - slot)
                out = outs + (k - begin) + 3 * (slot - first)
                if rows == 0:
                    for i in range(count):
                        rolled()
                        r = number(base, 3 * (slot - first) + i) + lam * number(pushes, 3 * slot + i)
                        put(numbers, ROOM + i, r)
                    call_row(numbers, parameters, ROOM, parameters + 2, number(numbers, 0), out)
                slope = 0.0
                for i in range(count):
                    rolled()
                    slope += number(numbers, out + 1 + i) * number(pushes, 3 * slot + i)
                off = miss(number(numbers, out), number(wanted, k), number(numbers, parameters + 1))
                whole, error, previous = number(scale, k), abs(off), number(state, at + PREVIOUS)
                if not (error < np.inf):
                    return False, np.inf, iteration, k
                rounding = number(state, at + ALLOWED)
                if error <= rounding and (error <= NEWTON_TOLERANCE * whole or error > 0.1 * previous):
                    # A gradient must not have turned by 90 degrees or more within the step.
                    if not (slope > 0.0) or (iteration > MANY_ITERATIONS and _flat(slope, slot, count, masses, pushes)):
                        return False, np.inf, iteration, k
                    put(state, at + HALVINGS, -1.0)
                    if error >= worst * whole:
                        worst, worst_row = error / whole, k
                    continue
                if iteration == MAX_ITERATIONS or halvings > MAX_HALVINGS:
                    return False, error / whole, iteration, k
                left += 1
                last = number(state, at + LAST)
                if previous < np.inf and not (error < 0.999 * previous) and error > NEAR * whole:
                    put(state, at + HALVINGS, halvings + 1.0)
                    put(solution, k, last + 0.5 * (lam - last))
                else:
                    put(state, at + PREVIOUS, error)
                    put(state, at + LAST, lam)
                    put(state, at + HALVINGS, 0.0)
                    put(solution, k, lam + off / slope)
            iteration += 1
        most = max(most, iteration - 1)
    if alone:
        _apply(x, 1.0, tables)
        if inv_dt != 0.0:
            _apply(velocities, inv_dt, tables)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, x, y, wanted, lattice, kind, tables, numbers):  # type: ignore[no-untyped-def]
    """As `kcons.solvers.called_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms, masses = piece(u, h, 0), piece(u, h, 1), piece(t, h, 2)
    pushes, solution, driven = piece(t, h, _PUSHES), piece(t, h, _SOLUTION), wanted.size > 0
    runs, periodic = piece(h, h, _RUNS), kind != OPEN
    worst, worst_row, most, outs = 0.0, -1, 0, runs[0]
    begin, rows = 0, np.int64(0)
    for k in range(len(solution)):
        slot, end, parameters = entry(links, 3 * k), entry(links, 3 * k + 3), entry(links, 3 * k + 1)
        if k % BLOCK == 0:
            begin, rows = k, runs[1 + k // (BLOCK // 2)]
            if rows != 0:
                stop = min(begin + BLOCK, len(solution))
                _places(x, begin, stop, slot, atoms, numbers)
                apart = runs[2 + k // (BLOCK // 2)]
                call_rows(numbers, rows, stop - begin, ROOM, parameters + 2, apart, number(numbers, 1), outs)
        out = outs + 4 * (k - begin)
        if rows == 0:
            out = outs
            _gather(x, slot, end, atoms, entry(links, 3 * k + 2) != FUNCTION, lattice, periodic, numbers, ROOM)
            call_row(numbers, parameters, ROOM, parameters + 2, number(numbers, 1), out)
        goal = number(wanted, k) if driven else 0.0
        size, off, whole = abs(goal), goal, 0.0
        for p in range(slot, end):
            rolled()
            for i in range(3):
                g = number(numbers, out + 1 + 3 * (p - slot) + i)
                part = g * number(y, 3 * entry(atoms, p) + i)
                off -= part
                size += abs(part)
                put(pushes, 3 * p + i, g * number(masses, p))
                whole += g * g * number(masses, p)
        if not (size < np.inf):
            return False, np.inf, 0, k
        inverse = 1.0 / whole if whole > 0.0 else 0.0
        lam, error, iteration = off * inverse, np.inf, 1
        while True:
            off = goal
            for p in range(slot, end):
                rolled()
                for i in range(3):
                    speed = number(y, 3 * entry(atoms, p) + i) + lam * number(pushes, 3 * p + i)
                    off -= number(numbers, out + 1 + 3 * (p - slot) + i) * speed
            if abs(off) <= SPEED_TOLERANCE * size or not (abs(off) < 0.5 * error):
                break
            error = abs(off)
            lam += off * inverse
            iteration += 1
        put(solution, k, lam)
        if not (abs(off) <= SPEED_ROUNDINGS * SPEED_TOLERANCE * size):
            return False, abs(off), iteration, k
        if abs(off) >= worst:
            worst, worst_row = abs(off), k
        most = max(most, iteration)
    if alone:
        _apply(y, 1.0, tables)
    return True, worst, most, worst_row
