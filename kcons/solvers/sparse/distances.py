"""Distance rows of any connectivity: sparse elimination, one cluster after another.

Works on relative quantities: displacements of the cluster's atoms, and bond vectors made from them;
positions change once, after every cluster has converged, so that a failure leaves them as they were.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.distance_clusters import DistanceClusters
from kcons.solvers.kernels.aligned_memory import aligned
from kcons.solvers.kernels.nearest_image import NO_LATTICE, nearest_image
from kcons.solvers.kernels.two_and_four_wide import (
    add_to_point,
    dot,
    entry,
    first_vector,
    lane,
    load_point,
    load_quad,
    number,
    pair,
    put,
    quad,
    second_vector,
    store_first,
    store_line,
    store_quad,
)
from kcons.solvers.sparse import step_control
from kcons.solvers.sparse.elimination import FAST, make_pattern
from kcons.solvers.sparse.step_control import MAX_HALVINGS, factor_serves, go_back, hopeless, keep, overshot, refines
from kcons.solvers.sparse.substitution import RIGHT, backward, factor, factor_symmetric, forward

#: |A v - c| allowed after a velocity projection, relative to the largest relative speed of the cluster.
SPEED_TOLERANCE = 1e-15
_EPS = float(np.finfo(float).eps)


class SparseDistances(DistanceClusters):
    """Solver for distance rows in clusters of any shape.

    Parameters
    ----------
    rows : ndarray of int64, shape (n_rows,)
        Row numbers in the set; whole clusters only.
    pairs : ndarray of int64, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    late : ndarray of bool, shape (n_rows,), optional
        Rows that depend on the others of their cluster, see `make_pattern`.
    """

    name = "sparse"

    def __init__(
        self,
        rows: IntArray,
        pairs: IntArray,
        lengths: FloatArray,
        inverse_masses: FloatArray,
        late: NDArray[np.bool_] | None = None,
    ) -> None:
        atoms, local = np.unique(pairs, return_inverse=True)
        local = local.reshape(pairs.shape)
        movable = inverse_masses[atoms] > 0
        keep = movable[local]
        row_start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
        row_atoms = local[keep].astype(np.int64)
        pattern = make_pattern(row_start, row_atoms, len(atoms), late)
        self.rows: IntArray = rows[pattern.order]
        pairs = pairs[pattern.order]
        self.lengths = lengths[pattern.order].copy()
        self._clusters = pattern.clusters
        self._atoms, self._atom_start, ends = plain_if_small(_number_atoms, len(pairs))(
            pairs, pattern.clusters, len(inverse_masses)
        )
        self._w = inverse_masses[self._atoms]
        links = np.zeros((len(rows) + 1, 4), np.uint32)
        links[:, 0], links[:, 1], links[:-1, 2:] = pattern.start, pattern.target_start, ends
        weights = self._w[ends].sum(axis=1)
        couplings = plain_if_small(_couplings, len(pattern.columns))(pattern.start, pattern.columns, ends, self._w)
        self._tables = (self._clusters, self._atoms, self._atom_start, self._w, links.ravel(),
            pattern.columns, pattern.targets, couplings, weights,
        )  # fmt: skip
        self._state = aligned(8 * len(rows))
        self._entries = aligned(4 * len(pattern.columns))
        self._pivots = np.zeros(len(rows))
        self._starts = aligned(4 * len(rows))
        self._places = aligned(4 * len(self._atoms))
        self._moves = aligned(4 * len(self._atoms))
        self._solution = np.zeros(len(rows))
        self._kept_moves = np.zeros(len(self._moves))
        self._kept_solution = np.zeros(len(rows))

    def _project(
        self, request: Request, given: FloatArray, tangent: Literal[True] | None, multipliers: FloatArray | None
    ) -> Outcome:
        x, reference, _, lattice, _, _, velocities, inv_dt, _, _ = request
        cell, periodic = NO_LATTICE if lattice is None else lattice, lattice is not None
        rooms = (
            self._state, self._entries, self._pivots, self._starts, self._places, self._moves, self._solution,
        )  # fmt: skip
        if tangent:
            failed, residual, iterations, worst = solve_tangents(
                reference, x, given, len(given) > 0, cell, periodic, *self._tables, *rooms
            )
        else:
            for careful in (False, True):
                failed, residual, iterations, worst = solve_positions(
                    careful, x, reference, given, cell, periodic, *self._tables, *rooms,
                    self._kept_moves, self._kept_solution,
                )  # fmt: skip
                if not failed:
                    break
        if not failed:
            if velocities is None or tangent:
                apply(x, self._atoms, self._moves)
            else:
                apply_both(x, velocities, inv_dt, self._atoms, self._moves)
            if multipliers is not None:
                _natural(self._state, self._solution, -1.0 if tangent else 1.0, multipliers)
        return Outcome(not failed, residual, iterations, worst)

    def tables(self) -> tuple[tuple[NDArray[Any], ...], tuple[FloatArray, ...]]:
        """What `solve_positions` and `solve_tangents` are given of the rows, and the rooms that they work in."""
        return self._tables, (self._state, self._entries, self._pivots, self._starts, self._places, self._moves,
            self._solution, self._kept_moves, self._kept_solution,
        )  # fmt: skip

    def rank(self, x: FloatArray, lattice: FloatArray | None) -> int:
        """Independent rows at `x`: those whose pivot does not vanish."""
        outcome = self.tangents(Request(np.zeros_like(x), x, lattice=lattice))
        if not outcome.converged:
            return len(self.rows)
        return int(np.count_nonzero(self._pivots))


def sparse_distances(
    constraint_set: ConstraintSet, rows: IntArray, inverse_masses: FloatArray, time: float = 0.0
) -> SparseDistances:
    """The sparse solver, which has step control, for distance rows."""
    pairs = np.array([constraint_set.row_atoms(int(row)) for row in rows], dtype=np.int64)
    return SparseDistances(rows, pairs, constraint_set.target(time)[rows], inverse_masses)


@njit(cache=True)
def _number_atoms(pairs, clusters, n_atoms):  # type: ignore[no-untyped-def]
    """Atoms of each cluster in the order in which its rows meet them, and the rows' ends in that count."""
    n = len(pairs)
    place = np.full(n_atoms, -1, np.int64)
    atoms = np.empty(2 * n, np.uint32)
    ends = np.empty((n, 2), np.uint32)
    atom_start = np.zeros(len(clusters), np.int64)
    used = 0
    for c in range(len(clusters) - 1):
        base = used
        for k in range(clusters[c], clusters[c + 1]):
            for side in range(2):
                a = pairs[k, side]
                # An atom of infinite mass may stand in several clusters; each has its own copy.
                if place[a] < base:
                    place[a] = used
                    atoms[used] = a
                    used += 1
                ends[k, side] = place[a]
        atom_start[c + 1] = used
    return atoms[:used].copy(), atom_start, ends


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
        g = 3 * entry(atoms, a)
        store_quad(places, 4 * a, load_point(x_ref, g))
        store_quad(moves, 4 * a, load_point(x_new, g))
    error, total = 0.0, 0.0
    for k in range(first, last):
        i, j = 4 * entry(links, 4 * k + 2), 4 * entry(links, 4 * k + 3)
        s = load_quad(places, i) - load_quad(places, j)
        q = load_quad(moves, i) - load_quad(moves, j)
        if periodic:
            s, q = _image(s, lattice), _image(q, lattice)
        d2 = number(lengths, k) * number(lengths, k)
        miss = 0.5 * (d2 - dot(q, q))
        store_line(state, 8 * k, q, s, pair(0.0, miss))
        store_quad(starts, 4 * k, q)
        inverse = 1.0 / d2
        put(starts, 4 * k + 3, inverse)
        put(solution, k, 0.0)
        e = abs(miss) * inverse
        total += e
        error = max(error, e)
    for a in range(first_atom, last_atom):
        store_quad(moves, 4 * a, quad(0.0, 0.0, 0.0, number(w, a)))
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _image(vector, lattice):  # type: ignore[no-untyped-def]
    x, y, z = nearest_image(lane(vector, 0), lane(vector, 1), lane(vector, 2), lattice)
    return quad(x, y, z, 0.0)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _measure(first, last, lengths, links, state, starts, moves):  # type: ignore[no-untyped-def]
    """Current vectors and right-hand sides; largest and total relative error of the lengths."""
    error, total = 0.0, 0.0
    for k in range(first, last):
        i, j = 4 * entry(links, 4 * k + 2), 4 * entry(links, 4 * k + 3)
        r = load_quad(starts, 4 * k) + (load_quad(moves, i) - load_quad(moves, j))
        d2 = number(lengths, k) * number(lengths, k)
        miss = 0.5 * (d2 - dot(r, r))
        store_first(state, 8 * k, r, pair(0.0, miss))
        e = abs(miss) * number(starts, 4 * k + 3)
        total += e
        error = max(error, e)
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy")
def solve_positions(  # type: ignore[no-untyped-def]
    careful, x_new, x_ref, lengths, lattice, periodic, clusters, atoms, atom_start, w, links, columns,
    targets, couplings, weights, state, entries, pivots, starts, places, moves, solution, kept_moves, kept_solution,
):  # fmt: skip
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        first_atom, last_atom = atom_start[c], atom_start[c + 1]
        error, total = _begin(
            first, last, first_atom, last_atom, x_new, x_ref, lengths, lattice, periodic, atoms, w, links,
            state, starts, places, moves, solution,
        )  # fmt: skip
        previous = np.inf
        best = np.inf
        factored = False
        iteration = 0
        halvings = 0
        while True:
            if iteration > 0:
                error, total = _measure(first, last, lengths, links, state, starts, moves)
            if overshot(careful, iteration, error, total, best):
                if halvings == MAX_HALVINGS:
                    return True, error, iteration, _worst(first, last, state, lengths)
                halvings += 1
                go_back(4 * first_atom, 4 * last_atom, moves, kept_moves)
                go_back(first, last, solution, kept_solution)
                continue
            # max() may drop a NaN; the sum cannot.
            if not (total < np.inf) or hopeless(iteration, error, previous):
                return True, error, iteration, _worst(first, last, state, lengths)
            if error <= step_control.NEWTON_TOLERANCE:
                break
            # Rounding may stop short of it in ill-conditioned sets; what the positions resolve is enough.
            if error > 0.5 * previous and error < 1e-10 and _resolved(first, last, state, lengths, places, links):
                break
            if careful:
                best = total
                halvings = 0
                keep(4 * first_atom, 4 * last_atom, moves, kept_moves)
                keep(first, last, solution, kept_solution)
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
                return True, np.inf, iteration, k
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    return False, worst, most, worst_row


@njit(cache=True)
def _resolved(first, last, state, lengths, places, links):  # type: ignore[no-untyped-def]
    """Whether each |sigma| is max(1e-14 d, 2 eps (|x_i| + |x_j|)) or so, see `step_control.ROUNDINGS`."""
    room = step_control.ROUNDINGS * np.sqrt(last - first)
    for k in range(first, last):
        reach = 0.0
        for side in range(2):
            a = 4 * np.int64(links[4 * k + 2 + side])
            reach += np.sqrt(places[a] ** 2 + places[a + 1] ** 2 + places[a + 2] ** 2)
        rounding = max(1e-14 * lengths[k], 2 * _EPS * reach)
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
def solve_tangents(  # type: ignore[no-untyped-def]
    x, y, rates, driven, lattice, periodic, clusters, atoms, atom_start, w, links, columns,
    targets, couplings, weights, state, entries, pivots, starts, places, moves, solution,
):  # fmt: skip
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = 3 * entry(atoms, a)
            store_quad(places, 4 * a, load_point(x, g))
            store_quad(moves, 4 * a, load_point(y, g))
        largest = 0.0
        total = 0.0
        for k in range(first, last):
            i, j = 4 * entry(links, 4 * k + 2), 4 * entry(links, 4 * k + 3)
            s = load_quad(places, i) - load_quad(places, j)
            u = load_quad(moves, i) - load_quad(moves, j)
            if periodic:
                s = _image(s, lattice)
            s2 = dot(s, s)
            goal = number(rates, k) * np.sqrt(s2) if driven else 0.0
            store_line(state, 8 * k, u, s, pair(0.0, goal - dot(s, u)))
            store_quad(starts, 4 * k, u)
            put(starts, 4 * k + 3, goal)
            size = dot(u, u) * s2 + goal * goal
            largest = max(largest, size)
            total += size if s2 > 0.0 else np.inf
            put(solution, k, 0.0)
        for a in range(atom_start[c], atom_start[c + 1]):
            store_quad(moves, 4 * a, quad(0.0, 0.0, 0.0, number(w, a)))
        if not (total < np.inf):
            return True, np.inf, 0, _first_bad(first, last, state)
        factor_symmetric(first, last, links, columns, targets, couplings, weights, state, entries, pivots)
        allowed = SPEED_TOLERANCE * np.sqrt(largest)
        error, iteration = 0.0, 0
        previous = np.inf
        while True:
            backward(first, last, links, columns, state, entries, pivots, moves, solution)
            iteration += 1
            error, total = 0.0, 0.0
            for k in range(first, last):
                i, j = 4 * entry(links, 4 * k + 2), 4 * entry(links, 4 * k + 3)
                u = load_quad(starts, 4 * k) + (load_quad(moves, i) - load_quad(moves, j))
                miss = number(starts, 4 * k + 3) - dot(second_vector(state, 8 * k), u)
                put(state, 8 * k + RIGHT, miss)
                total += abs(miss)
                error = max(error, abs(miss))
            if not (total < np.inf):
                return True, error, iteration, _first_bad(first, last, state)
            if not refines(iteration, error, previous, allowed):
                break
            previous = error
            forward(first, last, links, columns, state, entries)
        if error > 1e3 * allowed:
            return True, error, iteration, _largest(first, last, state)
        if error >= worst:
            worst, worst_row = error, first
        most = max(most, iteration)
    return False, worst, most, worst_row


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
def _natural(state, solution, sign, multipliers):  # type: ignore[no-untyped-def]
    """Multipliers of |r| - d instead of s . r."""
    for k in range(len(solution)):
        sx, sy, sz = state[8 * k + 1], state[8 * k + 3], state[8 * k + 5]
        multipliers[k] = sign * solution[k] * np.sqrt(sx * sx + sy * sy + sz * sz)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def apply(x, atoms, moves):  # type: ignore[no-untyped-def]
    for a in range(len(atoms)):
        g = 3 * entry(atoms, a)
        add_to_point(x, g, load_quad(moves, 4 * a))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def apply_both(x, v, inv_dt, atoms, moves):  # type: ignore[no-untyped-def]
    for a in range(len(atoms)):
        g = 3 * entry(atoms, a)
        move = load_quad(moves, 4 * a)
        add_to_point(x, g, move)
        add_to_point(v, g, inv_dt * move)
