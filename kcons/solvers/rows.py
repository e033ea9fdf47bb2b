"""Rows of mixed kinds, coupled in any way: sparse elimination with general gradients.

The counterpart of `kcons.solvers.distances` for clusters that also hold angles, dihedrals, planes and other
compiled rows. Gradients are stored by slot (one atom of one row, three numbers).
"""

from __future__ import annotations

import numba as nb
import numpy as np

from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.coordinates import PARAMETERS, evaluate, miss
from kcons.solvers.elimination import FAST, PIVOT_TOLERANCE, make_pattern
from kcons.solvers.lattice import NO_LATTICE
from kcons.solvers.outcome import Outcome

MAX_ITERATIONS = 50
#: Halvings of one Newton step by the step control.
MAX_HALVINGS = 30
#: |A v - c| allowed after a projection, in parts of the cluster's largest speed times gradient.
SPEED_TOLERANCE = 1e-15
_EPS = float(np.finfo(float).eps)


class SparseRows:
    """Solver for clusters of compiled rows of any kind.

    Parameters
    ----------
    constraint_set : ConstraintSet
    rows : ndarray of int64
        Row numbers, sorted; whole clusters only.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    """

    name = "mixed"

    def __init__(self, constraint_set: ConstraintSet, rows: IntArray, inverse_masses: FloatArray) -> None:
        incidence = constraint_set.incidence[rows]
        start = incidence.indptr.astype(np.int64)
        atoms = incidence.indices.astype(np.int64)
        keep = inverse_masses[atoms] > 0
        counts = np.add.reduceat(keep, start[:-1]) if len(rows) else np.zeros(0, np.int64)
        pattern = make_pattern(np.concatenate([[0], np.cumsum(counts)]), atoms[keep], constraint_set.n_atoms)
        order = pattern.order
        self.rows: IntArray = rows[order]
        widths = np.diff(start)[order]
        self._slots = np.concatenate([[0], np.cumsum(widths)]).astype(np.int64)
        flat = np.concatenate([atoms[start[k] : start[k + 1]] for k in order]) if len(order) else atoms
        self._clusters = pattern.clusters
        self._atoms, self._atom_start, self._slot_atoms = _number_atoms(
            flat, self._slots, pattern.clusters, len(inverse_masses)
        )
        self._w = inverse_masses[self._atoms]
        triple, left, right = _triples(pattern.start, pattern.columns, self._slots, self._slot_atoms, self._w)
        self._tables = (pattern.start, pattern.columns, pattern.target_start, pattern.targets, triple, left, right)
        kinds, parameters = _kinds_and_parameters(constraint_set)
        self._kinds = kinds[self.rows]
        self._parameters = np.ascontiguousarray(parameters[self.rows]).ravel()
        self._scale = constraint_set.scale[self.rows]
        self._targets = np.ascontiguousarray(constraint_set.target(0.0)[self.rows])
        n, entries = len(rows), len(pattern.columns)
        self._gradients = np.zeros((2, 3 * int(self._slots[-1])))
        self._work = np.zeros((5, n))
        self._entries = np.zeros(4 * entries)
        self._base = np.zeros(4 * len(self._atoms))
        self._moves = np.zeros(4 * len(self._atoms))
        self._solution = np.zeros(n)
        self._kept_moves = np.zeros(len(self._moves))
        self._kept_solution = np.zeros(n)
        self._speeds = np.zeros(4 * len(self._atoms))

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        targets: FloatArray | None,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome:
        """Solve the SHAKE condition by true Newton, in place."""
        wanted = self._targets if targets is None else targets[self.rows]
        for careful in (False, True):
            failed, residual, iterations, worst = _positions(
                careful, x_new, x_ref, wanted, NO_LATTICE if lattice is None else lattice, lattice is not None,
                self._clusters, self._atoms, self._atom_start, self._w, self._slots, self._slot_atoms, self._kinds,
                self._parameters, self._scale, *self._tables, self._gradients, self._work,
                self._entries, self._base, self._moves, self._solution,
                self._kept_moves, self._kept_solution,
            )  # fmt: skip
            if not failed:
                break
        if failed:
            return Outcome(False, residual, iterations, worst)
        _apply(x_new, 1.0, self._atoms, self._moves)
        if velocities is not None:
            _apply(velocities, inv_dt, self._atoms, self._moves)
        if multipliers is not None:
            multipliers[:] = self._solution
        return Outcome(True, residual, iterations, worst)

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
        time: float,
    ) -> Outcome:
        """M-orthogonal projection of y onto A y = rates, in place."""
        wanted = self._targets if rates is None else rates[self.rows]
        failed, residual, iterations, worst = _tangents(
            x, y, wanted, rates is not None, NO_LATTICE if lattice is None else lattice, lattice is not None,
            self._clusters, self._atoms, self._atom_start, self._w, self._slots, self._slot_atoms, self._kinds,
            self._parameters, *self._tables, self._gradients, self._work,
            self._entries, self._base, self._moves, self._speeds, self._solution,
        )  # fmt: skip
        if failed:
            return Outcome(False, residual, iterations, worst)
        _apply(y, 1.0, self._atoms, self._moves)
        if multipliers is not None:
            np.negative(self._solution, out=multipliers)
        return Outcome(True, residual, iterations, worst)

    def rank(self, x: FloatArray, lattice: FloatArray | None) -> int:
        """Independent rows at `x`: those whose pivot does not vanish."""
        outcome = self.tangents(x, np.zeros_like(x), None, lattice, None, 0.0)
        if not outcome.converged:
            return len(self.rows)
        return int(np.count_nonzero(self._work[1]))


def _kinds_and_parameters(constraint_set: ConstraintSet) -> tuple[IntArray, FloatArray]:
    kinds = np.zeros(constraint_set.n_rows, dtype=np.int64)
    parameters = np.zeros((constraint_set.n_rows, PARAMETERS))
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        rows = slice(start, start + item.n_rows)
        kinds[rows] = item.kind
        if item.kind:
            given = item.parameters().reshape(item.n_rows, -1)[:, :PARAMETERS]
            parameters[rows, : given.shape[1]] = given
    return kinds, parameters


@nb.njit(cache=True)
def _number_atoms(flat, slots, clusters, n_atoms):  # type: ignore[no-untyped-def]
    """Atoms cluster by cluster in the order in which rows meet them, and the slots' atoms in that count."""
    place = np.full(n_atoms, -1, np.int64)
    atoms = np.empty(len(flat), np.uint32)
    numbers = np.empty(len(flat), np.uint32)
    atom_start = np.zeros(len(clusters), np.int64)
    used = 0
    for c in range(len(clusters) - 1):
        base = used
        for p in range(slots[clusters[c]], slots[clusters[c + 1]]):
            a = flat[p]
            if place[a] < base:
                place[a] = used
                atoms[used] = a
                used += 1
            numbers[p] = place[a]
        atom_start[c + 1] = used
    return atoms[:used].copy(), atom_start, numbers


@nb.njit(cache=True)
def _triples(start, columns, slots, slot_atoms, w):  # type: ignore[no-untyped-def]
    """For each entry (k, l) of the matrix: pairs of slots of k and l on one movable atom."""
    begin = np.zeros(len(columns) + 1, np.int64)
    for fill in range(2):
        if fill == 1:
            left = np.empty(begin[-1], np.uint32)
            right = np.empty(begin[-1], np.uint32)
        used = 0
        for k in range(len(start) - 1):
            for e in range(start[k], start[k + 1]):
                l = columns[e]
                for p in range(slots[k], slots[k + 1]):
                    for q in range(slots[l], slots[l + 1]):
                        if slot_atoms[p] == slot_atoms[q] and w[slot_atoms[p]] > 0:
                            if fill == 1:
                                left[used] = p
                                right[used] = q
                            used += 1
                begin[e + 1] = used
    return begin, left, right


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor(  # type: ignore[no-untyped-def]
    first, last, start, columns, target_start, targets, triple, left, right, slots, slot_atoms, w,
    now, ref, work, entries,
):  # fmt: skip
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep.

    `now` and `ref` are the gradients on the left and right of M^-1; `work` holds the accumulated change of the
    pivot, its reciprocal, and the right-hand side. Accumulated changes are left at zero.
    """
    change, pivot, side = work[0], work[1], work[2]
    for k in range(first, last):
        whole = 0.0
        for p in range(slots[k], slots[k + 1]):
            whole += w[slot_atoms[p]] * (
                now[3 * p] * ref[3 * p] + now[3 * p + 1] * ref[3 * p + 1] + now[3 * p + 2] * ref[3 * p + 2]
            )
        d = whole + change[k]
        change[k] = 0.0
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        pivot[k] = inverse
        bk = side[k]
        begin, end = start[k], start[k + 1]
        for p in range(begin, end):
            l = columns[p]
            up, low = entries[4 * p + 2], entries[4 * p + 3]
            for t in range(triple[p], triple[p + 1]):
                a, b = 3 * left[t], 3 * right[t]
                m = w[slot_atoms[left[t]]]
                up += m * (now[a] * ref[b] + now[a + 1] * ref[b + 1] + now[a + 2] * ref[b + 2])
                low += m * (now[b] * ref[a] + now[b + 1] * ref[a + 1] + now[b + 2] * ref[a + 2])
            low *= inverse
            entries[4 * p] = up
            entries[4 * p + 1] = low
            entries[4 * p + 2] = 0.0
            entries[4 * p + 3] = 0.0
            change[l] -= low * up
            side[l] -= low * bk
        t = target_start[k]
        for p in range(begin, end):
            up, low = entries[4 * p], entries[4 * p + 1]
            for q in range(p + 1, end):
                e = 4 * targets[t]
                entries[e + 2] -= low * entries[4 * q]
                entries[e + 3] -= entries[4 * q + 1] * up
                t += 1


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _forward(first, last, start, columns, work, entries):  # type: ignore[no-untyped-def]
    side = work[2]
    for k in range(first, last):
        bk = side[k]
        for p in range(start[k], start[k + 1]):
            side[columns[p]] -= entries[4 * p + 1] * bk


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _backward(first, last, start, columns, slots, slot_atoms, w, ref, work, entries, moves, solution):  # type: ignore[no-untyped-def]
    """Backward substitution; adds to the multipliers and moves the atoms along the reference gradients."""
    pivot, side = work[1], work[2]
    for back in range(last - first):
        k = last - 1 - back
        step = side[k]
        for p in range(start[k], start[k + 1]):
            step -= entries[4 * p] * side[columns[p]]
        step *= pivot[k]
        side[k] = step
        solution[k] += step
        for p in range(slots[k], slots[k + 1]):
            a = slot_atoms[p]
            f = step * w[a]
            moves[4 * a] += f * ref[3 * p]
            moves[4 * a + 1] += f * ref[3 * p + 1]
            moves[4 * a + 2] += f * ref[3 * p + 2]


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(  # type: ignore[no-untyped-def]
    careful, x_new, x_ref, wanted, lattice, periodic, clusters, atoms, atom_start, w, slots, slot_atoms, kinds,
    parameters, scale, start, columns, target_start, targets, triple, left, right, gradients, work, entries, base,
    moves, solution, kept_moves, kept_solution,
):  # fmt: skip
    now, ref = gradients[0], gradients[1]
    side, values, floor = work[2], work[3], work[4]
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = atoms[a]
            for axis in range(3):
                base[4 * a + axis] = x_ref[g, axis]
                moves[4 * a + axis] = 0.0
        evaluate(first, last, kinds, slots, slot_atoms, parameters, base, moves, lattice, periodic, values, ref)
        for a in range(atom_start[c], atom_start[c + 1]):
            g = atoms[a]
            for axis in range(3):
                base[4 * a + axis] = x_new[g, axis]
        for k in range(first, last):
            solution[k] = 0.0
            # What rounding leaves: of absolute positions for rows on space, of the row's own size for others.
            reach = 0.0
            for p in range(slots[k], slots[k + 1]):
                a = slot_atoms[p]
                g2 = ref[3 * p] ** 2 + ref[3 * p + 1] ** 2 + ref[3 * p + 2] ** 2
                x2 = base[4 * a] ** 2 + base[4 * a + 1] ** 2 + base[4 * a + 2] ** 2
                reach += np.sqrt(g2 * x2)
            floor[k] = max(1e-14 * scale[k], 2 * _EPS * reach)
        error = np.inf
        best = np.inf
        factored = False
        iteration = 0
        halvings = 0
        while True:
            previous = error
            error, total = 0.0, 0.0
            bad = first
            evaluate(first, last, kinds, slots, slot_atoms, parameters, base, moves, lattice, periodic, values, now)
            excess = 0.0
            for k in range(first, last):
                off = miss(kinds[k], values[k], wanted[k])
                side[k] = off
                e = abs(off) / scale[k]
                total += e
                if e > error:
                    error = e
                    bad = k
                excess = max(excess, abs(off) / floor[k])
            if careful and iteration > 0 and not (total < 0.999 * best) and error > 1e-10:
                # Step control: go back half the way.
                if halvings == MAX_HALVINGS:
                    return True, error, iteration, bad
                halvings += 1
                for a in range(4 * atom_start[c], 4 * atom_start[c + 1]):
                    moves[a] = kept_moves[a] + 0.5 * (moves[a] - kept_moves[a])
                for k in range(first, last):
                    solution[k] = kept_solution[k] + 0.5 * (solution[k] - kept_solution[k])
                error = previous
                continue
            if not (total < np.inf):
                for k in range(first, last):
                    if not (abs(side[k]) < np.inf):
                        return True, np.inf, iteration, k
            if iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0):
                return True, error, iteration, bad
            # Go on to the floor of the relative coordinates as long as Newton still gains.
            if excess <= 1.0 and (error <= 4e-15 or error > 0.1 * previous):
                break
            if careful:
                best = total
                halvings = 0
                for a in range(4 * atom_start[c], 4 * atom_start[c + 1]):
                    kept_moves[a] = moves[a]
                for k in range(first, last):
                    kept_solution[k] = solution[k]
            ratio = error / previous
            if factored and (error * ratio <= 4e-15 or ratio < 1e-4):
                _forward(first, last, start, columns, work, entries)
            else:
                _factor(
                    first, last, start, columns, target_start, targets, triple, left, right, slots, slot_atoms, w,
                    now, ref, work, entries,
                )  # fmt: skip
                factored = True
            _backward(first, last, start, columns, slots, slot_atoms, w, ref, work, entries, moves, solution)
            iteration += 1
        for k in range(first, last):
            along = 0.0
            for p in range(3 * slots[k], 3 * slots[k + 1]):
                along += now[p] * ref[p]
            # A gradient must not have turned by 90 degrees or more within the step.
            if not (along > 0.0):
                return True, np.inf, iteration, k
        if error >= worst:
            worst, worst_row = error, bad
        most = max(most, iteration)
    return False, worst, most, worst_row


@nb.njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(  # type: ignore[no-untyped-def]
    x, y, wanted, driven, lattice, periodic, clusters, atoms, atom_start, w, slots, slot_atoms, kinds, parameters,
    start, columns, target_start, targets, triple, left, right, gradients, work, entries, base, moves, speeds,
    solution,
):  # fmt: skip
    ref = gradients[1]
    side, values = work[2], work[3]
    worst, worst_row, most = 0.0, -1, 0
    for c in range(len(clusters) - 1):
        first, last = clusters[c], clusters[c + 1]
        for a in range(atom_start[c], atom_start[c + 1]):
            g = atoms[a]
            for axis in range(3):
                base[4 * a + axis] = x[g, axis]
                speeds[4 * a + axis] = y[g, axis]
                moves[4 * a + axis] = 0.0
        evaluate(first, last, kinds, slots, slot_atoms, parameters, base, moves, lattice, periodic, values, ref)
        largest, total = 0.0, 0.0
        for k in range(first, last):
            goal = wanted[k] if driven else 0.0
            off, size = goal, abs(goal)
            for p in range(slots[k], slots[k + 1]):
                a = 4 * slot_atoms[p]
                gx, gy, gz = ref[3 * p], ref[3 * p + 1], ref[3 * p + 2]
                vx, vy, vz = speeds[a], speeds[a + 1], speeds[a + 2]
                off -= gx * vx + gy * vy + gz * vz
                size += abs(gx * vx) + abs(gy * vy) + abs(gz * vz)
            side[k] = off
            largest = max(largest, size)
            total += size
            solution[k] = 0.0
        if not (total < np.inf):
            for k in range(first, last):
                if not (abs(side[k]) < np.inf):
                    return True, np.inf, 0, k
            return True, np.inf, 0, first
        _factor(
            first, last, start, columns, target_start, targets, triple, left, right, slots, slot_atoms, w,
            ref, ref, work, entries,
        )  # fmt: skip
        allowed = SPEED_TOLERANCE * largest
        previous = np.inf
        iteration = 0
        while True:
            _backward(first, last, start, columns, slots, slot_atoms, w, ref, work, entries, moves, solution)
            iteration += 1
            error, total = 0.0, 0.0
            bad = first
            for k in range(first, last):
                off = wanted[k] if driven else 0.0
                for p in range(slots[k], slots[k + 1]):
                    a = 4 * slot_atoms[p]
                    off -= (
                        ref[3 * p] * (speeds[a] + moves[a])
                        + ref[3 * p + 1] * (speeds[a + 1] + moves[a + 1])
                        + ref[3 * p + 2] * (speeds[a + 2] + moves[a + 2])
                    )
                side[k] = off
                total += abs(off)
                if abs(off) > error:
                    error = abs(off)
                    bad = k
            if not (total < np.inf):
                return True, np.inf, iteration, bad
            if error <= allowed or iteration > 8 or not (error < 0.5 * previous):
                break
            previous = error
            _forward(first, last, start, columns, work, entries)
        if error > 1e3 * allowed:
            return True, error, iteration, bad
        if error >= worst:
            worst, worst_row = error, bad
        most = max(most, iteration)
    return False, worst, most, worst_row


@nb.njit(cache=True, fastmath=FAST)
def _apply(x, factor, atoms, moves):  # type: ignore[no-untyped-def]
    for a in range(len(atoms)):
        g = atoms[a]
        x[g, 0] += factor * moves[4 * a]
        x[g, 1] += factor * moves[4 * a + 1]
        x[g, 2] += factor * moves[4 * a + 2]
