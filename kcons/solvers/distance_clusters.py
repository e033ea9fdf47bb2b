"""Held distances, eight clusters at a time: what the solvers of rigid triangles, small clusters and chains share."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.called_solvers import NO_NUMBERS, Kernels
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.kernels.lattices import OPEN, lattice_kind, nearest_image
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import EPS, ROUNDING

_NO_POINTS = np.zeros((0, 3))


class PackedLanes(NamedTuple):
    """A solver of eight clusters at a time, for other kernels: see `kcons.solvers.called_solvers`."""

    kernels: Kernels
    tables: FloatArray
    numbers: FloatArray = NO_NUMBERS

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
    #: None for positions, to be brought to the lengths `given`, and True for vectors to be brought to these rates.
    #: A kernel is compiled for each of the two.
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
        return self._project(True, request, rates, multipliers)

    def _project(
        self, tangent: Literal[True] | None, request: Request, given: FloatArray, multipliers: FloatArray | None
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
