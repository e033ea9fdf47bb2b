"""Newton's method for clusters of rows by sparse elimination, one after another, whatever the rows are.

A solver gives functions of its pieces `p`, pointers and a few numbers, and of the rows first to last of a cluster. All
tables begin with the same pieces:

clusters, atoms of all of them, and where their atoms begin; moves of the atoms and their inverse masses, as quads;
solution; pivots; links, four numbers a row, of which the first two say where its entries and its targets begin; columns
of the entries, and targets, see `kcons.solvers.sparse.elimination`; state, some numbers a row, of which the last two
are the change of its pivot and its right-hand side; entries.

An entry's line of four doubles holds A_lk / pivot and A_kl (k < l) and their accumulated changes, which are left at
zero for the next time. Positions change once, after every cluster has converged, so that a failure leaves them as they
were.
"""

from __future__ import annotations

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import AddressableSolver
from kcons.solvers.kernels.aligned_memory import part_of
from kcons.solvers.kernels.array_views import at_piece, halves, integers
from kcons.solvers.kernels.two_and_four_wide import (
    add_to_point,
    keep_loop_rolled,
    load_double,
    load_index,
    load_pair,
    load_quad,
    store_double,
    store_pair,
    swapped,
)
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import (
    MAX_ITERATIONS,
    NEWTON_TOLERANCE,
    ROUNDINGS,
    SPEED_ROUNDINGS,
    SPEED_TOLERANCE,
)

#: The pieces that all tables begin with, how many they are, and what functions call those that they are given.
CLUSTERS, ATOMS, ATOM_START, MOVES, SOLUTION, PIVOTS, LINKS, COLUMNS, TARGETS, STATE, ENTRIES, COMMON = range(12)
COMMON_NAMES = "atoms moves solution pivots links columns targets state entries"


class SparseSolver(AddressableSolver):
    """Base of the solvers whose tables begin so."""

    @property
    def pivots(self) -> FloatArray:
        pivots: FloatArray = part_of(self.tables, PIVOTS)
        return pivots


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def common_pieces(tables):
    """Those of `COMMON_NAMES`."""
    t, h, u = tables, integers(tables), halves(tables)
    return (
        at_piece(u, h, ATOMS), at_piece(t, h, MOVES), at_piece(t, h, SOLUTION), at_piece(t, h, PIVOTS),
        at_piece(u, h, LINKS), at_piece(u, h, COLUMNS), at_piece(u, h, TARGETS), at_piece(t, h, STATE),
        at_piece(t, h, ENTRIES),
    )  # fmt: skip


# Spliced into the loops: what is called there from them, with arrays, costs small clusters a sixth of their time.


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def eliminate_columns(begin, end, t, targets, entries):
    """Take the products of a row's entries begin to end from those of its columns; where the next targets begin."""
    for p in range(begin, end - 1):
        keep_loop_rolled()
        mine = load_pair(entries, 4 * p)
        for q in range(p + 1, end):
            keep_loop_rolled()
            update(t, mine, load_pair(entries, 4 * q), targets, entries)
            t += 1
    return t


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def update(t, one, two, targets, entries):
    """Take the product of two entries of a row, to columns l and m, from A_ml and A_lm."""
    e = 4 * load_index(targets, t) + 2
    store_pair(entries, e, load_pair(entries, e) - swapped(one) * two)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def substitute_forward(first, last, links, columns, state, entries, width):
    """With the factor kept from before; `width` numbers of the state belong to a row."""
    begin = load_index(links, 4 * first)
    for k in range(first, last):
        right = load_double(state, width * k + width - 1)
        end = load_index(links, 4 * k + 4)
        for p in range(begin, end):
            keep_loop_rolled()
            l = width * load_index(columns, p) + width - 1
            store_double(state, l, load_double(state, l) - load_double(entries, 4 * p) * right)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def substitute_back(k, begin, end, columns, state, entries, pivots, solution, width):
    """The step of the multiplier of row k with the entries begin to end, which is added to it."""
    step = load_double(state, width * k + width - 1)
    for p in range(begin, end):
        keep_loop_rolled()
        step -= load_double(entries, 4 * p + 1) * load_double(state, width * load_index(columns, p) + width - 1)
    step *= load_double(pivots, k)
    store_double(state, width * k + width - 1, step)
    store_double(solution, k, load_double(solution, k) + step)
    return step


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _largest(p, first, last, size):
    """The row whose ``size(p, k)`` is largest, or the first where it is not finite."""
    row, largest = first, 0.0
    for k in range(first, last):
        e = size(p, k)
        if not (e <= largest):
            row, largest = k, e
            if not (e < np.inf):
                break
    return row


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _within_rounding(p, first, last, roundings):
    """Whether each row is off by some of its roundings, see `tolerances.ROUNDINGS`."""
    most = 0.0
    for k in range(first, last):
        most = max(most, roundings(p, k))
    return most <= ROUNDINGS * np.sqrt(last - first)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def solve_positions(
    alone, x_new, velocities, inv_dt, tables, p, begin, measure, size, roundings, factor, forward, backward, turned
):  # fmt: skip
    """As `kcons.solvers.addressable_solvers` says.

    `begin` and `measure` give the largest and the total error of a cluster, `size` and `roundings` that of one row,
    relative and in units of its rounding; `turned` a row whose gradient has turned too far, or -1.
    """
    h = integers(tables)
    clusters, atom_start = at_piece(h, h, CLUSTERS), at_piece(h, h, ATOM_START)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        error, total = begin(p, first, last, atom_start[c], atom_start[c + 1])
        previous, factored, iteration = np.inf, False, 0
        while True:
            # max() may drop a NaN; the sum cannot.
            if not (total < np.inf):
                return False, np.inf, iteration, _largest(p, first, last, size)
            # Newton runs away, or has had its time.
            if iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0):
                return False, error, iteration, _largest(p, first, last, size)
            if error <= NEWTON_TOLERANCE:
                break
            # Rounding may stop short of it in ill-conditioned sets; what the positions resolve is enough.
            if error > 0.5 * previous and _within_rounding(p, first, last, roundings):
                break
            ratio = error / previous
            # A step with the factor there is may gain enough for its lower price.
            if factored and (error * ratio <= NEWTON_TOLERANCE or ratio < 1e-4):
                forward(p, first, last)
            else:
                factor(p, first, last)
                factored = True
            backward(p, first, last)
            previous = error
            iteration += 1
            error, total = measure(p, first, last)
        bad = turned(p, first, last, iteration)
        if bad >= 0:
            return False, np.inf, iteration, bad
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    if alone:
        apply(x_new, 1.0, tables)
        if inv_dt != 0.0:
            apply(velocities, inv_dt, tables)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def solve_tangents(alone, y, tables, p, begin, measure, size, factor, forward, backward):
    """As `kcons.solvers.addressable_solvers` says.

    `begin` gives the largest speed of a cluster, and a total that is finite where all is sound.
    """
    h = integers(tables)
    clusters, atom_start = at_piece(h, h, CLUSTERS), at_piece(h, h, ATOM_START)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        largest, total = begin(p, first, last, atom_start[c], atom_start[c + 1])
        if not (total < np.inf):
            return False, np.inf, 0, _largest(p, first, last, size)
        factor(p, first, last)
        allowed, previous, iteration = SPEED_TOLERANCE * largest, np.inf, 0
        while True:
            backward(p, first, last)
            iteration += 1
            error, total = measure(p, first, last)
            if not (total < np.inf):
                return False, np.inf, iteration, _largest(p, first, last, size)
            # Refinement goes on as long as it helps; the least error is accepted.
            if error <= allowed or iteration > 8 or not (error < 0.5 * previous):
                break
            previous = error
            forward(p, first, last)
        if error > SPEED_ROUNDINGS * allowed:
            return False, error, iteration, _largest(p, first, last, size)
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    if alone:
        apply(y, 1.0, tables)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FAST, error_model="numpy")
def apply(x, factor, tables):
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    atoms, moves = at_piece(halves(tables), h, ATOMS), at_piece(tables, h, MOVES)
    for a in range(h[2 * ATOMS + 1] - h[2 * ATOMS]):
        add_to_point(x, 3 * load_index(atoms, a), factor * load_quad(moves, 4 * a))
