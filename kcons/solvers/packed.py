"""Distance rows of every shape behind one pair of kernels, for kernels that do more than solve in one call.

A kernel that is called from Python pays for each array that it is given, and one that calls solvers of many kinds is
compiled for each of their combinations. Here all that the solvers need lies in three arrays: rigid triangles, eight at
a time (`kcons.solvers.water`), and whatever else is held by sparse elimination (`kcons.solvers.distances`), which
knows every shape and is the fastest for few rows of many shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers import distances
from kcons.solvers.distances import SparseDistances
from kcons.solvers.elimination import UIntArray
from kcons.solvers.groups import OPEN
from kcons.solvers.storage import LINE, aligned
from kcons.solvers.water import RigidTriangles, triangle_positions, triangle_tangents

#: Rounds from where the last one ended, until the lengths are what the positions resolve.
_MAX_ROUNDS = 4
#: Numbers in a cache line.
_ALIGNMENT = LINE // 8
_NO_NUMBERS = np.zeros(0)
_NO_OFFSETS = np.zeros(0, dtype=np.uint32)

Packed = tuple[FloatArray, IntArray, UIntArray]


def packed(
    triangles: RigidTriangles | None,
    pairs: IntArray,
    lengths: FloatArray,
    inverse_masses: FloatArray,
    pinned: IntArray,
    places: FloatArray,
) -> Packed:
    """What `packed_positions` and `packed_tangents` need to know.

    Parameters
    ----------
    triangles : RigidTriangles or None
    pairs : ndarray of int, shape (n_rows, 2)
        The other rows, whole clusters.
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    pinned : ndarray of int
        Fixed atoms.
    places : ndarray, shape (n_pinned, 3)

    Returns
    -------
    numbers : ndarray of float64
    whole : ndarray of int64
        Begins with where the pieces of all three are.
    small : ndarray of uint32
    """
    if len(pairs):
        solver = SparseDistances(np.arange(len(pairs)), pairs, lengths, inverse_masses)
        (clusters, atoms, atom_start, w, links, columns, targets, couplings, weights), rooms = solver.tables()
        floats = [solver.lengths, w, couplings, weights, *rooms]
        integers = [clusters, atom_start]
        unsigned = [atoms, links, columns, targets, pairs[solver.rows].ravel()]
    else:
        floats, integers, unsigned = [_NO_NUMBERS] * 13, [np.zeros(1, dtype=np.int64)] * 2, [_NO_OFFSETS] * 5
    if triangles is None:
        floats += [_NO_NUMBERS] * 3
        unsigned += [_NO_OFFSETS] * 2
    else:
        corners, slots, sides, inv_mass, undo = triangles.tables()
        floats += [sides.ravel(), inv_mass, undo]
        unsigned += [corners, slots]
    floats.append(places.ravel())
    unsigned.append(pinned)
    head = 2 * (len(floats) + len(integers) + len(unsigned))
    parts = [_placed(floats, 0), _placed(unsigned, 0), _placed(integers, head)]
    numbers, small, whole = aligned(parts[0][1]), np.zeros(parts[1][1], np.uint32), np.zeros(parts[2][1], np.int64)
    whole[:head] = np.concatenate([cuts for cuts, _ in parts]).ravel()
    for room, pieces, (cuts, _) in zip((numbers, small, whole), (floats, unsigned, integers), parts, strict=True):
        for piece, (start, end) in zip(pieces, cuts, strict=True):
            room[start:end] = piece
    return numbers, whole, small


def _placed(pieces: Sequence[NDArray[Any]], start: int) -> tuple[IntArray, int]:
    """Where each piece begins and ends, shape (n, 2), each in a cache line of its own; and the end of all."""
    cuts = np.zeros((len(pieces), 2), dtype=np.int64)
    for k, piece in enumerate(pieces):
        cuts[k] = start, start + piece.size
        start += -(-piece.size // _ALIGNMENT) * _ALIGNMENT
    return cuts, start


# Places in the header: floats, then unsigned numbers, then integers, each with its start and its end.


@nb.njit(cache=True, inline="always")
def _floats(numbers, whole, k):  # type: ignore[no-untyped-def]
    return numbers[whole[2 * k] : whole[2 * k + 1]]


@nb.njit(cache=True, inline="always")
def _unsigned(small, whole, k):  # type: ignore[no-untyped-def]
    return small[whole[34 + 2 * k] : whole[34 + 2 * k + 1]]


@nb.njit(cache=True, inline="always")
def _integers(whole, k):  # type: ignore[no-untyped-def]
    return whole[whole[50 + 2 * k] : whole[50 + 2 * k + 1]]


@nb.njit(cache=True, inline="always")
def _solve(x, x_ref, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]
    """Newton's method for all rows but those of triangles; nothing changes but the rooms."""
    return distances.solve_positions(
        False, x, x_ref, _floats(numbers, whole, 0), lattice, kind != OPEN, _integers(whole, 0),
        _unsigned(small, whole, 0), _integers(whole, 1), _floats(numbers, whole, 1), _unsigned(small, whole, 1),
        _unsigned(small, whole, 2), _unsigned(small, whole, 3), _floats(numbers, whole, 2),
        _floats(numbers, whole, 3), _floats(numbers, whole, 4), _floats(numbers, whole, 5),
        _floats(numbers, whole, 6), _floats(numbers, whole, 7), _floats(numbers, whole, 8),
        _floats(numbers, whole, 9), _floats(numbers, whole, 10), _floats(numbers, whole, 11),
        _floats(numbers, whole, 12),
    )  # fmt: skip


@nb.njit(cache=True, nogil=True)
def packed_positions(x, x_ref, v, inv_dt, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]
    """Bring `x` onto the lengths along the gradients at `x_ref`, and change `v` by that times `inv_dt`.

    Returns
    -------
    int
        Iterations; -1 where there is no solution, with `x` and `v` as they were but for fixed atoms.
    """
    pinned, places = _unsigned(small, whole, 7), _floats(numbers, whole, 16)
    for k in range(pinned.size):
        for axis in range(3):
            x[pinned[k], axis] = places[3 * k + axis]
    atoms = _unsigned(small, whole, 0)
    most = 0
    if atoms.size:
        failed, _, most, _ = _solve(x, x_ref, lattice, kind, numbers, whole, small)
        if failed:
            return -1
    slots = _unsigned(small, whole, 6)
    if slots.size:
        landed, _, iterations, _ = triangle_positions(
            x, x_ref, v, inv_dt, _unsigned(small, whole, 5), slots, _floats(numbers, whole, 13).reshape(-1, 3),
            _floats(numbers, whole, 14), lattice, kind, places[:0], _floats(numbers, whole, 15),
        )  # fmt: skip
        if not landed:
            return -1
        most = max(most, iterations)
    if atoms.size:
        moves = _floats(numbers, whole, 9)
        distances.apply_both(x, v, inv_dt, atoms, moves)
        pairs, lengths = _unsigned(small, whole, 4).reshape(-1, 2), _floats(numbers, whole, 0)
        for _ in range(_MAX_ROUNDS):
            # Large multipliers have a rounding that shows in the positions; another round takes it away.
            if distances.resolved(x, pairs, lengths, lattice, kind != OPEN):
                break
            failed, _, _, _ = _solve(x, x_ref, lattice, kind, numbers, whole, small)
            if failed:
                break
            distances.apply_both(x, v, inv_dt, atoms, moves)
    return most


@nb.njit(cache=True, nogil=True)
def packed_tangents(x, v, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]
    """Project `v` so that no length changes; whether that was possible, `v` otherwise as it was."""
    pinned = _unsigned(small, whole, 7)
    for k in range(pinned.size):
        for axis in range(3):
            v[pinned[k], axis] = 0.0
    atoms = _unsigned(small, whole, 0)
    moves = _floats(numbers, whole, 9)
    if atoms.size:
        failed, _, _, _ = distances.solve_tangents(
            x, v, moves, False, lattice, kind != OPEN, _integers(whole, 0),
            atoms, _integers(whole, 1), _floats(numbers, whole, 1), _unsigned(small, whole, 1),
            _unsigned(small, whole, 2), _unsigned(small, whole, 3), _floats(numbers, whole, 2),
            _floats(numbers, whole, 3), _floats(numbers, whole, 4), _floats(numbers, whole, 5),
            _floats(numbers, whole, 6), _floats(numbers, whole, 7), _floats(numbers, whole, 8),
            moves, _floats(numbers, whole, 10),
        )  # fmt: skip
        if failed:
            return False
    slots = _unsigned(small, whole, 6)
    if slots.size:
        converged, _, _, _ = triangle_tangents(
            x, v, _unsigned(small, whole, 5), slots, moves[:0], _floats(numbers, whole, 14), lattice, kind, moves[:0],
            _floats(numbers, whole, 15),
        )  # fmt: skip
        if not converged:
            return False
    if atoms.size:
        distances.apply(v, atoms, moves)
    return True
