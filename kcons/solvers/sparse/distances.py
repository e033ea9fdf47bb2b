"""Distance rows of any connectivity: sparse elimination, one cluster after another.

Works on relative quantities: displacements of the cluster's atoms, and bond vectors made from them;
positions change once, after every cluster has converged, so that a failure leaves them as they were.
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
from kcons.solvers.kernels.lattices import OPEN, nearest_image
from kcons.solvers.kernels.two_and_four_wide import (
    add_to_point,
    dot,
    extract,
    first_vector,
    load_double,
    load_index,
    load_point,
    load_quad,
    pair,
    quad,
    second_vector,
    store_double,
    store_first,
    store_line,
    store_quad,
)
from kcons.solvers.sparse.elimination import FAST, make_pattern, number_atoms
from kcons.solvers.sparse.substitution import (
    RIGHT,
    backward,
    factor,
    factor_serves,
    factor_symmetric,
    forward,
    hopeless,
    refines,
)
from kcons.solvers.tolerances import (
    EPS,
    NEAR,
    NEWTON_TOLERANCE,
    ROUNDING,
    ROUNDINGS,
    SPEED_ROUNDINGS,
    SPEED_TOLERANCE,
)

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
                # As `sparse.substitution` says: lines of rows and of entries; pivots. Then where rows began, where
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

    def __reduce__(self) -> tuple[type[SparseDistances], tuple[object, ...]]:
        return SparseDistances, self._made_of  # addresses are of no use elsewhere

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


@njit(cache=True)
def _couplings(start, columns, ends, w):  # type: ignore[no-untyped-def]
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
def _begin(first, last, first_atom, last_atom, x_new, x_ref, lengths, lattice, periodic, atoms, w, links,
    state, starts, places, moves, solution,
):  # type: ignore[no-untyped-def]  # fmt: skip
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
            s, q = _image(s, lattice), _image(q, lattice)
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
def _image(vector, lattice):  # type: ignore[no-untyped-def]
    x, y, z = nearest_image(extract(vector, 0), extract(vector, 1), extract(vector, 2), lattice)
    return quad(x, y, z, 0.0)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _measure(first, last, lengths, links, state, starts, moves):  # type: ignore[no-untyped-def]
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
def _positions(  # type: ignore[no-untyped-def]
    alone, x_new, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers
):
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atoms, atom_start, w = at_piece(h, h, 0), at_piece(u, h, 1), at_piece(h, h, 2), at_piece(t, h, 3)
    links, columns, targets, couplings = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(t, h, 7)
    weights, state, entries = at_piece(t, h, 8), at_piece(t, h, _STATE), at_piece(t, h, 12)
    pivots, starts, places = at_piece(t, h, _PIVOTS), at_piece(t, h, 14), at_piece(t, h, 15)
    moves, solution = at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION)
    periodic = kind != OPEN
    lengths = at_first(wanted) if wanted.size else at_piece(t, h, _LENGTHS)
    worst, worst_row, most = 0.0, -1, 0
    for c in range(h[1] - h[0] - 1):
        first, last = clusters[c], clusters[c + 1]
        first_atom, last_atom = atom_start[c], atom_start[c + 1]
        error, total = _begin(
            first, last, first_atom, last_atom, x_new, x_ref, lengths, lattice, periodic, atoms, w, links,
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
                forward(first, last, links, columns, state, entries)
            else:
                factor(first, last, links, columns, targets, couplings, weights, state, entries, pivots)
                factored = True
            backward(first, last, links, columns, state, entries, pivots, moves, solution)
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
def _within_rounding(first, last, state, lengths, places, links):  # type: ignore[no-untyped-def]
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
def _worst(first, last, state, lengths):  # type: ignore[no-untyped-def]
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
def _tangents(alone, x, y, wanted, lattice, kind, tables, numbers):  # type: ignore[no-untyped-def]
    """As `kcons.solvers.addressable_solvers` says."""
    t, h, u = tables, integers(tables), halves(tables)
    clusters, atoms, atom_start, w = at_piece(h, h, 0), at_piece(u, h, 1), at_piece(h, h, 2), at_piece(t, h, 3)
    links, columns, targets, couplings = at_piece(u, h, 4), at_piece(u, h, 5), at_piece(u, h, 6), at_piece(t, h, 7)
    weights, state, entries = at_piece(t, h, 8), at_piece(t, h, _STATE), at_piece(t, h, 12)
    pivots, starts, places = at_piece(t, h, _PIVOTS), at_piece(t, h, 14), at_piece(t, h, 15)
    moves, solution, periodic = at_piece(t, h, _MOVES), at_piece(t, h, _SOLUTION), kind != OPEN
    driven, rates = wanted.size > 0, at_first(wanted)
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
                s = _image(s, lattice)
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
        factor_symmetric(first, last, links, columns, targets, couplings, weights, state, entries, pivots)
        allowed = SPEED_TOLERANCE * np.sqrt(largest)
        error, iteration = 0.0, 0
        previous = np.inf
        while True:
            backward(first, last, links, columns, state, entries, pivots, moves, solution)
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
            forward(first, last, links, columns, state, entries)
        if error > SPEED_ROUNDINGS * allowed:
            return False, error, iteration, _largest(first, last, state)
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    if alone:
        _apply(y, 1.0, tables)
    return True, worst, most, worst_row


@njit(cache=True)
def _first_bad(first, last, state):  # type: ignore[no-untyped-def]
    """First row whose vectors or right-hand side are zero or not finite."""
    for k in range(first, last):
        s2 = state[8 * k + 1] ** 2 + state[8 * k + 3] ** 2 + state[8 * k + 5] ** 2
        if not (s2 > 0.0 and s2 < np.inf and abs(state[8 * k + 7]) < np.inf):
            return np.int64(k)
    return np.int64(first)


@njit(cache=True)
def _largest(first, last, state):  # type: ignore[no-untyped-def]
    """Row with the largest right-hand side."""
    row = first
    for k in range(first, last):
        if abs(state[8 * k + 7]) > abs(state[8 * row + 7]):
            row = k
    return np.int64(row)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply(x, factor, tables):  # type: ignore[no-untyped-def]
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    atoms, moves = at_piece(halves(tables), h, 1), at_piece(tables, h, _MOVES)
    for a in range(h[3] - h[2]):
        add_to_point(x, 3 * load_index(atoms, a), factor * load_quad(moves, 4 * a))


@njit(cache=True, fastmath=FAST)
def _resolved(x, lattice, kind, tables):  # type: ignore[no-untyped-def]
    """As `kcons.solvers.addressable_solvers` says."""
    h = integers(tables)
    return resolved(x, table_array(halves(tables), h, _PAIRS), table_array(tables, h, _LENGTHS), lattice, kind)
