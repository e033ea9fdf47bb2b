"""Distance rows of every shape behind one pair of kernels, for kernels that do more than solve in one call.

A kernel that is called from Python pays for each array that it is given, and one that knows solvers of many kinds is
compiled for each of their combinations. Here all that the solvers need lies in one array: rigid triangles, eight at a
time (`solvers.rigid_triangles`), long chains (`chains.chains`), and whatever else is held by sparse elimination
(`kcons.solvers.sparse.distances`), which knows every shape and is the fastest for few rows of many shapes. The array
names the functions of those that are there by their addresses, so that each is compiled once. Rows that are no
distances have solvers that are called in the same way (`solvers.called_solvers`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers import called_solvers
from kcons.solvers.called_solvers import CalledSolver, address_of, caller_of, words_of
from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.chains.sweeps import project
from kcons.solvers.distance_clusters import resolved
from kcons.solvers.kernels.aligned_memory import in_one_array
from kcons.solvers.kernels.array_views import at_piece, halves, integers, lattice_piece, none_of, octets, piece
from kcons.solvers.kernels.eight_wide import WIDTH
from kcons.solvers.kernels.groups_of_eight import NO_LATTICE, OPEN, lattice_kind, restore_points
from kcons.solvers.kernels.two_and_four_wide import entry, number, put
from kcons.solvers.rigid_triangles import RigidTriangles, project_triangles
from kcons.solvers.sparse import distances
from kcons.solvers.sparse.distances import SparseDistances

#: Rounds from where the last one ended, until the lengths are what the positions resolve.
_MAX_ROUNDS = 4

#: Pieces: lengths, pairs, what `SparseDistances.tables` gives, tables of triangles, fixed atoms, the cell, and what
#: `Chains.tables` gives.
_LENGTHS, _PAIRS, _ATOMS, _MOVES = 0, 1, 3, 16
_CORNERS, _SLOTS, _SIDES, _WEIGHTS, _UNDO, _PINNED, _PLACES, _KIND, _LATTICE, _CHAINS = range(20, 30)
_CHAIN_PIECES = 12
_CALLED = _CHAINS + _CHAIN_PIECES
_FUNCTIONS = _CALLED + 1
MORE = _FUNCTIONS + 1

_POINTS, _NUMBERS = types.float64[:, ::1], types.float64[::1]
#: Of what brings positions onto lengths, (x, x_ref, v, inv_dt, tables): iterations, or -1.
_POSITIONS = types.int64(_POINTS, _POINTS, _POINTS, types.float64, _NUMBERS)
#: Of what makes vectors tangent, (x, v, tables).
_TANGENTS = types.boolean(_POINTS, _POINTS, _NUMBERS)
_call_positions, _call_tangents = caller_of(_POSITIONS), caller_of(_TANGENTS)
#: Which function is where in the piece of their addresses: for positions one of each solver, then what moves the atoms
#: of the first; the same for velocities. 0 stands for none.
_SOLVERS = 3
_FIRST, _MOVE_FIRST, _TURN, _SLOW_FIRST = 0, _SOLVERS, _SOLVERS + 1, 2 * _SOLVERS + 1


def packed(
    triangles: RigidTriangles | None,
    chains: Chains | None,
    pairs: IntArray,
    lengths: FloatArray,
    inverse_masses: FloatArray,
    pinned: IntArray,
    places: FloatArray,
    *more: NDArray[Any],
    numbers: IntArray | None = None,
    late: NDArray[np.bool_] | None = None,
    called: Sequence[CalledSolver] = (),
) -> FloatArray:
    """What `packed_positions` and `packed_tangents` need to know.

    Parameters
    ----------
    triangles : RigidTriangles or None
    chains : Chains or None
    pairs : ndarray of int, shape (n_rows, 2)
        The other rows, whole clusters.
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    pinned : ndarray of int
        Fixed atoms.
    places : ndarray, shape (n_pinned, 3)
    *more : ndarray of float64 or uint32, flat
        Pieces number `MORE` and on, for the caller's own kernels.
    numbers : ndarray of int, optional
        What the atoms that `chains` knows are called here; None where they are called the same.
    late : ndarray of bool, shape (n_rows,), optional
        Which of `pairs` depend on others, see `kcons.solvers.sparse.elimination.make_pattern`.
    called : sequence of CalledSolver
        Of all other rows, to be kept as long as the tables are used; neither with triangles nor with chains.

    Returns
    -------
    ndarray of float64
        Begins with where each piece starts and ends, as integers.
    """
    pieces: list[NDArray[Any]]
    if len(pairs):
        solver = SparseDistances(np.arange(len(pairs)), pairs, lengths, inverse_masses, late)
        tables, rooms = solver.tables()
        pieces = [solver.lengths, pairs[solver.rows].astype(np.uint32).ravel(), *tables, *rooms]
    else:
        none, offsets, start = np.zeros(0), np.zeros(0, dtype=np.uint32), np.zeros(1, dtype=np.int64)
        pieces = [none, offsets, start, offsets, start, none, *[offsets] * 3, *[none] * 11]
    if triangles is None:
        pieces += [np.zeros(0, dtype=np.uint32)] * 2 + [np.zeros(0)] * 3
    else:
        pieces += triangles.tables()
    pieces += [pinned.astype(np.uint32), places.ravel(), np.zeros(1, dtype=np.int64), NO_LATTICE.ravel()]
    pieces += [np.zeros(0)] * _CHAIN_PIECES if chains is None else chains.tables(numbers)
    there = len(pairs) > 0, triangles is not None, chains is not None, len(pairs) > 0
    functions = [address_of(each, _POSITIONS) if held else 0 for each, held in zip(_POSITION_PARTS, there, strict=True)]
    functions += [address_of(each, _TANGENTS) if held else 0 for each, held in zip(_TANGENT_PARTS, there, strict=True)]
    pieces += [words_of(called), np.array(functions, dtype=np.int64), *more]
    return in_one_array(pieces)


def set_lattice(tables: FloatArray, lattice: FloatArray | None) -> None:
    """Change the periodic cell, shape (2, 3, 3) with its inverse, in tables of `packed`."""
    values, kind = lattice_kind(lattice)
    header = tables.view(np.int64)
    tables[header[2 * _LATTICE] : header[2 * _LATTICE + 1]] = values.ravel()
    header[header[2 * _KIND]] = kind


@njit(cache=True, nogil=True)
def _place_others(x, x_ref, v, inv_dt, tables):  # type: ignore[no-untyped-def]
    t, h, u = tables, integers(tables), halves(tables)
    failed, _, iterations, _ = distances.solve_positions(
        False, x, x_ref, piece(t, h, 0), lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]] != OPEN, piece(h, h, 2),
        piece(u, h, 3), piece(h, h, 4), piece(t, h, 5), piece(u, h, 6), piece(u, h, 7), piece(u, h, 8), piece(t, h, 9),
        piece(t, h, 10), piece(t, h, 11), piece(t, h, 12), piece(t, h, 13), piece(t, h, 14), piece(t, h, 15),
        piece(t, h, 16), piece(t, h, 17), piece(t, h, 18), piece(t, h, 19),
    )  # fmt: skip
    return -1 if failed else iterations


@njit(cache=True, nogil=True)
def _move_others(x, x_ref, v, inv_dt, tables):  # type: ignore[no-untyped-def]
    """What `_place_others` has found, and -1 if the lengths are not yet what the positions resolve."""
    t, h, u = tables, integers(tables), halves(tables)
    distances.apply_both(x, v, inv_dt, piece(u, h, _ATOMS), piece(t, h, _MOVES))
    lattice, periodic = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]] != OPEN
    return 0 if resolved(x, piece(u, h, _PAIRS).reshape(-1, 2), piece(t, h, _LENGTHS), lattice, periodic) else -1


@njit(cache=True, nogil=True)
def _place_triangles(x, x_ref, v, inv_dt, tables):  # type: ignore[no-untyped-def]
    t, h, u = tables, integers(tables), halves(tables)
    landed, _, iterations, _ = project_triangles(
        x, x_ref, v, inv_dt, None, piece(u, h, _CORNERS), piece(u, h, _SLOTS), piece(t, h, _WEIGHTS),
        piece(t, h, _SIDES), lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]], none_of(t), piece(t, h, _UNDO),
    )  # fmt: skip
    return iterations if landed else -1


@njit(cache=True, nogil=True)
def _restore_triangles(points, at, kept, tables):  # type: ignore[no-untyped-def]
    """Points of triangles as they were before these were solved, from number `at` of the `kept` points of each."""
    h, u = integers(tables), halves(tables)
    groups = piece(u, h, _SLOTS).size // WIDTH
    restore_points(points, piece(u, h, _CORNERS), piece(tables, h, _UNDO), groups, 3, kept, at)


@njit(cache=True, nogil=True)
def _place_chains(x, x_ref, v, inv_dt, tables):  # type: ignore[no-untyped-def]
    """As `Chains.positions` does it."""
    t, h, u, b = tables, integers(tables), halves(tables), octets(tables)
    lattice, kind = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]]
    most = 0
    for again in range(_MAX_ROUNDS + 1):
        landed, _, iterations, _ = project(
            x, x_ref, v, inv_dt, None, piece(h, h, _CHAINS), piece(u, h, _CHAINS + 1), piece(b, h, _CHAINS + 2),
            piece(b, h, _CHAINS + 3), piece(u, h, _CHAINS + 4), piece(t, h, _CHAINS + 5), piece(t, h, _CHAINS + 6),
            piece(h, h, _CHAINS + 7), piece(t, h, _CHAINS + 8), lattice, kind, none_of(t), piece(t, h, _CHAINS + 10),
            piece(t, h, _CHAINS + 11),
        )  # fmt: skip
        if again == 0:
            if not landed:
                _restore_triangles(x, 0, 6, tables)
                _restore_triangles(v, 3, 6, tables)
                return -1
            most = iterations
        if not landed or resolved(
            x, piece(u, h, _CHAINS + 9).reshape(-1, 2), piece(t, h, _CHAINS + 8), lattice, kind != OPEN
        ):
            break
    return most


@njit(cache=True, nogil=True)
def _turn_others(x, v, tables):  # type: ignore[no-untyped-def]
    t, h, u = tables, integers(tables), halves(tables)
    failed, _, _, _ = distances.solve_tangents(
        x, v, t, False, lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]] != OPEN, piece(h, h, 2), piece(u, h, 3),
        piece(h, h, 4), piece(t, h, 5), piece(u, h, 6), piece(u, h, 7), piece(u, h, 8), piece(t, h, 9),
        piece(t, h, 10), piece(t, h, 11), piece(t, h, 12), piece(t, h, 13), piece(t, h, 14), piece(t, h, 15),
        piece(t, h, 16), piece(t, h, 17),
    )  # fmt: skip
    return not failed


@njit(cache=True, nogil=True)
def _slow_others(x, v, tables):  # type: ignore[no-untyped-def]
    """What `_turn_others` has found."""
    distances.apply(v, piece(halves(tables), integers(tables), _ATOMS), piece(tables, integers(tables), _MOVES))
    return True


@njit(cache=True, nogil=True)
def _turn_triangles(x, v, tables):  # type: ignore[no-untyped-def]
    t, h, u = tables, integers(tables), halves(tables)
    converged, _, _, _ = project_triangles(
        v, x, none_of(t).reshape(0, 3), 0.0, True, piece(u, h, _CORNERS), piece(u, h, _SLOTS), piece(t, h, _WEIGHTS),
        none_of(t), lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]], none_of(t), piece(t, h, _UNDO),
    )  # fmt: skip
    return converged


@njit(cache=True, nogil=True)
def _turn_chains(x, v, tables):  # type: ignore[no-untyped-def]
    t, h, u, b = tables, integers(tables), halves(tables), octets(tables)
    none = none_of(t)
    converged, _, _, _ = project(
        v, x, none.reshape(0, 3), 0.0, True, piece(h, h, _CHAINS), piece(u, h, _CHAINS + 1), piece(b, h, _CHAINS + 2),
        piece(b, h, _CHAINS + 3), piece(u, h, _CHAINS + 4), piece(t, h, _CHAINS + 5), piece(t, h, _CHAINS + 6),
        piece(h, h, _CHAINS + 7), none, lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]], none,
        piece(t, h, _CHAINS + 10), piece(t, h, _CHAINS + 11),
    )  # fmt: skip
    if not converged:
        _restore_triangles(v, 0, 3, tables)
    return converged


_POSITION_PARTS = _place_others, _place_triangles, _place_chains, _move_others
_TANGENT_PARTS = _turn_others, _turn_triangles, _turn_chains, _slow_others


@njit(cache=True, nogil=True)
def packed_positions(x, x_ref, v, inv_dt, tables):  # type: ignore[no-untyped-def]
    """Bring `x` onto the lengths along the gradients at `x_ref`, and change `v` by that times `inv_dt`.

    Parameters
    ----------
    tables
        From `packed`.

    Returns
    -------
    int
        Iterations; -1 where there is no solution, with `x` and `v` as they were but for fixed atoms.
    """
    t, h, u = tables, integers(tables), halves(tables)
    pinned, places = at_piece(u, h, _PINNED), at_piece(t, h, _PLACES)
    for k in range(3 * (h[2 * _PINNED + 1] - h[2 * _PINNED])):
        put(x, 3 * entry(pinned, k // 3) + k % 3, number(places, k))
    functions, words = at_piece(h, h, _FUNCTIONS), piece(h, h, _CALLED)
    given = x, x_ref, v, inv_dt, tables
    # Nothing is written before all is solved, except that triangles and chains undo what they wrote.
    most = 0
    for k in range(_SOLVERS):
        if functions[k] != 0:
            iterations = _call_positions(functions[k], given)
            if iterations < 0:
                return -1
            most = max(most, iterations)
    if words.size:
        lattice, periodic = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]] != OPEN
        iterations = called_solvers.solve_positions(words, x, x_ref, v, inv_dt, none_of(t), lattice, periodic)
        if iterations < 0:
            return -1
        most = max(most, iterations)
    if functions[_FIRST] != 0:
        # Large multipliers have a rounding that shows in the positions; another round takes it away.
        for again in range(_MAX_ROUNDS + 1):
            if _call_positions(functions[_MOVE_FIRST], given) == 0 or again == _MAX_ROUNDS:
                break
            iterations = _call_positions(functions[_FIRST], given)
            if iterations < 0:
                break
            most = max(most, iterations)
    return most


@njit(cache=True, nogil=True)
def packed_tangents(x, v, tables):  # type: ignore[no-untyped-def]
    """Project `v` so that no length changes; whether that was possible, `v` otherwise as it was."""
    t, h, u = tables, integers(tables), halves(tables)
    pinned = at_piece(u, h, _PINNED)
    for k in range(3 * (h[2 * _PINNED + 1] - h[2 * _PINNED])):
        put(v, 3 * entry(pinned, k // 3) + k % 3, 0.0)
    functions, words = at_piece(h, h, _FUNCTIONS), piece(h, h, _CALLED)
    given = x, v, tables
    for k in range(_TURN, _SLOW_FIRST):
        if functions[k] != 0 and not _call_tangents(functions[k], given):
            return False
    if words.size:
        lattice, periodic = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]] != OPEN
        if not called_solvers.solve_tangents(words, v, x, none_of(t), lattice, periodic):
            return False
    if functions[_SLOW_FIRST] != 0:
        _call_tangents(functions[_SLOW_FIRST], given)
    return True
