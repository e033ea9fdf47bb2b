"""Held distances, eight clusters at a time: what the solvers of rigid triangles, small clusters and chains share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import NO_NUMBERS, Kernels
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH, load_triple, scatter_points
from kcons.solvers.kernels.lattices import OPEN, lattice_kind, nearest_image
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import EPS, ROUNDING

_NO_POINTS = np.zeros((0, 3))


@dataclass
class PackedLanes:
    """A solver of eight clusters at a time, for other kernels: see `kcons.solvers.addressable_solvers`."""

    kernels: Kernels
    tables: FloatArray
    numbers: FloatArray = field(default_factory=lambda: NO_NUMBERS)

    def refuse(self) -> None:
        """There is nothing to be refused."""


class SimdClusterSolver:
    """Base of the solvers whose kernels take eight clusters, or parts of one, at once; each a `ClusterSolver`.

    Parameters
    ----------
    rows : array_like of int
        Global row numbers.
    lengths : array_like of float
        Lengths in the order of `rows`, used where a request names none.
    size : int
        Rows of a cluster; lanes that are left over repeat the last one.
    """

    name: str
    #: ``(tangent, points, references, velocities, inv_dt, given, lattice, kind, multipliers, tables)``; `tangent` is
    #: None for positions, to be brought to the lengths `given`, and () for vectors to be brought to these rates: a
    #: kernel is compiled for each of the two. (For a True in a kernel and one from Python it would be compiled twice.)
    _kernel: Any
    #: What the kernel knows of the rows, in one array.
    tables: FloatArray

    def __init__(self, rows: ArrayLike, lengths: ArrayLike, size: int) -> None:
        self.rows: IntArray = np.array(rows, dtype=np.int64).reshape(-1)
        self.lengths: FloatArray = np.array(lengths, dtype=np.float64).reshape(-1)
        self._size, self._last = size, len(self.rows) - size
        #: The last lattice, an array that nobody writes to, as the kernel takes it.
        self._lattice: FloatArray | None = None
        self._cell, self._kind = lattice_kind(None)

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Move positions along the gradients at the reference onto the held lengths, by true Newton."""
        lengths = self.lengths if request.wanted is None else request.wanted[self.rows]
        return self._project(None, request, lengths, multipliers)

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Project velocities, or forces per mass, so that u.(y_i - y_j) is the wanted rate of each length."""
        rates = NO_NUMBERS if request.wanted is None else request.wanted[self.rows]
        return self._project((), request, rates, multipliers)

    def _project(
        self, tangent: tuple[()] | None, request: Request, given: FloatArray, multipliers: FloatArray | None
    ) -> Outcome:
        points, references, _, lattice, _, _, velocities, inv_dt, _, _ = request
        if lattice is not self._lattice:
            self._lattice = lattice
            self._cell, self._kind = lattice_kind(lattice)
        ok, residual, iterations, row = self._kernel(
            tangent,
            points,
            references,
            _NO_POINTS if velocities is None else velocities,
            inv_dt,
            given,
            self._cell,
            self._kind,
            NO_NUMBERS if multipliers is None else multipliers,
            self.tables,
        )
        if row >= self._last:
            # Rows of lanes that repeat the last cluster are that cluster's rows.
            row = self._last + row % self._size
        return Outcome(ok, residual, iterations, row)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def resolved(x, pairs, lengths, lattice, kind):  # type: ignore[no-untyped-def]
    """Whether each |sigma| at `x` is within what rounding leaves of it, see `kcons.solvers.tolerances`."""
    for k in range(len(lengths)):
        i, j = pairs[2 * k], pairs[2 * k + 1]
        ax, ay, az = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        if kind != OPEN:
            ax, ay, az = nearest_image(ax, ay, az, lattice)
        d = lengths[k]
        miss = abs(ax * ax + ay * ay + az * az - d * d) / (2.0 * d)
        if not (miss <= ROUNDING * d):
            reach = np.sqrt(x[i, 0] ** 2 + x[i, 1] ** 2 + x[i, 2] ** 2)
            reach += np.sqrt(x[j, 0] ** 2 + x[j, 1] ** 2 + x[j, 2] ** 2)
            if not (miss <= 2 * EPS * reach):
                return False
    return True


@njit(fastmath=FASTMATH, forceinline=True)
def dot(ax, ay, az, bx, by, bz):
    """Scalar product of two triples."""
    return ax * bx + ay * by + az * bz


SAVED = 3 * WIDTH
"""Doubles that `shift_points` keeps of one point in eight lanes."""


@njit(fastmath=FASTMATH)
def restore_points(points, table, undo, groups, n_local, stride, first):
    """Write back what `keep_points` kept of the first `groups` groups."""
    for group in range(groups):
        for k in range(n_local):
            saved = (group * stride + first + k) * SAVED
            x, y, z = load_triple(undo, saved)
            scatter_points(points, table, (group * n_local + k) * WIDTH, x, y, z)


def lane_tables(atoms: NDArray[np.int64], n_rows: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Offsets of rows by (group, lane), and of points by (group, local atom, lane).

    The last group is filled up with the last cluster: its lanes compute and
    write the same numbers twice, which needs no special code.
    """
    n_groups = -(-len(atoms) // WIDTH)
    slots = np.minimum(np.arange(n_groups * WIDTH), len(atoms) - 1)
    by_lane = atoms[slots].reshape(n_groups, WIDTH, -1).transpose(0, 2, 1)
    return (n_rows * slots).astype(np.uint32), (3 * by_lane).astype(np.uint32).reshape(-1)


@njit(fastmath=FASTMATH, error_model="numpy")
def worst_row(errors, sizes, n_rows):
    """Largest ``error / size`` of a group and its row ``n_rows * lane + k``."""
    worst, row = -1.0, 0
    for lane in range(WIDTH):
        for k in range(n_rows):
            error, size = abs(errors[k * WIDTH + lane]), sizes[k * WIDTH + lane]
            ratio = 0.0 if error == 0.0 else error / size
            if not ratio <= worst:
                worst, row = ratio, n_rows * lane + k
                if worst != worst:
                    return worst, row
    return worst, row
