"""Distance rows of every shape behind one pair of kernels, for kernels that do more than solve in one call.

A kernel that is called from Python pays for each array that it is given, and one that calls solvers of many kinds is
compiled for each of their combinations. Here all that the solvers need lies in one array: rigid triangles, eight at a
time (`solvers.rigid_triangles`), long chains (`chains.chains`), and whatever else is held by sparse elimination
(`kcons.solvers.sparse.distances`), which knows every shape and is the fastest for few rows of many shapes. Rows that
are no distances have solvers that are called by address (`solvers.called_solvers`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers import called_solvers
from kcons.solvers.called_solvers import CalledSolver, words_of
from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.chains.sweeps import project
from kcons.solvers.distance_clusters import resolved
from kcons.solvers.kernels.aligned_memory import in_one_array
from kcons.solvers.kernels.array_views import halves, integers, lattice_piece, octets, piece
from kcons.solvers.kernels.eight_wide import WIDTH
from kcons.solvers.kernels.groups_of_eight import NO_LATTICE, OPEN, lattice_kind, restore_points
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
MORE = _CALLED + 1

Packed = tuple[FloatArray, int | None, int | None, int | None, int | None]


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
) -> Packed:
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
    tables : ndarray of float64
        Begins with where each piece starts and ends, as integers.
    triangles, others, chains, called : int or None
        Whether there are rows of each kind: 1, or None.
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
    pieces += [words_of(called), *more]
    there = triangles is not None, len(pairs) > 0, chains is not None, len(called) > 0
    first, second, third, last = (1 if each else None for each in there)
    return in_one_array(pieces), first, second, third, last


def set_lattice(tables: FloatArray, lattice: FloatArray | None) -> None:
    """Change the periodic cell, shape (2, 3, 3) with its inverse, in tables of `packed`."""
    values, kind = lattice_kind(lattice)
    header = tables.view(np.int64)
    tables[header[2 * _LATTICE] : header[2 * _LATTICE + 1]] = values.ravel()
    header[header[2 * _KIND]] = kind


# What is None is pruned before compilation: systems without triangles, or with nothing else, do not wait for the other.


@nb.njit(cache=True, nogil=True)
def packed_positions(x, x_ref, v, inv_dt, tables, triangles, others, chains, called):  # type: ignore[no-untyped-def]
    """Bring `x` onto the lengths along the gradients at `x_ref`, and change `v` by that times `inv_dt`.

    Parameters
    ----------
    tables, triangles, others, chains, called
        From `packed`.

    Returns
    -------
    int
        Iterations; -1 where there is no solution, with `x` and `v` as they were but for fixed atoms.
    """
    t, h, u = tables, integers(tables), halves(tables)
    lattice, kind = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]]
    pinned, places = piece(u, h, _PINNED), piece(t, h, _PLACES)
    for k in range(pinned.size):
        for axis in range(3):
            x[pinned[k], axis] = places[3 * k + axis]
    b, first = octets(tables), True
    # Nothing is written before all is solved, except that triangles and chains undo what they wrote.
    most = 0
    for turn in range(_MAX_ROUNDS + 1):
        if others is not None:
            failed, _, iterations, _ = distances.solve_positions(
                False, x, x_ref, piece(t, h, 0), lattice, kind != OPEN, piece(h, h, 2), piece(u, h, 3),
                piece(h, h, 4), piece(t, h, 5), piece(u, h, 6), piece(u, h, 7), piece(u, h, 8), piece(t, h, 9),
                piece(t, h, 10), piece(t, h, 11), piece(t, h, 12), piece(t, h, 13), piece(t, h, 14), piece(t, h, 15),
                piece(t, h, 16), piece(t, h, 17), piece(t, h, 18), piece(t, h, 19),
            )  # fmt: skip
            if failed:
                return most if turn else -1
            most = max(most, iterations)
        if called is not None and turn == 0:
            iterations = called_solvers.solve_positions(
                piece(h, h, _CALLED), x, x_ref, v, inv_dt, t[:0], lattice, kind != OPEN
            )
            if iterations < 0:
                return -1
            most = max(most, iterations)
        if triangles is not None and turn == 0:
            landed, _, iterations, _ = project_triangles(
                x, x_ref, v, inv_dt, None, piece(u, h, _CORNERS), piece(u, h, _SLOTS), piece(t, h, _WEIGHTS),
                piece(t, h, _SIDES), lattice, kind, t[:0], piece(t, h, _UNDO),
            )  # fmt: skip
            if not landed:
                return -1
            most = max(most, iterations)
        if chains is not None and turn == 0:
            # As `Chains.positions` does it.
            for again in range(_MAX_ROUNDS + 1):
                landed, _, iterations, _ = project(
                    x, x_ref, v, inv_dt, None, piece(h, h, _CHAINS), piece(u, h, _CHAINS + 1),
                    piece(b, h, _CHAINS + 2), piece(b, h, _CHAINS + 3), piece(u, h, _CHAINS + 4),
                    piece(t, h, _CHAINS + 5), piece(t, h, _CHAINS + 6), piece(h, h, _CHAINS + 7),
                    piece(t, h, _CHAINS + 8), lattice, kind, t[:0], piece(t, h, _CHAINS + 10),
                    piece(t, h, _CHAINS + 11),
                )  # fmt: skip
                if again == 0:
                    first, most = landed, max(most, iterations)
                if not landed or resolved(
                    x, piece(u, h, _CHAINS + 9).reshape(-1, 2), piece(t, h, _CHAINS + 8), lattice, kind != OPEN
                ):
                    break
            if not first:
                if triangles is not None:
                    groups, undo = piece(u, h, _SLOTS).size // WIDTH, piece(t, h, _UNDO)
                    restore_points(x, piece(u, h, _CORNERS), undo, groups, 3, 6, 0)
                    restore_points(v, piece(u, h, _CORNERS), undo, groups, 3, 6, 3)
                return -1
        if others is None:
            break
        distances.apply_both(x, v, inv_dt, piece(u, h, _ATOMS), piece(t, h, _MOVES))
        # Large multipliers have a rounding that shows in the positions; another round takes it away.
        if resolved(x, piece(u, h, _PAIRS).reshape(-1, 2), piece(t, h, _LENGTHS), lattice, kind != OPEN):
            break
    return most


@nb.njit(cache=True, nogil=True)
def packed_tangents(x, v, tables, triangles, others, chains, called):  # type: ignore[no-untyped-def]
    """Project `v` so that no length changes; whether that was possible, `v` otherwise as it was."""
    t, h, u = tables, integers(tables), halves(tables)
    lattice, kind = lattice_piece(t, h, _LATTICE), h[h[2 * _KIND]]
    pinned = piece(u, h, _PINNED)
    for k in range(pinned.size):
        for axis in range(3):
            v[pinned[k], axis] = 0.0
    if others is not None:
        failed, _, _, _ = distances.solve_tangents(
            x, v, t, False, lattice, kind != OPEN, piece(h, h, 2), piece(u, h, 3), piece(h, h, 4), piece(t, h, 5),
            piece(u, h, 6), piece(u, h, 7), piece(u, h, 8), piece(t, h, 9), piece(t, h, 10), piece(t, h, 11),
            piece(t, h, 12), piece(t, h, 13), piece(t, h, 14), piece(t, h, 15), piece(t, h, 16), piece(t, h, 17),
        )  # fmt: skip
        if failed:
            return False
    if called is not None and not called_solvers.solve_tangents(
        piece(h, h, _CALLED), v, x, t[:0], lattice, kind != OPEN
    ):
        return False
    if triangles is not None:
        converged, _, _, _ = project_triangles(
            v, x, t[:0].reshape(0, 3), 0.0, True, piece(u, h, _CORNERS), piece(u, h, _SLOTS), piece(t, h, _WEIGHTS),
            t[:0], lattice, kind, t[:0], piece(t, h, _UNDO),
        )  # fmt: skip
        if not converged:
            return False
    if chains is not None:
        b, none = octets(tables), t[:0]
        converged, _, _, _ = project(
            v, x, none.reshape(0, 3), 0.0, True, piece(h, h, _CHAINS), piece(u, h, _CHAINS + 1),
            piece(b, h, _CHAINS + 2), piece(b, h, _CHAINS + 3), piece(u, h, _CHAINS + 4), piece(t, h, _CHAINS + 5),
            piece(t, h, _CHAINS + 6), piece(h, h, _CHAINS + 7), none, lattice, kind, none,
            piece(t, h, _CHAINS + 10), piece(t, h, _CHAINS + 11),
        )  # fmt: skip
        if not converged:
            if triangles is not None:
                groups = piece(u, h, _SLOTS).size // WIDTH
                restore_points(v, piece(u, h, _CORNERS), piece(t, h, _UNDO), groups, 3, 3, 0)
            return False
    if others is not None:
        distances.apply(v, piece(u, h, _ATOMS), piece(t, h, _MOVES))
    return True
