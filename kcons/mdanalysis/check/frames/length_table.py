"""Rows that are lengths, laid out for the compiled loops over frames."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import Block
from kcons.mdanalysis.check.frames.deviations import Deviations
from kcons.mdanalysis.check.frames.frame_kernels import (
    LANES,
    UNIFORM,
    Lengths,
    farthest,
    filled,
    length_rates,
    lengths,
    look_at,
    padded,
    powers_below,
    triangles,
)


class LengthTable:
    """Lengths of a set. Triangles, such as rigid water, are evaluated three sides at once, all others one by one.

    Parameters
    ----------
    rows : ndarray of int, shape (n,)
        Their numbers in the set.
    pairs : ndarray of int, shape (n, 2)
    targets : ndarray, shape (n,)
    n_atoms : int
        Of the set.
    """

    _powers: NDArray[np.float32]
    _triangles: Lengths
    _singles: Lengths

    def __init__(self, rows: IntArray, pairs: IntArray, targets: FloatArray, n_atoms: int) -> None:
        self.rows, self._pairs, self._n_atoms = rows, pairs, n_atoms
        self._all_places: NDArray[np.uint32] | None = None
        sides = _triangles(pairs)
        single = np.ones(len(pairs), dtype=bool)
        single[sides.ravel()] = False
        corners = np.stack([pairs[sides[0], 0], pairs[sides[0], 1], pairs[sides[1], 1]])
        self._triangle_rows, self._single_rows = rows[sides], rows[single]
        self._triangle_places = np.ascontiguousarray(corners, dtype=np.uint32), np.ascontiguousarray(targets[sides])
        self._single_places = padded(pairs[single], targets[single])

    def allow(self, slack: FloatArray) -> None:
        """Say what each row of the set may be off by, besides the rounding of its coordinates."""
        self._triangle_slack = np.ascontiguousarray(slack[self._triangle_rows])
        self._single_slack = filled(slack[self._single_rows])

    def fresh(self) -> LengthTable:
        """A copy that shares the rows and has empty statistics."""
        other = copy.copy(self)
        other._powers = np.zeros(self._n_atoms, dtype=np.float32)
        other._triangles = _begun(*self._triangle_places, self._triangle_slack)
        other._singles = _begun(*self._single_places, self._single_slack)
        return other

    def look(
        self,
        into: Deviations,
        k: int,
        x: NDArray[np.float32],
        cell: tuple[FloatArray, float],
        precision: FilePrecision,
        summed: bool,
    ) -> bool:
        """Put what is found in one frame into the k-th place; False if a coordinate is no number.

        See `RowTable.look`.
        """
        far = size_of(farthest(x)) if precision.exact else 0.0
        base, factor = precision.coefficients(far)
        powers = UNIFORM
        if factor > 0:
            powers = self._powers
            powers_below(x, powers)
        rounding = (precision.grid, base, factor)
        here, row = into.by_frame[0, :, k], -1
        if self._triangle_rows.size:
            *found, side, triangle, coarsest, seen = triangles(x, self._triangles, cell, rounding, powers, summed)
            here[:] = (*found, coarsest, seen)
            row = self._triangle_rows[side, triangle]
        if len(self._single_rows):
            sums, squares, worst, excess, place, coarsest, seen = lengths(
                x, self._singles, cell, rounding, powers, summed
            )
            if excess > here[3]:
                row = self._single_rows[min(place, len(self._single_rows) - 1)]
            here[[0, 1, 5]] += sums, squares, seen - self._filling
            here[2:5] = np.maximum(here[2:5], (worst, excess, coarsest))
        into.worst_row[0, k] = row
        return bool(here[1] < np.inf)

    @property
    def _filling(self) -> int:
        """Rows that fill up; see `padded`."""
        return len(self._singles.targets) - len(self._single_rows)

    def look_at_rates(
        self,
        into: Deviations,
        k: int,
        x: NDArray[np.float32],
        v: NDArray[np.float32],
        cell: tuple[FloatArray, float],
        grid: float,
    ) -> None:
        """Put the rates of change that velocities make into the k-th place."""
        if self._all_places is None:
            self._all_places, _ = padded(self._pairs, 0.0)
        squares, worst, row = length_rates(x, v, self._all_places, len(self.rows), cell, grid)
        into.rate_squares[0, k] = squares
        into.rate_worst[0, k], into.rate_row[0, k] = worst, self.rows[row]

    def look_at_block(
        self,
        into: Deviations,
        k: int,
        block: Block,
        points: NDArray[np.float32],
        every: tuple[int, int],
        cells: tuple[FloatArray, FloatArray],
        coefficients: tuple[float, float],
    ) -> tuple[int, FloatArray]:
        """See `RowTable.look_at_block`.

        Parameters
        ----------
        cells : (ndarray, ndarray)
            See `kcons.mdanalysis.check.frames.frame_kernels.look_at`.
        coefficients : (float, float)
            See `FilePrecision.coefficients`.
        """
        n = len(block.words)
        side, place = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        far = np.full(n, np.float32(np.nan).view(np.int32))
        # Of its own, so that the kernel gets one type of array in one frame and in many.
        by_frame = np.zeros((6, n))
        done = look_at(
            block.words,
            block.x,
            points,
            self._powers,
            (k, *every, into.n_frames),
            cells,
            (0.0, *coefficients),
            self._triangles,
            self._singles,
            (by_frame, side, place, far),
        )
        into.by_frame[0, :, k : k + done] = by_frame[:, :done]
        into.seen[0, k : k + done] -= self._filling
        into.worst_row[0, k : k + n] = np.where(
            side < 0, _row_of(self._single_rows, place), _row_of(self._triangle_rows, place, side)
        )
        return done, size_of(far)

    def collect(self, into: Deviations) -> None:
        """Put what was found by row where it belongs."""
        n = len(self._single_rows)
        for rows, found in ((self._single_rows, self._singles), (self._triangle_rows, self._triangles)):
            end = n if rows.ndim == 1 else rows.shape[1]
            into.margins[rows], into.largest[rows] = found.margins[..., :end], found.largest[..., :end]
            into.by_row[:, rows] = found.sums[..., :end]


def _begun(places: Any, targets: FloatArray, slack: FloatArray) -> Lengths:
    """Rows of which nothing has been seen."""
    shape = targets.shape
    margins, largest = np.full(shape, -np.inf, np.float32), np.zeros(shape, np.float32)
    return Lengths(places, targets, slack, margins, largest, np.zeros((3, *shape)))


def _row_of(rows: IntArray, place: IntArray, side: IntArray | None = None) -> IntArray:
    """Numbers of rows; where they are not of this kind, any."""
    n = rows.shape[-1]
    if not n:
        return np.full(len(place), -1, dtype=np.int64)
    at = np.minimum(place, n - 1)
    result: IntArray = rows[at] if side is None else rows[np.maximum(side, 0), at]
    return result


def size_of(bits: Any) -> Any:
    """What `farthest` found, as a number."""
    found = np.asarray(bits, dtype=np.int32).view(np.float32)
    return found.astype(np.float64) if found.ndim else float(found)


def _triangles(pairs: IntArray) -> IntArray:
    """Rows that follow each other as (a, b), (a, c), (b, c): shape (3, n), n a multiple of four."""
    if len(pairs) < 3:
        return np.zeros((3, 0), dtype=np.int64)
    one, two, three = pairs[:-2], pairs[1:-1], pairs[2:]
    fits = (one[:, 0] == two[:, 0]) & (one[:, 1] == three[:, 0]) & (two[:, 1] == three[:, 1])
    chosen, free = [], 0
    for k in np.flatnonzero(fits).tolist():
        if k >= free:
            chosen.append(k)
            free = k + 3
    first = np.array(chosen[: len(chosen) // LANES * LANES], dtype=np.int64)
    return np.stack([first, first + 1, first + 2])
