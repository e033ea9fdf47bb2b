"""Distance rows of any connectivity: sparse elimination, one cluster after another.

Works on relative quantities: displacements of the cluster's atoms, and bond vectors made from them;
positions change once, after every cluster has converged, so that a failure leaves them as they were.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.elimination import (
    FAST,
    PIVOT_TOLERANCE,
    UIntArray,
    make_pattern,
)
from kcons.solvers.lattice import NO_LATTICE, nearest_image
from kcons.solvers.outcome import Outcome

#: Newton stops at this relative error of a length in relative coordinates (a few roundings).
LENGTH_TOLERANCE = 4e-15
#: |A v - c| allowed after a velocity projection, relative to the largest relative speed of the cluster.
SPEED_TOLERANCE = 1e-15
MAX_ITERATIONS = 50
#: Halvings of one Newton step by the step control.
MAX_HALVINGS = 30
_EPS = float(np.finfo(float).eps)


class SparseDistances:
    """Solver for distance rows in clusters of any shape.

    Parameters
    ----------
    rows : ndarray of int64, shape (n_rows,)
        Row numbers in the set; whole clusters only.
    pairs : ndarray of int64, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    """

    name = "sparse"

    def __init__(self, rows: IntArray, pairs: IntArray, lengths: FloatArray, inverse_masses: FloatArray) -> None:
        atoms, local = np.unique(pairs, return_inverse=True)
        local = local.reshape(pairs.shape)
        movable = inverse_masses[atoms] > 0
        keep = movable[local]
        row_start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
        pattern = make_pattern(row_start, local[keep].astype(np.int64), len(atoms))
        self.rows: IntArray = rows[pattern.order]
        pairs = pairs[pattern.order]
        self.lengths = lengths[pattern.order].copy()
        self._clusters = pattern.clusters.astype(np.uint32)
        numbers, atom_start, ends = _number_atoms(pairs, pattern.clusters, len(inverse_masses))
        self._atoms, self._atom_start, self._ends = numbers, atom_start.astype(np.uint32), ends
        self._w = inverse_masses[numbers]
        start = pattern.start.astype(np.uint32)
        self._pattern = (start, pattern.columns, pattern.target_start.astype(np.uint32), pattern.targets)
        self._couplings = _couplings(pattern.start, pattern.columns, ends, self._w)
        # One cache line a row: r, s, accumulated pivot, right-hand side.
        self._state = _aligned(8 * len(rows))
        self._entries = _aligned(4 * len(pattern.columns))
        self._pivots = _aligned(4 * len(rows))
        self._places = _aligned(4 * len(numbers))
        self._moves = _aligned(4 * len(numbers))
        self._solution = np.zeros(len(rows))
        self._kept_moves = np.zeros(len(self._moves))
        self._kept_solution = np.zeros(len(rows))

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        lengths: FloatArray,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
    ) -> Outcome:
        """Solve the SHAKE condition by true Newton, in place; `lengths` in the order of `rows`."""
        for careful in (False, True):
            failed, residual, iterations, worst = _positions(
                careful, x_new, x_ref, lengths, NO_LATTICE if lattice is None else lattice, lattice is not None,
                self._clusters, self._atoms, self._atom_start, self._ends, self._w, *self._pattern,
                self._couplings, self._state, self._entries, self._pivots, self._places, self._moves, self._solution,
                self._kept_moves, self._kept_solution,
            )  # fmt: skip
            if not failed:
                break
        if failed:
            return Outcome(False, residual, iterations, worst)
        if velocities is None:
            _apply(x_new, self._atoms, self._moves)
        else:
            _apply_both(x_new, velocities, inv_dt, self._atoms, self._moves)
        if multipliers is not None:
            _natural(self._state, self._solution, 1.0, multipliers)
        return Outcome(True, residual, iterations, worst)

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
    ) -> Outcome:
        """M-orthogonal projection of y onto u.(y_i - y_j) = rates, in place."""
        failed, residual, iterations, worst = _tangents(
            x, y, self.lengths if rates is None else rates, rates is not None,
            NO_LATTICE if lattice is None else lattice, lattice is not None,
            self._clusters, self._atoms, self._atom_start, self._ends, self._w, *self._pattern,
            self._couplings, self._state, self._entries, self._pivots, self._places, self._moves, self._solution,
        )  # fmt: skip
        if failed:
            return Outcome(False, residual, iterations, worst)
        _apply(y, self._atoms, self._moves)
        if multipliers is not None:
            _natural(self._state, self._solution, -1.0, multipliers)
        return Outcome(True, residual, iterations, worst)

    def rank(self, x: FloatArray, lattice: FloatArray | None) -> int:
        """Independent rows at `x`: those whose pivot does not vanish."""
        outcome = self.tangents(x, np.zeros_like(x), None, lattice, None)
        if not outcome.converged:
            return len(self.rows)
        return int(np.count_nonzero(self._pivots[::4]))


def lengths_resolved(x: FloatArray, pairs: UIntArray, lengths: FloatArray, lattice: FloatArray | None) -> bool:
    """Whether each |sigma| at `x` is within max(1e-14 d, 2 eps (|x_i| + |x_j|))."""
    return bool(_lengths_resolved(x, pairs, lengths, NO_LATTICE if lattice is None else lattice, lattice is not None))


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _lengths_resolved(x, pairs, lengths, lattice, periodic):  # type: ignore[no-untyped-def]
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        ax, ay, az = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        if periodic:
            ax, ay, az = nearest_image(ax, ay, az, lattice)
        d = lengths[k]
        miss = abs(ax * ax + ay * ay + az * az - d * d) / (2.0 * d)
        if not (miss <= 1e-14 * d):
            reach = np.sqrt(x[i, 0] ** 2 + x[i, 1] ** 2 + x[i, 2] ** 2)
            reach += np.sqrt(x[j, 0] ** 2 + x[j, 1] ** 2 + x[j, 2] ** 2)
            if not (miss <= 2 * _EPS * reach):
                return False
    return True


@nb.njit(cache=True)
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
    return atoms[:used].copy(), atom_start, ends.ravel()


@nb.njit(cache=True)
def _couplings(start, columns, ends, w):  # type: ignore[no-untyped-def]
    """c_kl with (A M^-1 A^T)_kl = c_kl s_k . s_l for each stored entry; 0 where there is only fill."""
    coupling = np.zeros(len(columns))
    for k in range(len(start) - 1):
        i, j = ends[2 * k], ends[2 * k + 1]
        for e in range(start[k], start[k + 1]):
            l = columns[e]
            i2, j2 = ends[2 * l], ends[2 * l + 1]
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


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _factor(  # type: ignore[no-untyped-def]
    first, last, start, columns, target_start, targets, couplings, ends, w, state, entries, pivots
):
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep.

    `state` holds r, s, the accumulated change of the pivot, and the right-hand side; `entries` the upper
    and lower factor and their accumulated changes, which are left at zero for the next time.
    """
    for k in range(first, last):
        rx, ry, rz = state[8 * k], state[8 * k + 1], state[8 * k + 2]
        sx, sy, sz = state[8 * k + 3], state[8 * k + 4], state[8 * k + 5]
        whole = (w[ends[2 * k]] + w[ends[2 * k + 1]]) * (rx * sx + ry * sy + rz * sz)
        d = whole + state[8 * k + 6]
        bk = state[8 * k + 7]
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        pivots[4 * k] = inverse
        begin, end = start[k], start[k + 1]
        for p in range(begin, end):
            l = columns[p]
            c = couplings[p]
            up = c * (rx * state[8 * l + 3] + ry * state[8 * l + 4] + rz * state[8 * l + 5]) + entries[4 * p + 2]
            low = c * (sx * state[8 * l] + sy * state[8 * l + 1] + sz * state[8 * l + 2]) + entries[4 * p + 3]
            low *= inverse
            entries[4 * p] = up
            entries[4 * p + 1] = low
            entries[4 * p + 2] = 0.0
            entries[4 * p + 3] = 0.0
            state[8 * l + 6] -= low * up
            state[8 * l + 7] -= low * bk
        t = target_start[k]
        for p in range(begin, end):
            up, low = entries[4 * p], entries[4 * p + 1]
            for q in range(p + 1, end):
                e = targets[t]
                entries[4 * e + 2] -= low * entries[4 * q]
                entries[4 * e + 3] -= entries[4 * q + 1] * up
                t += 1


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _factor_symmetric(  # type: ignore[no-untyped-def]
    first, last, start, columns, target_start, targets, couplings, ends, w, state, entries, pivots
):
    """`_factor` for r = s: half the work."""
    for k in range(first, last):
        sx, sy, sz = state[8 * k + 3], state[8 * k + 4], state[8 * k + 5]
        whole = (w[ends[2 * k]] + w[ends[2 * k + 1]]) * (sx * sx + sy * sy + sz * sz)
        d = whole + state[8 * k + 6]
        bk = state[8 * k + 7]
        inverse = 1.0 / d if d > PIVOT_TOLERANCE * whole else 0.0
        pivots[4 * k] = inverse
        begin, end = start[k], start[k + 1]
        for p in range(begin, end):
            l = columns[p]
            dot = sx * state[8 * l + 3] + sy * state[8 * l + 4] + sz * state[8 * l + 5]
            up = couplings[p] * dot + entries[4 * p + 2]
            low = up * inverse
            entries[4 * p] = up
            entries[4 * p + 1] = low
            entries[4 * p + 2] = 0.0
            state[8 * l + 6] -= low * up
            state[8 * l + 7] -= low * bk
        t = target_start[k]
        for p in range(begin, end):
            low = entries[4 * p + 1]
            for q in range(p + 1, end):
                entries[4 * targets[t] + 2] -= low * entries[4 * q]
                t += 1


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _forward(first, last, start, columns, state, entries):  # type: ignore[no-untyped-def]
    """Forward substitution with the factor kept from before."""
    for k in range(first, last):
        bk = state[8 * k + 7]
        for p in range(start[k], start[k + 1]):
            state[8 * columns[p] + 7] -= entries[4 * p + 1] * bk


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _backward(first, last, start, columns, ends, w, state, entries, pivots, moves, solution):  # type: ignore[no-untyped-def]
    """Backward substitution; adds to the multipliers and moves the atoms along s in the same sweep."""
    for back in range(last - first):
        k = last - 1 - back
        step = state[8 * k + 7]
        for p in range(start[k], start[k + 1]):
            step -= entries[4 * p] * state[8 * columns[p] + 7]
        step *= pivots[4 * k]
        state[8 * k + 7] = step
        solution[k] += step
        i, j = ends[2 * k], ends[2 * k + 1]
        wi, wj = step * w[i], step * w[j]
        moves[4 * i] += wi * state[8 * k + 3]
        moves[4 * i + 1] += wi * state[8 * k + 4]
        moves[4 * i + 2] += wi * state[8 * k + 5]
        moves[4 * j] -= wj * state[8 * k + 3]
        moves[4 * j + 1] -= wj * state[8 * k + 4]
        moves[4 * j + 2] -= wj * state[8 * k + 5]


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(  # type: ignore[no-untyped-def]
    careful, x_new, x_ref, lengths, lattice, periodic, clusters, atoms, atom_start, ends, w, start, columns,
    target_start, targets, couplings, state, entries, pivots, places, moves, solution, kept_moves, kept_solution,
):  # fmt: skip
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        # The start: reference vectors s, current vectors q, through the cluster's own atom list.
        for a in range(atom_start[c], atom_start[c + 1]):
            g = atoms[a]
            for axis in range(3):
                places[4 * a + axis] = x_ref[g, axis]
                moves[4 * a + axis] = x_new[g, axis]
        for k in range(first, last):
            i, j = ends[2 * k], ends[2 * k + 1]
            ax = places[4 * i] - places[4 * j]
            ay = places[4 * i + 1] - places[4 * j + 1]
            az = places[4 * i + 2] - places[4 * j + 2]
            bx = moves[4 * i] - moves[4 * j]
            by = moves[4 * i + 1] - moves[4 * j + 1]
            bz = moves[4 * i + 2] - moves[4 * j + 2]
            if periodic:
                ax, ay, az = nearest_image(ax, ay, az, lattice)
                bx, by, bz = nearest_image(bx, by, bz, lattice)
            state[8 * k], state[8 * k + 1], state[8 * k + 2] = bx, by, bz
            state[8 * k + 3], state[8 * k + 4], state[8 * k + 5] = ax, ay, az
            pivots[4 * k + 1], pivots[4 * k + 2], pivots[4 * k + 3] = bx, by, bz
            solution[k] = 0.0
        for a in range(atom_start[c], atom_start[c + 1]):
            for axis in range(3):
                moves[4 * a + axis] = 0.0
        error = np.inf
        best = np.inf
        factored = False
        iteration = 0
        halvings = 0
        while True:
            previous = error
            error = 0.0
            total = 0.0
            for k in range(first, last):
                rx, ry, rz = state[8 * k], state[8 * k + 1], state[8 * k + 2]
                if iteration > 0:
                    i, j = ends[2 * k], ends[2 * k + 1]
                    rx = pivots[4 * k + 1] + (moves[4 * i] - moves[4 * j])
                    ry = pivots[4 * k + 2] + (moves[4 * i + 1] - moves[4 * j + 1])
                    rz = pivots[4 * k + 3] + (moves[4 * i + 2] - moves[4 * j + 2])
                    state[8 * k], state[8 * k + 1], state[8 * k + 2] = rx, ry, rz
                d2 = lengths[k] * lengths[k]
                miss = 0.5 * (d2 - (rx * rx + ry * ry + rz * rz))
                state[8 * k + 6] = 0.0
                state[8 * k + 7] = miss
                e = abs(miss) / d2
                total += e
                error = max(error, e)
            if careful and iteration > 0 and not (total < 0.999 * best) and error > 1e-10:
                # Step control: go back half the way.
                if halvings == MAX_HALVINGS:
                    return True, error, iteration, _worst(first, last, state, lengths)
                halvings += 1
                for a in range(4 * atom_start[c], 4 * atom_start[c + 1]):
                    moves[a] = kept_moves[a] + 0.5 * (moves[a] - kept_moves[a])
                for k in range(first, last):
                    solution[k] = kept_solution[k] + 0.5 * (solution[k] - kept_solution[k])
                error = previous
                continue
            # max() may drop a NaN; the sum cannot.
            if not (total < np.inf) or iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0):
                return True, error, iteration, _worst(first, last, state, lengths)
            if error <= LENGTH_TOLERANCE:
                break
            # Rounding may stop short of it in ill-conditioned sets; what the positions resolve is enough.
            if error > 0.5 * previous and error < 1e-10 and _resolved(first, last, state, lengths, places, ends):
                break
            if careful:
                best = total
                halvings = 0
                for a in range(4 * atom_start[c], 4 * atom_start[c + 1]):
                    kept_moves[a] = moves[a]
                for k in range(first, last):
                    kept_solution[k] = solution[k]
            # Reuse the factor while a step with it still gains enough for its lower price.
            ratio = error / previous
            if factored and (error * ratio <= LENGTH_TOLERANCE or ratio < 1e-4):
                _forward(first, last, start, columns, state, entries)
            else:
                _factor(first, last, start, columns, target_start, targets, couplings, ends, w, state, entries, pivots)
                factored = True
            _backward(first, last, start, columns, ends, w, state, entries, pivots, moves, solution)
            iteration += 1
        for k in range(first, last):
            sx, sy, sz = state[8 * k + 3], state[8 * k + 4], state[8 * k + 5]
            # A bond must not have turned by 90 degrees or more within the step.
            if not (state[8 * k] * sx + state[8 * k + 1] * sy + state[8 * k + 2] * sz > 0.0):
                return True, np.inf, iteration, np.int64(k)
        if error >= worst:
            worst, worst_row = error, np.int64(first)
        most = max(most, iteration)
    return False, worst, most, worst_row


@nb.njit(cache=True)
def _resolved(first, last, state, lengths, places, ends):  # type: ignore[no-untyped-def]
    """Whether each |sigma| is within max(1e-14 d, 2 eps (|x_i| + |x_j|))."""
    for k in range(first, last):
        reach = 0.0
        for side in range(2):
            a = 4 * ends[2 * k + side]
            reach += np.sqrt(places[a] ** 2 + places[a + 1] ** 2 + places[a + 2] ** 2)
        if not (abs(state[8 * k + 7]) / lengths[k] <= max(1e-14 * lengths[k], 2 * _EPS * reach)):
            return False
    return True


@nb.njit(cache=True)
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


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(  # type: ignore[no-untyped-def]
    x, y, rates, driven, lattice, periodic, clusters, atoms, atom_start, ends, w, start, columns,
    target_start, targets, couplings, state, entries, pivots, places, moves, solution,
):  # fmt: skip
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = atoms[a]
            for axis in range(3):
                places[4 * a + axis] = x[g, axis]
                moves[4 * a + axis] = y[g, axis]
        largest = 0.0
        total = 0.0
        for k in range(first, last):
            i, j = ends[2 * k], ends[2 * k + 1]
            ax = places[4 * i] - places[4 * j]
            ay = places[4 * i + 1] - places[4 * j + 1]
            az = places[4 * i + 2] - places[4 * j + 2]
            if periodic:
                ax, ay, az = nearest_image(ax, ay, az, lattice)
            bx = moves[4 * i] - moves[4 * j]
            by = moves[4 * i + 1] - moves[4 * j + 1]
            bz = moves[4 * i + 2] - moves[4 * j + 2]
            s2 = ax * ax + ay * ay + az * az
            goal = rates[k] * np.sqrt(s2) if driven else 0.0
            pivots[4 * k + 1], pivots[4 * k + 2], pivots[4 * k + 3] = bx, by, bz
            miss = goal - (ax * bx + ay * by + az * bz)
            state[8 * k + 3], state[8 * k + 4], state[8 * k + 5] = ax, ay, az
            state[8 * k + 6] = 0.0
            state[8 * k + 7] = miss
            size = (bx * bx + by * by + bz * bz) * s2 + goal * goal
            largest = max(largest, size)
            total += size if s2 > 0.0 else np.inf
            solution[k] = 0.0
        for a in range(atom_start[c], atom_start[c + 1]):
            for axis in range(3):
                moves[4 * a + axis] = 0.0
        if not (total < np.inf):
            return True, np.inf, 0, _first_bad(first, last, state)
        _factor_symmetric(
            first, last, start, columns, target_start, targets, couplings, ends, w, state, entries, pivots
        )
        allowed = SPEED_TOLERANCE * np.sqrt(largest)
        error, iteration = 0.0, 0
        previous = np.inf
        while True:
            _backward(first, last, start, columns, ends, w, state, entries, pivots, moves, solution)
            iteration += 1
            error, total = 0.0, 0.0
            for k in range(first, last):
                i, j = ends[2 * k], ends[2 * k + 1]
                sx, sy, sz = state[8 * k + 3], state[8 * k + 4], state[8 * k + 5]
                bx = pivots[4 * k + 1] + (moves[4 * i] - moves[4 * j])
                by = pivots[4 * k + 2] + (moves[4 * i + 1] - moves[4 * j + 1])
                bz = pivots[4 * k + 3] + (moves[4 * i + 2] - moves[4 * j + 2])
                miss = -(sx * bx + sy * by + sz * bz)
                if driven:
                    miss += rates[k] * np.sqrt(sx * sx + sy * sy + sz * sz)
                state[8 * k + 7] = miss
                total += abs(miss)
                error = max(error, abs(miss))
            if not (total < np.inf):
                return True, error, iteration, _first_bad(first, last, state)
            # One refinement more as long as it helps; the floor itself is accepted.
            if error <= allowed or iteration > 8 or not (error < 0.5 * previous):
                break
            previous = error
            _forward(first, last, start, columns, state, entries)
        if error > 1e3 * allowed:
            return True, error, iteration, _largest(first, last, state)
        if error >= worst:
            worst, worst_row = error, np.int64(first)
        most = max(most, iteration)
    return False, worst, most, worst_row


@nb.njit(cache=True)
def _first_bad(first, last, state):  # type: ignore[no-untyped-def]
    """First row whose vectors or right-hand side are zero or not finite."""
    for k in range(first, last):
        s2 = state[8 * k + 3] ** 2 + state[8 * k + 4] ** 2 + state[8 * k + 5] ** 2
        if not (s2 > 0.0 and s2 < np.inf and abs(state[8 * k + 7]) < np.inf):
            return np.int64(k)
    return np.int64(first)


@nb.njit(cache=True)
def _largest(first, last, state):  # type: ignore[no-untyped-def]
    """Row with the largest right-hand side."""
    row = first
    for k in range(first, last):
        if abs(state[8 * k + 7]) > abs(state[8 * row + 7]):
            row = k
    return np.int64(row)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _natural(state, solution, sign, multipliers):  # type: ignore[no-untyped-def]
    """Multipliers of |r| - d instead of s . r."""
    for k in range(len(solution)):
        sx, sy, sz = state[8 * k + 3], state[8 * k + 4], state[8 * k + 5]
        multipliers[k] = sign * solution[k] * np.sqrt(sx * sx + sy * sy + sz * sz)


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply(x, atoms, moves):  # type: ignore[no-untyped-def]
    for a in range(len(atoms)):
        g = atoms[a]
        x[g, 0] += moves[4 * a]
        x[g, 1] += moves[4 * a + 1]
        x[g, 2] += moves[4 * a + 2]


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _apply_both(x, v, inv_dt, atoms, moves):  # type: ignore[no-untyped-def]
    for a in range(len(atoms)):
        g = atoms[a]
        for axis in range(3):
            x[g, axis] += moves[4 * a + axis]
            v[g, axis] += inv_dt * moves[4 * a + axis]


def _aligned(size: int) -> FloatArray:
    """Zeros that begin on a cache line."""
    raw = np.zeros(size + 8)
    offset = (-raw.ctypes.data // 8) % 8
    return raw[offset : offset + size]
