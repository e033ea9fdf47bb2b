"""Many equal small clusters of held distances, one cluster to a SIMD lane.

A cluster has up to six rows of any connection: single bonds, CH₂ and CH₃
groups, short chains, rings, a tetrahedron. One kernel is compiled for each
number of rows; connection and masses are its data.
"""

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.distance_clusters import SAVED, dot, lane_tables, minus, plus, restore_points, times, worst_row
from kcons.solvers.kernels.aligned_memory import in_one_array, room
from kcons.solvers.kernels.array_views import at_first, halves, integers, table_array
from kcons.solvers.kernels.eight_wide import (
    FASTMATH,
    WIDTH,
    absolute,
    all_within,
    gather,
    gather_differences,
    keep_points,
    not_positive,
    peek,
    poke,
    scatter,
    scatter_points,
    splat,
    square_root,
    stack,
    store,
)
from kcons.solvers.kernels.lattices import OPEN, lattice_numbers, minimum_image
from kcons.solvers.tolerances import MAX_ITERATIONS, NEWTON_TOLERANCE, SPEED_TOLERANCE, TINY

LARGEST = 6
"""Rows of the largest cluster; its matrix of 36 vectors stays in the first cache."""


@njit(fastmath=FASTMATH, forceinline=True)
def _factor(matrix, n):
    """LU factors in place, reciprocal pivots on the diagonal."""
    for k in range(n):
        pivot = 1.0 / peek(matrix, k * n + k)
        poke(matrix, k * n + k, pivot)
        for i in range(k + 1, n):
            factor = peek(matrix, i * n + k) * pivot
            poke(matrix, i * n + k, factor)
            for j in range(k + 1, n):
                poke(matrix, i * n + j, peek(matrix, i * n + j) - factor * peek(matrix, k * n + j))


@njit(fastmath=FASTMATH, forceinline=True)
def _solve(matrix, right, n):
    """Solve in place with the factors of `_factor`."""
    for i in range(1, n):
        value = peek(right, i)
        for j in range(i):
            value = value - peek(matrix, i * n + j) * peek(right, j)
        poke(right, i, value)
    for back in range(n):
        i = n - 1 - back
        value = peek(right, i)
        for j in range(i + 1, n):
            value = value - peek(matrix, i * n + j) * peek(right, j)
        poke(right, i, value * peek(matrix, i * n + i))


@njit(fastmath=FASTMATH, forceinline=True)
def _point(room, k):
    return peek(room, 3 * k), peek(room, 3 * k + 1), peek(room, 3 * k + 2)


@njit(fastmath=FASTMATH, forceinline=True)
def _set_point(room, k, point):
    poke(room, 3 * k, point[0])
    poke(room, 3 * k + 1, point[1])
    poke(room, 3 * k + 2, point[2])


@njit(fastmath=FASTMATH, forceinline=True)
def _gram(matrix, left, right, coupling, n):
    """``coupling[k, l] * (left_k · right_l)``, factored."""
    for k in range(n):
        for j in range(n):
            poke(matrix, k * n + j, dot(_point(left, k), _point(right, j)) * peek(coupling, k * n + j))
    _factor(matrix, n)


@njit(fastmath=FASTMATH, forceinline=True)
def _move(bonds, directions, step, coupling, n):
    """Change of the bonds by the multipliers `step`."""
    for k in range(n):
        bond = _point(bonds, k)
        for j in range(n):
            bond = plus(bond, _point(directions, j), peek(step, j) * peek(coupling, k * n + j))
        _set_point(bonds, k, bond)


@njit(fastmath=FASTMATH, forceinline=True)
def _spread(shifts, ends, bonds, total, n, n_local):
    """What the multipliers `total` along the bonds do to each point, over its inverse mass."""
    for a in range(n_local):
        _set_point(shifts, a, (splat(0.0), splat(0.0), splat(0.0)))
    for k in range(n):
        i, j, pull = ends[2 * k], ends[2 * k + 1], times(_point(bonds, k), peek(total, k))
        _set_point(shifts, i, plus(_point(shifts, i), pull, 1.0))
        _set_point(shifts, j, minus(_point(shifts, j), pull))


@njit(fastmath=FASTMATH, forceinline=True)
def _move_points(points, velocities, inverse_dt, atoms, at, weights, shifts, n_local, move, undo, saved):
    """Move the points of eight clusters, and change their velocities; what was there is kept."""
    for a in range(n_local):
        i, shift = at + a * WIDTH, times(_point(shifts, a), weights[a])
        point = keep_points(points, atoms, i, undo, saved + a * SAVED)
        scatter_points(points, atoms, i, plus(point, shift, 1.0))
        if move:
            velocity = keep_points(velocities, atoms, i, undo, saved + (n_local + a) * SAVED)
            scatter_points(velocities, atoms, i, plus(velocity, shift, inverse_dt))


@njit(fastmath=FASTMATH, forceinline=True)
def _report(multipliers, slots, place, sign, bonds, total, n):
    """Multipliers of unit gradients."""
    for k in range(n):
        bond = _point(bonds, k)
        scatter(multipliers, slots, place, k, sign * (peek(total, k) * square_root(dot(bond, bond))))


# These two are spliced into the loop as they stand: compiled apart, they are rounded otherwise, or slower.


@njit(fastmath=FASTMATH, inline="always")
def _begin(
    points, references, atoms, at, ends, goal, slots, place, cell, kind, tangent, driven, s, r, squares, wanted, sums, n
):  # fmt: skip
    """Bonds, and what is wanted of them; returns what relative velocities are compared with, squared."""
    size = splat(0.0)
    for k in range(n):
        i, j = at + ends[2 * k] * WIDTH, at + ends[2 * k + 1] * WIDTH
        reference, bond = gather_differences(references, atoms, i, j), gather_differences(points, atoms, i, j)
        if kind != OPEN:
            reference = minimum_image(reference, cell, kind)
            if tangent is None:
                bond = minimum_image(bond, cell, kind)
        _set_point(s, k, reference)
        _set_point(r, k, bond)
        poke(sums, k, splat(0.0))
        if tangent is None:
            length = gather(goal, slots, place, k)
            poke(squares, k, length * length)
        else:
            square = dot(reference, reference)
            poke(squares, k, square)
            size = size + dot(bond, bond)
            rate = splat(0.0)
            if driven:
                rate = gather(goal, slots, place, k)
                size = size + rate * rate
                rate = rate * square_root(square)
            poke(wanted, k, rate)
    return size


@njit(fastmath=FASTMATH, inline="always")
def _judge(error, step, squares, bonds, references, tangent, limit, n):
    """Whether no bond has turned round, and whether no error is above `limit`; sizes of errors, and the products."""
    kept, better = True, True
    for k in range(n):
        e, inner = peek(error, k), peek(squares, k)
        if tangent is None:
            # A bond that turned round has found the wrong root.
            e, inner = absolute(e), dot(_point(bonds, k), _point(references, k))
        else:
            e = e * e
        poke(error, k, e)
        poke(step, k, inner)
        kept = kept and all_within(TINY, inner)
        better = better and all_within(e, peek(squares, k) * limit)
    return kept, better


@functools.cache
def _kernel(n_rows: int, tangent: tuple[()] | None) -> Any:
    """The kernel for clusters of `n_rows` rows; the closed-over number unrolls its loops."""
    n, n_square, n_coordinates = n_rows, n_rows * n_rows, 3 * n_rows
    n_shifts = 3 * (n_rows + 1)

    @njit(cache=True, fastmath=FASTMATH, error_model="numpy")
    def project(alone, points, references, velocities, inverse_dt, wanted, lattice, kind, tables, multipliers):
        """Project one group of eight clusters after another, as `kcons.solvers.addressable_solvers` says."""
        t, h, u = tables, integers(tables), halves(tables)
        atoms, slots = table_array(u, h, 0), table_array(u, h, 1)
        ends, weights = table_array(h, h, 2), table_array(t, h, 3)
        couplings, undo = table_array(t, h, 4), table_array(t, h, 5)
        given = table_array(t, h, 6) if tangent is None and not wanted.size else wanted
        move, report, driven = tangent is None and inverse_dt != 0.0, multipliers.shape[0] > 0, given.shape[0] > 0
        n_local = weights.shape[0]
        # Arrays that are handed on inside the loop would cost reference counting.
        changed, moving, table, room = at_first(points), at_first(velocities), at_first(atoms), at_first(undo)
        origins, goals, firsts = at_first(references), at_first(given), at_first(slots)
        row_ends, heavy = at_first(ends), at_first(weights)
        # Points kept of a cluster, what residuals are counted in, and the sign of multipliers.
        kept_points, unit, sign = (2 * n_local, 2.0, 1.0) if tangent is None else (n_local, 1.0, -1.0)
        cell = lattice_numbers(lattice)
        errors, sizes = table_array(t, h, 7), table_array(t, h, 8)
        # Reference bonds s, present bonds r; what is wanted of these, and what errors are compared with.
        s, r, shifts = stack(n_coordinates), stack(n_coordinates), stack(n_shifts)
        matrix, coupling = stack(n_square), stack(n_square)
        squares, goal = stack(n), stack(n)
        error, step, total = stack(n), stack(n), stack(n)
        for k in range(n_square):
            poke(coupling, k, splat(couplings[k]))
        worst, worst_at, most = 0.0, -1, 0
        for group in range(slots.shape[0] // WIDTH):
            at = group * n_local * WIDTH
            size = _begin(
                changed, origins, table, at, row_ends, goals, firsts, group * WIDTH, cell, kind, tangent, driven,
                s, r, squares, goal, total, n,
            )  # fmt: skip
            if tangent is not None:
                size = size * (SPEED_TOLERANCE * SPEED_TOLERANCE)
                _gram(matrix, s, s, coupling, n)
            iteration = 0
            ok = False
            while True:
                # An infinite speed would make every error look small.
                ok = all_within(size, 1e300)
                for k in range(n):
                    bond = _point(r, k)
                    if tangent is None:
                        e = peek(squares, k) - dot(bond, bond)
                        limit = peek(squares, k) * (2.0 * NEWTON_TOLERANCE)
                        ok = ok and all_within(absolute(e), limit)
                    else:
                        e = peek(goal, k) - dot(bond, _point(s, k))
                        ok = ok and all_within(e * e, size * peek(squares, k))
                    poke(error, k, e)
                if ok or iteration == MAX_ITERATIONS:
                    break
                # A factor serves two steps: Newton, then chord; order three for both.
                if tangent is None and iteration % 2 == 0:
                    _gram(matrix, r, s, coupling, n)
                for k in range(n):
                    poke(step, k, peek(error, k) / unit)
                _solve(matrix, step, n)
                _move(r, s, step, coupling, n)
                for k in range(n):
                    poke(total, k, peek(total, k) + peek(step, k))
                iteration += 1
            most = max(most, iteration)
            kept, better = _judge(error, step, squares, r, s, tangent, unit * worst, n)
            if not (ok and kept and better):
                for k in range(n):
                    store(errors, k * WIDTH, peek(error, k))
                    store(sizes, k * WIDTH, unit * peek(squares, k))
                    if ok and not kept:
                        store(errors, k * WIDTH, not_positive(peek(step, k)))
                        store(sizes, k * WIDTH, splat(1.0))
                worst, worst_at = worst_row(errors, sizes, n, slots, group * WIDTH)
                if not (ok and kept):
                    restore_points(points, atoms, undo, group, n_local, kept_points, 0)
                    if move:
                        restore_points(velocities, atoms, undo, group, n_local, kept_points, n_local)
                    return False, worst if tangent is None else np.sqrt(worst), most, worst_at
            _spread(shifts, row_ends, s, total, n, n_local)
            saved = kept_points * group * SAVED
            _move_points(changed, moving, inverse_dt, table, at, heavy, shifts, n_local, move, room, saved)
            if report:
                _report(at_first(multipliers), firsts, group * WIDTH, sign, s, total, n)
        return True, worst if tangent is None else np.sqrt(worst), most, worst_at

    return project


def _couplings(pairs: NDArray[np.int64], inv_mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of bond k by a unit pull along bond l: ``D M⁻¹ Dᵀ`` of the graph."""
    incidence = np.zeros((len(pairs), len(inv_mass)))
    rows = np.arange(len(pairs))
    incidence[rows, pairs[:, 0]] += 1.0
    incidence[rows, pairs[:, 1]] -= 1.0
    return np.ascontiguousarray((incidence * inv_mass) @ incidence.T).reshape(-1)


class SmallClusters(AddressableSolver):
    """Clusters of the same connection and masses, up to `LARGEST` distances each.

    Parameters
    ----------
    rows : array_like of int, shape (n_clusters, K)
        Global row numbers.
    atoms : array_like of int, shape (n_clusters, n_local)
        Atoms of each cluster.
    pairs : array_like of int, shape (K, 2)
        Local atoms of each row, the same in every cluster.
    lengths : array_like of float, shape (n_clusters, K)
        Lengths used where a request names none.
    inv_mass : array_like of float, shape (n_local,)
        Inverse masses; 0 for a pinned atom.
    """

    name = "SmallClusters"

    def __init__(
        self, rows: ArrayLike, atoms: ArrayLike, pairs: ArrayLike, lengths: ArrayLike, inv_mass: ArrayLike
    ) -> None:
        local = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        members = np.array(atoms, dtype=np.int64)
        self._made_of = rows, atoms, pairs, lengths, inv_mass
        self.rows = np.array(rows, dtype=np.int64).reshape(-1)
        self.kernels = Kernels(_kernel(len(local), None), _kernel(len(local), ()))
        weights = np.array(inv_mass, dtype=np.float64)
        slots, points = lane_tables(members, len(local))
        given = points, slots, local.reshape(-1), weights, _couplings(local, weights)
        sides, work = np.array(lengths, dtype=np.float64).reshape(-1), (room(len(local) * WIDTH) for _ in range(2))
        self.tables = in_one_array((*given, room(6 * len(points)), sides, *work))
