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
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import halves, integers, table_array
from kcons.solvers.kernels.lattices import OPEN, lattice_numbers
from kcons.solvers.kernels.two_and_four_wide import (
    extract,
    keep_loop_rolled,
    load_double,
    load_index,
    load_point,
    quad,
    store_double,
)
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.sparse.mixed_rows import miss, near
from kcons.solvers.sparse.row_functions import BLOCK, FUNCTION, ROOM, GivenRows, call_row, call_rows
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


class SingleRows(AddressableSolver):
    """Solver for clusters of one row, which is a function.

    Parameters
    ----------
    constraint_set : ConstraintSet
    rows : ndarray of int64
        Row numbers, sorted.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    """

    name = "SingleRows"

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

    @property
    def pivots(self) -> FloatArray:
        pushes: FloatArray = np.add.reduceat(np.abs(self._pushes), 3 * self._links[:-3:3].astype(np.int64))
        return pushes


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _gather(x, slot, end, atoms, relative, lattice, periodic, room, at):
    """Positions of a row's atoms from `room[at]` on, as its function gets them."""
    a, b, c = 0.0, 0.0, 0.0
    before = load_point(x, 3 * load_index(atoms, slot))
    for p in range(slot, end):
        keep_loop_rolled()
        here = load_point(x, 3 * load_index(atoms, p))
        if relative:
            dx, dy, dz = near(here - before, quad(0.0, 0.0, 0.0, 0.0), lattice_numbers(lattice), periodic)
            a, b, c = a + dx, b + dy, c + dz
            before = here
        else:
            a, b, c = extract(here, 0), extract(here, 1), extract(here, 2)
        store_double(room, at, a)
        store_double(room, at + 1, b)
        store_double(room, at + 2, c)
        at += 3


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _places(x, begin, stop, first, atoms, numbers):
    """Positions of rows of one atom each, as `rows_at_once` takes them."""
    for i in range(stop - begin):
        g = 3 * load_index(atoms, first + i)
        store_double(numbers, ROOM + i, load_double(x, g))
        store_double(numbers, ROOM + BLOCK + i, load_double(x, g + 1))
        store_double(numbers, ROOM + 2 * BLOCK + i, load_double(x, g + 2))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _pushed(begin, stop, first, base, pushes, solution, numbers):
    """The same of where the multipliers have moved them."""
    for i in range(stop - begin):
        lam, p = load_double(solution, begin + i), 3 * (first + i)
        store_double(numbers, ROOM + i, load_double(base, 3 * i) + lam * load_double(pushes, p))
        store_double(numbers, ROOM + BLOCK + i, load_double(base, 3 * i + 1) + lam * load_double(pushes, p + 1))
        store_double(numbers, ROOM + 2 * BLOCK + i, load_double(base, 3 * i + 2) + lam * load_double(pushes, p + 2))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _flat(slope, slot, count, masses, pushes):
    """Whether a gradient has less than `FLAT` of that at the reference along it; `slope` is their product."""
    size = 0.0
    for i in range(count):
        push = load_double(pushes, 3 * slot + i)
        if push != 0.0:
            size += push * push / load_double(masses, slot + i // 3)
    return slope < FLAT * size


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply(x, factor, tables):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms = table_array(u, h, 0), table_array(u, h, 1)
    pushes, solution = table_array(t, h, _PUSHES), table_array(t, h, _SOLUTION)
    for k in range(len(solution)):
        change = factor * load_double(solution, k)
        for p in range(load_index(links, 3 * k), load_index(links, 3 * k + 3)):
            keep_loop_rolled()
            g = 3 * load_index(atoms, p)
            for i in range(3):
                store_double(x, g + i, load_double(x, g + i) + change * load_double(pushes, 3 * p + i))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(alone, x, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says; steps that gain nothing are halved."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms, masses, base = table_array(u, h, 0), table_array(u, h, 1), table_array(t, h, 2), table_array(t, h, 3)
    state, scale = table_array(t, h, 4), table_array(t, h, 5)
    pushes, solution = table_array(t, h, _PUSHES), table_array(t, h, _SOLUTION)
    if not wanted.size:
        wanted = table_array(t, h, 6)
    runs, periodic = table_array(h, h, _RUNS), kind != OPEN
    worst, worst_row, most, outs = 0.0, -1, 0, runs[0]
    for begin in range(0, len(solution), BLOCK):
        stop = min(begin + BLOCK, len(solution))
        first, shared = load_index(links, 3 * begin), load_index(links, 3 * begin + 1) + 2
        rows, apart = runs[1 + begin // (BLOCK // 2)], runs[2 + begin // (BLOCK // 2)]
        if rows != 0:
            _places(x_ref, begin, stop, first, atoms, numbers)
            call_rows(numbers, rows, stop - begin, ROOM, shared, apart, load_double(numbers, 1), outs)
        for k in range(begin, stop):
            slot, end, parameters = load_index(links, 3 * k), load_index(links, 3 * k + 3), load_index(links, 3 * k + 1)
            relative = load_index(links, 3 * k + 2) != FUNCTION
            out = outs + (k - begin) + 3 * (slot - first)
            if rows == 0:
                _gather(x_ref, slot, end, atoms, relative, lattice, periodic, numbers, ROOM)
                call_row(numbers, parameters, ROOM, parameters + 2, load_double(numbers, 1), out)
            reach = 0.0
            for p in range(slot, end):
                keep_loop_rolled()
                size, far = 0.0, 0.0
                for i in range(3):
                    g = load_double(numbers, out + 1 + 3 * (p - slot) + i)
                    r = load_double(x, 3 * load_index(atoms, p) + i)
                    store_double(pushes, 3 * p + i, g * load_double(masses, p))
                    size, far = size + g * g, far + r * r
                reach += math.sqrt(size * far)
            _gather(x, slot, end, atoms, relative, lattice, periodic, base, 3 * (slot - first))
            at = WORDS * (k - begin)
            store_double(state, at + ALLOWED, max(ROUNDING * load_double(scale, k), 2 * EPS * reach))
            store_double(state, at + PREVIOUS, np.inf)
            store_double(state, at + LAST, 0.0)
            store_double(state, at + HALVINGS, 0.0)
            store_double(solution, k, 0.0)
        # Rows of a block take each iteration together, so that the processor has several under way at once.
        iteration, left = 0, stop - begin
        while left > 0:
            left = 0
            if rows != 0:
                _pushed(begin, stop, first, base, pushes, solution, numbers)
                call_rows(numbers, rows, stop - begin, ROOM, shared, apart, load_double(numbers, 0), outs)
            for k in range(begin, stop):
                at = WORDS * (k - begin)
                halvings = load_double(state, at + HALVINGS)
                if halvings < 0.0:
                    continue
                slot, parameters, lam = load_index(links, 3 * k), load_index(links, 3 * k + 1), load_double(solution, k)
                count = 3 * (load_index(links, 3 * k + 3) - slot)
                out = outs + (k - begin) + 3 * (slot - first)
                if rows == 0:
                    for i in range(count):
                        keep_loop_rolled()
                        r = load_double(base, 3 * (slot - first) + i) + lam * load_double(pushes, 3 * slot + i)
                        store_double(numbers, ROOM + i, r)
                    call_row(numbers, parameters, ROOM, parameters + 2, load_double(numbers, 0), out)
                slope = 0.0
                for i in range(count):
                    keep_loop_rolled()
                    slope += load_double(numbers, out + 1 + i) * load_double(pushes, 3 * slot + i)
                off = miss(load_double(numbers, out), load_double(wanted, k), load_double(numbers, parameters + 1))
                whole, error, previous = load_double(scale, k), abs(off), load_double(state, at + PREVIOUS)
                if not (error < np.inf):
                    return False, np.inf, iteration, k
                rounding = load_double(state, at + ALLOWED)
                if error <= rounding and (error <= NEWTON_TOLERANCE * whole or error > 0.1 * previous):
                    # A gradient must not have turned by 90 degrees or more within the step.
                    if not (slope > 0.0) or (iteration > MANY_ITERATIONS and _flat(slope, slot, count, masses, pushes)):
                        return False, np.inf, iteration, k
                    store_double(state, at + HALVINGS, -1.0)
                    if error >= worst * whole:
                        worst, worst_row = error / whole, k
                    continue
                if iteration == MAX_ITERATIONS or halvings > MAX_HALVINGS:
                    return False, error / whole, iteration, k
                left += 1
                last = load_double(state, at + LAST)
                if previous < np.inf and not (error < 0.999 * previous) and error > NEAR * whole:
                    store_double(state, at + HALVINGS, halvings + 1.0)
                    store_double(solution, k, last + 0.5 * (lam - last))
                else:
                    store_double(state, at + PREVIOUS, error)
                    store_double(state, at + LAST, lam)
                    store_double(state, at + HALVINGS, 0.0)
                    store_double(solution, k, lam + off / slope)
            iteration += 1
        most = max(most, iteration - 1)
    if alone:
        _apply(x, 1.0, tables)
        if inv_dt != 0.0:
            _apply(velocities, inv_dt, tables)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, y, x, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    links, atoms, masses = table_array(u, h, 0), table_array(u, h, 1), table_array(t, h, 2)
    pushes, solution, driven = table_array(t, h, _PUSHES), table_array(t, h, _SOLUTION), wanted.size > 0
    runs, periodic = table_array(h, h, _RUNS), kind != OPEN
    worst, worst_row, most, outs = 0.0, -1, 0, runs[0]
    begin, rows = 0, np.int64(0)
    for k in range(len(solution)):
        slot, end, parameters = load_index(links, 3 * k), load_index(links, 3 * k + 3), load_index(links, 3 * k + 1)
        if k % BLOCK == 0:
            begin, rows = k, runs[1 + k // (BLOCK // 2)]
            if rows != 0:
                stop = min(begin + BLOCK, len(solution))
                _places(x, begin, stop, slot, atoms, numbers)
                apart = runs[2 + k // (BLOCK // 2)]
                call_rows(numbers, rows, stop - begin, ROOM, parameters + 2, apart, load_double(numbers, 1), outs)
        out = outs + 4 * (k - begin)
        if rows == 0:
            out = outs
            _gather(x, slot, end, atoms, load_index(links, 3 * k + 2) != FUNCTION, lattice, periodic, numbers, ROOM)
            call_row(numbers, parameters, ROOM, parameters + 2, load_double(numbers, 1), out)
        goal = load_double(wanted, k) if driven else 0.0
        size, off, whole = abs(goal), goal, 0.0
        for p in range(slot, end):
            keep_loop_rolled()
            for i in range(3):
                g = load_double(numbers, out + 1 + 3 * (p - slot) + i)
                part = g * load_double(y, 3 * load_index(atoms, p) + i)
                off -= part
                size += abs(part)
                store_double(pushes, 3 * p + i, g * load_double(masses, p))
                whole += g * g * load_double(masses, p)
        if not (size < np.inf):
            return False, np.inf, 0, k
        inverse = 1.0 / whole if whole > 0.0 else 0.0
        lam, error, iteration = off * inverse, np.inf, 1
        while True:
            off = goal
            for p in range(slot, end):
                keep_loop_rolled()
                for i in range(3):
                    speed = load_double(y, 3 * load_index(atoms, p) + i) + lam * load_double(pushes, 3 * p + i)
                    off -= load_double(numbers, out + 1 + 3 * (p - slot) + i) * speed
            if abs(off) <= SPEED_TOLERANCE * size or not (abs(off) < 0.5 * error):
                break
            error = abs(off)
            lam += off * inverse
            iteration += 1
        store_double(solution, k, lam)
        if not (abs(off) <= SPEED_ROUNDINGS * SPEED_TOLERANCE * size):
            return False, abs(off), iteration, k
        if abs(off) >= worst:
            worst, worst_row = abs(off), k
        most = max(most, iteration)
    if alone:
        _apply(y, 1.0, tables)
    return True, worst, most, worst_row
