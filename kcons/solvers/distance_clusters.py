"""Held distances of every shape: what their solvers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.kernels.aligned_memory import aligned
from kcons.solvers.kernels.groups_of_eight import NO_NUMBERS, NO_POINTS, lattice_kind
from kcons.solvers.kernels.nearest_image import NO_LATTICE, nearest_image

_EPS = float(np.finfo(float).eps)
#: As `kcons.solvers.sparse.elimination.FAST`, see there.
_FAST = {"contract", "arcp", "nsz"}


class DistanceClusters(ABC):
    """Base of the solvers of held distances, each a `ClusterSolver`.

    Attributes
    ----------
    rows : ndarray of int64, shape (n_rows,)
        Row numbers in the set.
    lengths : ndarray, shape (n_rows,)
        Lengths used where a request names none.
    """

    name: str
    rows: IntArray
    lengths: FloatArray

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Move positions along the gradients at the reference onto the held lengths, by true Newton."""
        lengths = self.lengths if request.wanted is None else request.wanted[self.rows]
        return self._project(request, lengths, None, multipliers)

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Project velocities, or forces per mass, so that u.(y_i - y_j) is the wanted rate of each length."""
        rates = NO_NUMBERS if request.wanted is None else request.wanted[self.rows]
        return self._project(request, rates, True, multipliers)

    @abstractmethod
    def _project(
        self, request: Request, given: FloatArray, tangent: Literal[True] | None, multipliers: FloatArray | None
    ) -> Outcome:
        """Positions onto the lengths `given` (`tangent` None), or vectors to rates, none of which stands for 0."""


class EightAtATime(DistanceClusters):
    """Base of the solvers whose kernels take eight clusters, or pieces of one, at once.

    Parameters
    ----------
    rows : array_like of int
        Global row numbers.
    lengths : array_like of float
        Lengths in the order of `rows`.
    size : int
        Rows of a cluster; lanes that are left over repeat the last one.
    """

    #: Called with what is projected, then `_tables` and the rooms to work in.
    _kernel: Any
    _tables: tuple[NDArray[Any], ...]
    #: Numbers that each room holds.
    _sizes: tuple[int, ...]

    def __init__(self, rows: ArrayLike, lengths: ArrayLike, size: int) -> None:
        self.rows = np.array(rows, dtype=np.int64).reshape(-1)
        self.lengths = np.array(lengths, dtype=np.float64).reshape(-1)
        self._size, self._last = size, len(self.rows) - size
        self._rooms: tuple[FloatArray, ...] = ()
        #: The last lattice, an array that nobody writes to, as the kernel takes it.
        self._lattice: FloatArray | None = None
        self._cell, self._kind = lattice_kind(None)

    def _project(
        self, request: Request, given: FloatArray, tangent: Literal[True] | None, multipliers: FloatArray | None
    ) -> Outcome:
        points, references, _, lattice, _, _, velocities, inv_dt, _, _ = request
        if lattice is not self._lattice:
            self._lattice = lattice
            self._cell, self._kind = lattice_kind(lattice)
        ok, residual, iterations, row = self._kernel(
            points,
            references,
            NO_POINTS if velocities is None else velocities,
            inv_dt,
            tangent,
            *self._tables,
            given,
            self._cell,
            self._kind,
            NO_NUMBERS if multipliers is None else multipliers,
            *(self._rooms or self._make_rooms()),
        )
        if row >= self._last:
            # Rows of lanes that repeat the last cluster are that cluster's rows.
            row = self._last + row % self._size
        return Outcome(ok, residual, iterations, row)

    def _make_rooms(self) -> tuple[FloatArray, ...]:
        self._rooms = tuple(aligned(n) for n in self._sizes)
        return self._rooms


def lengths_resolved(x: FloatArray, pairs: NDArray[np.uint32], lengths: FloatArray, lattice: FloatArray | None) -> bool:
    """Whether each |sigma| at `x` is within max(1e-14 d, 2 eps (|x_i| + |x_j|))."""
    return bool(resolved(x, pairs, lengths, NO_LATTICE if lattice is None else lattice, lattice is not None))


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def resolved(x, pairs, lengths, lattice, periodic):  # type: ignore[no-untyped-def]
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
