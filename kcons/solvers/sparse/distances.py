"""Distance rows of any connectivity: sparse elimination, one cluster after another.

Works on relative quantities: displacements of the cluster's atoms, and bond vectors made from them;
positions change once, after every cluster has converged, so that a failure leaves them as they were.

A row's line of eight doubles holds its vectors r and s, the accumulated change of its pivot, and its
right-hand side: r0 s0 r1 s1 r2 s2 change right. An entry's line of four doubles holds A_lk / pivot and A_kl
(k < l) and their accumulated changes, which are left at zero for the next time. `links` holds, row by row,
where its entries and its targets begin and its two ends; atoms are quads (move, inverse mass).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.distance_clusters import resolved
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import at_first, at_piece, halves, integers, table_array
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
    store_first,
    store_line,
    store_pair,
    store_quad,
    swapped,
)
from kcons.solvers.sparse.elimination import FAST, make_pattern, number_atoms
from kcons.solvers.tolerances import (
    EPS,
    MAX_ITERATIONS,
    NEAR,
    NEWTON_TOLERANCE,
    PIVOT_TOLERANCE,
    ROUNDING,
    ROUNDINGS,
    SPEED_ROUNDINGS,
    SPEED_TOLERANCE,
)

#: Places of the two last numbers in a row's line.
CHANGE, RIGHT = 6, 7
#: Of the pieces of `SparseDistances.tables`, those that are named.
_PAIRS, _LENGTHS, _STATE, _PIVOTS, _MOVES, _SOLUTION = 9, 10, 11, 13, 16, 17


class SparseDistances(AddressableSolver):
    """Solver for distance rows in clusters of any shape.

    Parameters
    ----------
    rows : ndarray of int64, shape (n_rows,)
        Row numbers in the set; whole clusters only.
    pairs : ndarray of int64, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    eliminate_last : ndarray of bool, shape (n_rows,), optional
        Rows that depend on the others of their cluster, see `make_pattern`.
    """

    name = "SparseDistances"

    def __init__(
        self,
        rows: IntArray,
        pairs: IntArray,
        lengths: FloatArray,
        inverse_masses: FloatArray,
        eliminate_last: NDArray[np.bool_] | None = None,
    ) -> None:
        self._made_of = rows, pairs, lengths, inverse_masses, eliminate_last
        atoms, local = np.unique(pairs, return_inverse=True)
        local = local.reshape(pairs.shape)
        keep = inverse_masses[atoms][local] > 0
        row_start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
        pattern = make_pattern(row_start, local[keep].astype(np.int64), len(atoms), eliminate_last)
        self.rows: IntArray = rows[pattern.order]
        pairs = pairs[pattern.order]
        numbered, atom_start, numbers = number_atoms(
            pairs.ravel(), np.arange(0, 2 * len(rows) + 1, 2), pattern.clusters, len(inverse_masses)
        )
        ends = numbers.reshape(-1, 2)
        w = inverse_masses[numbered]
        links = np.zeros((len(rows) + 1, 4), np.uint32)
        links[:, 0], links[:, 1], links[:-1, 2:] = pattern.start, pattern.target_start, ends
        couplings = plain_if_small(_couplings, len(pattern.columns))(pattern.start, pattern.columns, ends, w)
        n, n_entries, n_atoms = len(rows), len(pattern.columns), len(numbered)
        self.tables = in_one_array(
            (
                *(pattern.clusters, numbered, atom_start, w, links.ravel(), pattern.columns, pattern.targets),
                *(couplings, w[ends].sum(axis=1), pairs.astype(np.uint32).ravel(), lengths[pattern.order]),
                # As the module says: lines of rows and of entries; pivots. Then where rows began, where
                # atoms were, moves and solution.
                *(room(8 * n), room(4 * n_entries), room(n), room(4 * n), room(4 * n_atoms)),
                *(room(4 * n_atoms), room(n)),
            )
        )
        self.kernels, self.numbers = Kernels(_positions, _tangents, _apply, resolved=_resolved), np.zeros(3)
        self._solution, self._bonds = (
            part_of(self.tables, _SOLUTION),
            part_of(self.tables, _STATE).reshape(-1, 8)[:, 1:6:2],
        )

    @property
    def lengths(self) -> FloatArray:
        """Lengths used where a request names none, in the order of `rows`."""
        lengths: FloatArray = part_of(self.tables, _LENGTHS)
        return lengths

    @property
    def pivots(self) -> FloatArray:
        pivots: FloatArray = part_of(self.tables, _PIVOTS)
        return pivots

    def _multipliers(self) -> FloatArray:
        # The kernels' are those of s . r, and not of |r| - d.
        found: FloatArray = np.sqrt(np.einsum("ki,ki->k", self._bonds, self._bonds))
        found *= self._solution
        return found


# -- elimination and substitution ----------------------------------------------------------------------------


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _eliminate(p, x, y, z, inverse, right, columns, couplings, state, entries):
    """Assemble entry p of a row (vectors x, y, z: s and r) and take it from its column; returns the entry."""
    l = 8 * load_index(columns, p)
    both = x * load_pair(state, l) + y * load_pair(state, l + 2) + z * load_pair(state, l + 4)
    both = load_double(couplings, p) * both + load_pair(entries, 4 * p + 2)
    low, up = inverse * extract(both, 0), extract(both, 1)
    done = pair(low, up)
    store_quad(entries, 4 * p, settled(done))
    store_pair(state, l + CHANGE, load_pair(state, l + CHANGE) - low * pair(up, right))
    return done


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def update(t, one, two, targets, entries):
    """Take the product of two entries of a row, to columns l and m, from A_ml and A_lm."""
    e = 4 * load_index(targets, t) + 2
    store_pair(entries, e, load_pair(entries, e) - swapped(one) * two)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor(first, last, links, columns, targets, couplings, weights, state, entries, pivots):
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep."""
    begin, t = load_index(links, 4 * first), load_index(links, 4 * first + 1)
    for k in range(first, last):
        x, y, z = swapped(load_pair(state, 8 * k)), swapped(load_pair(state, 8 * k + 2)), load_pair(state, 8 * k + 4)
        z = swapped(z)
        inner = extract(x, 0) * extract(x, 1) + extract(y, 0) * extract(y, 1) + extract(z, 0) * extract(z, 1)
        whole = load_double(weights, k) * inner
        d = whole + load_double(state, 8 * k + CHANGE)
        right = load_double(state, 8 * k + RIGHT)
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        store_double(pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        # Few entries are the rule; spelt out, their numbers stay in registers.
        count = end - begin
        if count == 1:
            _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
        elif count == 2:
            one = _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
            two = _eliminate(begin + 1, x, y, z, inverse, right, columns, couplings, state, entries)
            update(t, one, two, targets, entries)
            t += 1
        elif count == 3:
            one = _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
            two = _eliminate(begin + 1, x, y, z, inverse, right, columns, couplings, state, entries)
            three = _eliminate(begin + 2, x, y, z, inverse, right, columns, couplings, state, entries)
            update(t, one, two, targets, entries)
            update(t + 1, one, three, targets, entries)
            update(t + 2, two, three, targets, entries)
            t += 3
        else:
            for p in range(begin, end):
                keep_loop_rolled()
                _eliminate(p, x, y, z, inverse, right, columns, couplings, state, entries)
            for p in range(begin, end - 1):
                keep_loop_rolled()
                mine = load_pair(entries, 4 * p)
                for q in range(p + 1, end):
                    keep_loop_rolled()
                    update(t, mine, load_pair(entries, 4 * q), targets, entries)
                    t += 1
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _eliminate_symmetric(p, sx, sy, sz, inverse, right, columns, couplings, state, entries):
    l = 8 * load_index(columns, p)
    inner = sx * load_double(state, l + 1) + sy * load_double(state, l + 3) + sz * load_double(state, l + 5)
    up = load_double(couplings, p) * inner + load_double(entries, 4 * p + 2)
    low = up * inverse
    store_quad(entries, 4 * p, settled(pair(low, up)))
    store_pair(state, l + CHANGE, load_pair(state, l + CHANGE) - low * pair(up, right))
    return low, up


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _update_symmetric(t, low, up, targets, entries):
    e = 4 * load_index(targets, t) + 2
    store_double(entries, e, load_double(entries, e) - low * up)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor_symmetric(first, last, links, columns, targets, couplings, weights, state, entries, pivots):
    """`_factor` for r = s: half the work."""
    begin, t = load_index(links, 4 * first), load_index(links, 4 * first + 1)
    for k in range(first, last):
        sx, sy, sz = load_double(state, 8 * k + 1), load_double(state, 8 * k + 3), load_double(state, 8 * k + 5)
        whole = load_double(weights, k) * (sx * sx + sy * sy + sz * sz)
        d = whole + load_double(state, 8 * k + CHANGE)
        right = load_double(state, 8 * k + RIGHT)
        inverse = 1.0 / d if d > PIVOT_TOLERANCE * whole else 0.0
        store_double(pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        count = end - begin
        if count == 1:
            _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
        elif count == 2:
            low, _up = _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _low2, up2 = _eliminate_symmetric(begin + 1, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _update_symmetric(t, low, up2, targets, entries)
            t += 1
        elif count == 3:
            low, _up = _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            low2, up2 = _eliminate_symmetric(begin + 1, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _low3, up3 = _eliminate_symmetric(begin + 2, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _update_symmetric(t, low, up2, targets, entries)
            _update_symmetric(t + 1, low, up3, targets, entries)
            _update_symmetric(t + 2, low2, up3, targets, entries)
            t += 3
        else:
            for p in range(begin, end):
                keep_loop_rolled()
                _eliminate_symmetric(p, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            for p in range(begin, end - 1):
                keep_loop_rolled()
                low = load_double(entries, 4 * p)
                for q in range(p + 1, end):
                    keep_loop_rolled()
                    _update_symmetric(t, low, load_double(entries, 4 * q + 1), targets, entries)
                    t += 1
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _forward(first, last, links, columns, state, entries):
    """Forward substitution with the factor kept from before."""
    begin = load_index(links, 4 * first)
    for k in range(first, last):
        right = load_double(state, 8 * k + RIGHT)
        end = load_index(links, 4 * k + 4)
        for p in range(begin, end):
            keep_loop_rolled()
            l = 8 * load_index(columns, p) + RIGHT
            store_double(state, l, load_double(state, l) - load_double(entries, 4 * p) * right)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _backward(first, last, links, columns, state, entries, pivots, moves, solution):
    """Backward substitution; adds to the multipliers and moves the atoms along s in the same sweep."""
    end = load_index(links, 4 * last)
    for back in range(last - first):
        k = last - 1 - back
        # The whole line is read before a part of it is written: the other way round the processor waits.
        s = second_vector(state, 8 * k)
        step = load_double(state, 8 * k + RIGHT)
        begin = load_index(links, 4 * k)
        for p in range(begin, end):
            keep_loop_rolled()
            step -= load_double(entries, 4 * p + 1) * load_double(state, 8 * load_index(columns, p) + RIGHT)
        end = begin
        step *= load_double(pivots, k)
        store_double(state, 8 * k + RIGHT, step)
        store_double(solution, k, load_double(solution, k) + step)
        i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
        store_quad(moves, i, load_quad(moves, i) + (step * load_double(moves, i + 3)) * s)
        store_quad(moves, j, load_quad(moves, j) - (step * load_double(moves, j + 3)) * s)


# -- control of the steps, whatever the rows are; a step may reuse the factor of the one before ---------------

# Spliced into the loops: what is called there from them, with arrays, costs small clusters a sixth of their time.


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def hopeless(iteration, error, previous):
    """Whether Newton runs away, or has had its time."""
    return iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def stalled(iteration, error, previous, excess, n_rows):
    """Whether nothing is to be gained, where the largest residual is `excess` roundings."""
    return iteration > 4 and error > 0.1 * previous and excess * excess <= ROUNDINGS * ROUNDINGS * n_rows


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def factor_serves(factored, error, previous):
    """Whether a step with the factor there is gains enough for its lower price."""
    ratio = error / previous
    return factored and (error * ratio <= NEWTON_TOLERANCE or ratio < 1e-4)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def refines(iteration, error, previous, allowed):
    """Whether one refinement of tangents more is worth it: as long as it helps; the least error is accepted."""
    return not (error <= allowed or iteration > 8 or not (error < 0.5 * previous))


# -- what other kernels call ----------------------------------------------------------------------------------


@njit(cache=True)
def _couplings(start, columns, ends, w):
    """c_kl with (A M^-1 A^T)_kl = c_kl s_k . s_l for each stored entry; 0 where there is only fill."""
    coupling = np.zeros(len(columns))
    for k in range(len(start) - 1):
        i, j = ends[k, 0], ends[k, 1]
        for e in range(start[k], start[k + 1]):
            l = columns[e]
            i2, j2 = ends[l, 0], ends[l, 1]
            total = 0.0
            if i == i2:
                total += w[i]
            if j == j2:
                total += w[j]
            if i == j2:
                total -= w[i]
            if j == i2:
                total -= w[j]
            coupling[e] = total
    return coupling


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin(first, last, first_atom, last_atom, x_new, x_ref, lengths, cell, periodic, atoms, w, links,
    state, starts, places, moves, solution,
):  # fmt: skip
    """Reference vectors s and current vectors q of a cluster; largest and total relative error of the lengths."""
    for a in range(first_atom, last_atom):
        g = 3 * load_index(atoms, a)
        store_quad(places, 4 * a, load_point(x_ref, g))
        store_quad(moves, 4 * a, load_point(x_new, g))
    error, total = 0.0, 0.0
    for k in range(first, last):
        i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
        s = load_quad(places, i) - load_quad(places, j)
        q = load_quad(moves, i) - load_quad(moves, j)
        if periodic:
            s, q = _image(s, cell), _image(q, cell)
        d2 = load_double(lengths, k) * load_double(lengths, k)
        miss = 0.5 * (d2 - dot(q, q))
        store_line(state, 8 * k, q, s, pair(0.0, miss))
        store_quad(starts, 4 * k, q)
        inverse = 1.0 / d2
        store_double(starts, 4 * k + 3, inverse)
        store_double(solution, k, 0.0)
        e = abs(miss) * inverse
        total += e
        error = max(error, e)
    for a in range(first_atom, last_atom):
        store_quad(moves, 4 * a, quad(0.0, 0.0, 0.0, load_double(w, a)))
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _image(vector, cell):
    x, y, z = minimum_image(extract(vector, 0), extract(vector, 1), extract(vector, 2), cell, TRICLINIC)
    return quad(x, y, z, 0.0)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _measure(first, last, lengths, links, state, starts, moves):
    """Current vectors and right-hand sides; largest and total relative error of the lengths."""
    error, total = 0.0, 0.0
    for k in range(first, last):
        i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
        r = load_quad(starts, 4 * k) + (load_quad(moves, i) - load_quad(moves, j))
        d2 = load_double(lengths, k) * load_double(lengths, k)
        miss = 0.5 * (d2 - dot(r, r))
        store_first(state, 8 * k, r, pair(0.0, miss))
        e = abs(miss) * load_double(starts, 4 * k + 3)
        total += e
        error = max(error, e)
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(alone, x_new, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atoms, atom_start, w = at_piece(h, h, 0), at_piece(u, h, 1), at_piece(h, h, 2), at_piece(t, h, 3)
    links, columns, targets, couplings = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(t, h, 7)
    weights, state, entries = at_piece(t, h, 8), at_piece(t, h, _STATE), at_piece(t, h, 12)
    pivots, starts, places = at_piece(t, h, _PIVOTS), at_piece(t, h, 14), at_piece(t, h, 15)
    moves, solution = at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION)
    periodic, cell = kind != OPEN, lattice_numbers(lattice)
    lengths = at_first(wanted) if wanted.size else at_piece(t, h, _LENGTHS)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        first_atom, last_atom = atom_start[c], atom_start[c + 1]
        error, total = _begin(
            first, last, first_atom, last_atom, x_new, x_ref, lengths, cell, periodic, atoms, w, links,
            state, starts, places, moves, solution,
        )  # fmt: skip
        previous = np.inf
        factored = False
        iteration = 0
        while True:
            if iteration > 0:
                error, total = _measure(first, last, lengths, links, state, starts, moves)
            # max() may drop a NaN; the sum cannot.
            if not (total < np.inf) or hopeless(iteration, error, previous):
                return False, error, iteration, _worst(first, last, state, lengths)
            if error <= NEWTON_TOLERANCE:
                break
            # Rounding may stop short of it in ill-conditioned sets; what the positions resolve is enough.
            if error > 0.5 * previous and error < NEAR and _within_rounding(first, last, state, lengths, places, links):
                break
            if factor_serves(factored, error, previous):
                _forward(first, last, links, columns, state, entries)
            else:
                _factor(first, last, links, columns, targets, couplings, weights, state, entries, pivots)
                factored = True
            _backward(first, last, links, columns, state, entries, pivots, moves, solution)
            previous = error
            iteration += 1
        for k in range(first, last):
            # A bond must not have turned by 90 degrees or more within the step.
            if not (dot(first_vector(state, 8 * k), second_vector(state, 8 * k)) > 0.0):
                return False, np.inf, iteration, k
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    if alone:
        _apply(x_new, 1.0, tables)
        if inv_dt != 0.0:
            _apply(velocities, inv_dt, tables)
    return True, worst, most, worst_row


@njit(cache=True)
def _within_rounding(first, last, state, lengths, places, links):
    """Whether each |sigma| is max(1e-14 d, 2 eps (|x_i| + |x_j|)) or so, see `tolerances.ROUNDINGS`."""
    room = ROUNDINGS * np.sqrt(last - first)
    for k in range(first, last):
        reach = 0.0
        for side in range(2):
            a = 4 * np.int64(links[4 * k + 2 + side])
            reach += np.sqrt(places[a] ** 2 + places[a + 1] ** 2 + places[a + 2] ** 2)
        rounding = max(ROUNDING * lengths[k], 2 * EPS * reach)
        if not (abs(state[8 * k + 7]) / lengths[k] <= room * rounding):
            return False
    return True


@njit(cache=True)
def _worst(first, last, state, lengths):
    """Row of a cluster with the largest relative residual, or the first that is not finite."""
    row, largest = np.int64(first), 0.0
    for k in range(first, last):
        e = abs(state[8 * k + 7]) / (lengths[k] * lengths[k])
        if not (e <= largest):
            row, largest = np.int64(k), e
            if not (e < np.inf):
                break
    return row


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, y, x, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atoms, atom_start, w = at_piece(h, h, 0), at_piece(u, h, 1), at_piece(h, h, 2), at_piece(t, h, 3)
    links, columns, targets, couplings = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(t, h, 7)
    weights, state, entries = at_piece(t, h, 8), at_piece(t, h, _STATE), at_piece(t, h, 12)
    pivots, starts, places = at_piece(t, h, _PIVOTS), at_piece(t, h, 14), at_piece(t, h, 15)
    moves, solution, periodic = at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION), kind != OPEN
    driven, rates, cell = wanted.size > 0, at_first(wanted), lattice_numbers(lattice)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = 3 * load_index(atoms, a)
            store_quad(places, 4 * a, load_point(x, g))
            store_quad(moves, 4 * a, load_point(y, g))
        largest = 0.0
        total = 0.0
        for k in range(first, last):
            i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
            s = load_quad(places, i) - load_quad(places, j)
            u = load_quad(moves, i) - load_quad(moves, j)
            if periodic:
                s = _image(s, cell)
            s2 = dot(s, s)
            goal = load_double(rates, k) * np.sqrt(s2) if driven else 0.0
            store_line(state, 8 * k, u, s, pair(0.0, goal - dot(s, u)))
            store_quad(starts, 4 * k, u)
            store_double(starts, 4 * k + 3, goal)
            size = dot(u, u) * s2 + goal * goal
            largest = max(largest, size)
            total += size if s2 > 0.0 else np.inf
            store_double(solution, k, 0.0)
        for a in range(atom_start[c], atom_start[c + 1]):
            store_quad(moves, 4 * a, quad(0.0, 0.0, 0.0, load_double(w, a)))
        if not (total < np.inf):
            return False, np.inf, 0, _first_bad(first, last, state)
        _factor_symmetric(first, last, links, columns, targets, couplings, weights, state, entries, pivots)
        allowed = SPEED_TOLERANCE * np.sqrt(largest)
        error, iteration = 0.0, 0
        previous = np.inf
        while True:
            _backward(first, last, links, columns, state, entries, pivots, moves, solution)
            iteration += 1
            error, total = 0.0, 0.0
            for k in range(first, last):
                i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
                u = load_quad(starts, 4 * k) + (load_quad(moves, i) - load_quad(moves, j))
                miss = load_double(starts, 4 * k + 3) - dot(second_vector(state, 8 * k), u)
                store_double(state, 8 * k + RIGHT, miss)
                total += abs(miss)
                error = max(error, abs(miss))
            if not (total < np.inf):
                return False, error, iteration, _first_bad(first, last, state)
            if not refines(iteration, error, previous, allowed):
                break
            previous = error
            _forward(first, last, links, columns, state, entries)
        if error > SPEED_ROUNDINGS * allowed:
            return False, error, iteration, _largest(first, last, state)
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    if alone:
        _apply(y, 1.0, tables)
    return True, worst, most, worst_row


@njit(cache=True)
def _first_bad(first, last, state):
    """First row whose vectors or right-hand side are zero or not finite."""
    for k in range(first, last):
        s2 = state[8 * k + 1] ** 2 + state[8 * k + 3] ** 2 + state[8 * k + 5] ** 2
        if not (s2 > 0.0 and s2 < np.inf and abs(state[8 * k + 7]) < np.inf):
            return np.int64(k)
    return np.int64(first)


@njit(cache=True)
def _largest(first, last, state):
    """Row with the largest right-hand side."""
    row = first
    for k in range(first, last):
        if abs(state[8 * k + 7]) > abs(state[8 * row + 7]):
            row = k
    return np.int64(row)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply(x, factor, tables):
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    atoms, moves = at_piece(halves(tables), h, 1), at_piece(tables, h, _MOVES)
    for a in range(h[3] - h[2]):
        add_to_point(x, 3 * load_index(atoms, a), factor * load_quad(moves, 4 * a))


@njit(cache=True, fastmath=FAST)
def _resolved(x, lattice, kind, tables):
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    return resolved(x, table_array(halves(tables), h, _PAIRS), table_array(tables, h, _LENGTHS), lattice, kind)
