"""All rows of a set in one frame after another: compiled for lengths, by the constraint objects for the rest."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kcons.constraint_set import ConstraintSet
from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import NonFiniteError
from kcons.mdanalysis.dcd import Block, look_at
from kcons.solvers.frames import LANES, coordinate_grid, length_rates, lengths, padded, triangles
from kcons.solvers.lattice import NO_LATTICE

#: Natural units of rows, in this order.
UNITS = ("Å", "rad")


def unit_of(item: Constraint) -> int:
    """Which of `UNITS` the coordinate of a constraint has; coordinates of one's own count as lengths."""
    return int(item.family in ("Angle", "Dihedral") or item.period is not None)


@dataclass
class Deviations:
    """What was found in some frames: by row, and by unit (see `UNITS`) in each frame.

    Attributes
    ----------
    largest, total : ndarray, shape (n_rows,)
        Largest absolute deviation; sum of the deviations over the frames that were summed.
    n_summed : int
        How many these are.
    worst, worst_row, sums, squares : ndarray, shape (n_units, n_frames)
        In each frame: the largest absolute deviation and its row, sum and sum of squares.
    rate_worst, rate_row, rate_squares : ndarray, shape (n_units, n_frames)
        The same of A v, NaN without velocities.
    """

    n_rows: int
    n_frames: int
    n_summed: int = 0
    largest: FloatArray = field(init=False)
    total: FloatArray = field(init=False)
    worst: FloatArray = field(init=False)
    worst_row: IntArray = field(init=False)
    sums: FloatArray = field(init=False)
    squares: FloatArray = field(init=False)
    rate_worst: FloatArray = field(init=False)
    rate_row: IntArray = field(init=False)
    rate_squares: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.largest, self.total = np.zeros(self.n_rows), np.zeros(self.n_rows)
        shape = (len(UNITS), self.n_frames)
        self.worst, self.sums, self.squares = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self.rate_worst, self.rate_squares = np.full(shape, np.nan), np.full(shape, np.nan)
        self.worst_row, self.rate_row = np.full(shape, -1, np.int64), np.full(shape, -1, np.int64)

    def cut(self, n_frames: int) -> None:
        """Leave out what was not reached."""
        self.n_frames = n_frames
        for name in ("worst", "sums", "squares", "rate_worst", "rate_squares", "worst_row", "rate_row"):
            setattr(self, name, getattr(self, name)[:, :n_frames])

    def with_next(self, other: Deviations) -> Deviations:
        """Both, one after the other."""
        both = Deviations(self.n_rows, 0)
        both.n_frames = self.n_frames + other.n_frames
        both.largest = np.maximum(self.largest, other.largest)
        both.total = self.total + other.total
        both.n_summed = self.n_summed + other.n_summed
        for name in ("worst", "sums", "squares", "rate_worst", "rate_squares", "worst_row", "rate_row"):
            setattr(both, name, np.concatenate([getattr(self, name), getattr(other, name)], axis=1))
        return both


class RowTable:
    """Rows of a set, laid out for reading many frames.

    Parameters
    ----------
    constraint_set : ConstraintSet
        In angstrom, with all targets.
    grid : float
        Steps of the coordinates in the file, in angstrom, where these can be had back exactly; 0 otherwise.
    """

    def __init__(self, constraint_set: ConstraintSet, grid: float) -> None:
        self.set = constraint_set
        self.grid = grid
        self._dimensions: tuple[float, ...] = ()
        self._box = np.zeros((2, 3, 3))
        self._cell: tuple[FloatArray, float] = NO_LATTICE, np.inf
        self.units: IntArray = np.concatenate(
            [np.full(c.n_rows, unit_of(c), dtype=np.int64) for c in constraint_set.constraints] or [np.zeros(0, int)]
        )
        none = np.zeros(0, dtype=np.int64)
        pairs, held, length_rows, other_rows = [np.zeros((0, 2), np.int64)], [np.zeros(0)], [none], [none]
        for item, first, end in zip(
            constraint_set.constraints, constraint_set.starts[:-1], constraint_set.starts[1:], strict=True
        ):
            if item.family == "Distance" and not item.moving:
                length_rows.append(np.arange(first, end))
                pairs.append(item.atoms)
                held.append(item.target_at(0.0))
            else:
                other_rows.append(np.arange(first, end))
        self.length_rows: IntArray = np.concatenate(length_rows)
        self.other_rows: IntArray = np.concatenate(other_rows)
        self._pairs, wanted = np.concatenate(pairs), np.concatenate(held)
        self._all_places: NDArray[np.uint32] | None = None
        # Rigid water first: three sides at once, for less than two. What is left goes one by one.
        sides = _triangles(self._pairs)
        single = np.ones(len(self._pairs), dtype=bool)
        single[sides.ravel()] = False
        self._triangle_rows = self.length_rows[sides]
        corners = np.stack([self._pairs[sides[0], 0], self._pairs[sides[0], 1], self._pairs[sides[1], 1]])
        self._corners = np.ascontiguousarray(3 * corners, dtype=np.uint32)
        self._triangle_targets = np.ascontiguousarray(wanted[sides])
        self._triangle_largest, self._triangle_total = np.zeros(sides.shape, np.float32), np.zeros(sides.shape)
        self._single_rows = self.length_rows[single]
        self._places, self._targets = padded(self._pairs[single], wanted[single])
        self._largest, self._total = np.zeros(len(self._targets), np.float32), np.zeros(len(self._targets))
        self._others: ConstraintSet | None = None
        if len(self.other_rows):
            self._others, self._other_atoms = constraint_set.subset(self.other_rows)
            self._other_units = self.units[self.other_rows]
            self._holonomic = self._others.holonomic

    @property
    def only_lengths(self) -> bool:
        """Whether compiled code does all of it, so that whole blocks of a file can be looked at."""
        return self._others is None

    def fresh(self) -> RowTable:
        """One that shares all but what is changed while frames are looked at; each worker needs its own."""
        other = copy.copy(self)
        other._box, other._dimensions = np.zeros((2, 3, 3)), ()
        for name in ("_largest", "_total", "_triangle_largest", "_triangle_total"):
            setattr(other, name, np.zeros_like(getattr(self, name)))
        return other

    # -- cell -----------------------------------------------------------------------------------

    def cell_of(self, dimensions: NDArray[np.float32] | None) -> tuple[FloatArray, float]:
        """Cell with its inverse, shape (2, 3, 3), and the square of half its smallest width."""
        if dimensions is None:
            return NO_LATTICE, np.inf
        values = tuple(dimensions.tolist())
        if values != self._dimensions:
            self._dimensions, self._cell = values, self._new_cell(values)
        return self._cell

    def _new_cell(self, values: tuple[float, ...]) -> tuple[FloatArray, float]:
        a, b, c, *angles = values
        shortest = min(a, b, c)
        if angles == [90.0, 90.0, 90.0] and shortest > 0:
            box = self._box
            box[0, 0, 0], box[0, 1, 1], box[0, 2, 2] = a, b, c
            box[1, 0, 0], box[1, 1, 1], box[1, 2, 2] = 1.0 / a, 1.0 / b, 1.0 / c
            return box, (0.5 * shortest) ** 2
        matrix = cell_matrix(values)
        if matrix is None:
            return NO_LATTICE, np.inf
        inverse = np.linalg.inv(matrix)
        half = 0.5 / float(np.linalg.norm(inverse, axis=0).max())
        return np.ascontiguousarray(np.stack([matrix, inverse])), half * half

    # -- one frame ------------------------------------------------------------------------------

    def look(
        self,
        into: Deviations,
        k: int,
        x: NDArray[np.float32],
        v: NDArray[np.float32] | None,
        dimensions: NDArray[np.float32] | None,
        time: float,
        summed: bool = True,
    ) -> None:
        """Put what is found in one frame into the k-th place.

        Parameters
        ----------
        x, v : ndarray of float32, shape (3 n_atoms,)
            Positions in angstrom and velocities in angstrom/ps.
        dimensions : ndarray or None
            Lengths and angles of the cell.
        time : float
            For targets that move.
        summed : bool
            Whether this frame counts in the sums by row.

        Raises
        ------
        NonFiniteError
            A coordinate of a held atom is NaN or infinite.
        """
        lattice, limit = self.cell_of(dimensions)
        into.n_summed += summed
        if len(self.length_rows):
            sums, squares, worst, row = 0.0, 0.0, -1.0, -1
            if self._triangle_rows.size:
                sums, squares, worst, side, triangle = triangles(
                    x,
                    self._corners,
                    self._triangle_targets,
                    limit,
                    lattice,
                    self.grid,
                    self._triangle_largest,
                    self._triangle_total,
                    summed,
                )
                row = self._triangle_rows[side, triangle]
            if len(self._single_rows):
                more, more_squares, largest, k_worst = lengths(
                    x, self._places, self._targets, limit, lattice, self.grid, self._largest, self._total, summed
                )
                sums, squares = sums + more, squares + more_squares
                if largest > worst:
                    worst, row = largest, self._single_rows[min(k_worst, len(self._single_rows) - 1)]
            if not squares < np.inf:
                self.refuse(x)
            into.sums[0, k], into.squares[0, k] = sums, squares
            into.worst[0, k], into.worst_row[0, k] = worst, row
            if v is not None:
                if self._all_places is None:
                    self._all_places, _ = padded(self._pairs, 0.0)
                n = len(self.length_rows)
                squares, worst, row = length_rates(x, v, self._all_places, n, limit, lattice, self.grid)
                into.rate_squares[0, k] = squares
                into.rate_worst[0, k], into.rate_row[0, k] = worst, self.length_rows[row]
        if self._others is not None:
            self._look_at_others(into, k, x, v, lattice if limit < np.inf else None, time, summed)

    def look_at_block(
        self,
        into: Deviations,
        k: int,
        block: Block,
        points: NDArray[np.float32],
        every: tuple[int, int],
    ) -> tuple[int, float]:
        """Put what is found in the frames of a block into the k-th place and those that follow; lengths only.

        Parameters
        ----------
        points : ndarray of float32, shape (n_atoms, 3)
            Room for a frame; on return the last one that was looked at.
        every : (int, int)
            One frame in how many counts in the sums by row, and in the largest coordinate.

        Returns
        -------
        Frames until the first that is not finite, and the largest coordinate.
        """
        n = len(block.words)
        lattices, limits = np.empty((n, 2, 3, 3)), np.empty(n)
        alike = bool((block.dimensions == block.dimensions[0]).all())
        for f in range(1 if alike else n):
            lattices[f], limits[f] = self.cell_of(block.dimensions[f])
        if alike:
            lattices[1:], limits[1:] = lattices[0], limits[0]
        here = slice(k, k + n)
        side, place = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        done, reach, n_summed = look_at(
            block.words,
            block.x,
            points,
            k,
            *every,
            into.n_frames,
            limits,
            lattices,
            self.grid,
            self._corners,
            self._triangle_targets,
            self._triangle_largest,
            self._triangle_total,
            self._places,
            self._targets,
            self._largest,
            self._total,
            into.sums[0, here],
            into.squares[0, here],
            into.worst[0, here],
            side,
            place,
        )
        into.n_summed += n_summed
        rows = np.where(
            side < 0, self._row_of(self._single_rows, place), self._row_of(self._triangle_rows, place, side)
        )
        into.worst_row[0, here] = rows
        return done, reach

    @staticmethod
    def _row_of(rows: IntArray, place: IntArray, side: IntArray | None = None) -> IntArray:
        """Numbers of rows; where they are not of this kind, any."""
        n = rows.shape[-1]
        if not n:
            return np.full(len(place), -1, dtype=np.int64)
        at = np.minimum(place, n - 1)
        result: IntArray = rows[at] if side is None else rows[np.maximum(side, 0), at]
        return result

    def collect(self, into: Deviations) -> None:
        """Put what was found by row where it belongs, and begin anew."""
        n = len(self._single_rows)
        into.largest[self._single_rows], into.total[self._single_rows] = self._largest[:n], self._total[:n]
        into.largest[self._triangle_rows], into.total[self._triangle_rows] = (
            self._triangle_largest,
            self._triangle_total,
        )
        for array in (self._largest, self._total, self._triangle_largest, self._triangle_total):
            array[...] = 0.0

    def _look_at_others(
        self,
        into: Deviations,
        k: int,
        x: NDArray[np.float32],
        v: NDArray[np.float32] | None,
        lattice: FloatArray | None,
        time: float,
        summed: bool,
    ) -> None:
        others = cast(ConstraintSet, self._others)
        others.lattice = lattice
        here = coordinate_grid(x.reshape(-1, 3)[self._other_atoms], self.grid)
        with np.errstate(all="ignore"):
            off = others.value(here, time)
        if not np.isfinite(off).all():
            self.refuse(x)
        size = np.abs(off)
        into.largest[self.other_rows] = np.maximum(into.largest[self.other_rows], size)
        if summed:
            into.total[self.other_rows] += off
        for unit in range(len(UNITS)):
            mine = self._other_units == unit
            if mine.any():
                into.sums[unit, k] += off[mine].sum()
                into.squares[unit, k] += off[mine] @ off[mine]
                best = int(np.argmax(np.where(mine, size, -1.0)))
                if into.worst_row[unit, k] < 0 or size[best] > into.worst[unit, k]:
                    into.worst[unit, k], into.worst_row[unit, k] = size[best], self.other_rows[best]
        if v is None:
            return
        speeds = v.reshape(-1, 3)[self._other_atoms].astype(np.float64)
        rates = np.abs(others.jacobian(here, time) @ speeds.ravel() - others.velocity_target(here, time))
        for unit in range(len(UNITS)):
            mine = self._other_units == unit
            if mine.any():
                best = int(np.argmax(np.where(mine, rates, -1.0)))
                before = into.rate_squares[unit, k]
                into.rate_squares[unit, k] = (0.0 if np.isnan(before) else before) + rates[mine] @ rates[mine]
                if not into.rate_worst[unit, k] >= rates[best]:
                    into.rate_worst[unit, k], into.rate_row[unit, k] = rates[best], self.other_rows[best]

    def refuse(self, x: NDArray[np.float32]) -> None:
        """Say which atom of a frame makes it undefined."""
        points = x.reshape(-1, 3)
        bad = self.set.touched[~np.isfinite(points[self.set.touched]).all(axis=1)]
        if len(bad):
            raise NonFiniteError(f"position of atom {bad[0]} is {points[bad[0]]}", item="position", atom=int(bad[0]))
        raise NonFiniteError("a row is undefined: atoms coincide or are collinear", item="position")


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


def cell_matrix(dimensions: Any) -> FloatArray | None:
    """Cell vectors as rows, from lengths and angles; None without a cell."""
    if dimensions is None or not np.all(np.asarray(dimensions)[:3] > 0):
        return None
    a, b, c, alpha, beta, gamma = (float(value) for value in dimensions)
    # Exactly 90 degrees has no rounding.
    cosines = [0.0 if angle == 90.0 else float(np.cos(np.radians(angle))) for angle in (alpha, beta, gamma)]
    sine = 1.0 if gamma == 90.0 else float(np.sin(np.radians(gamma)))
    x, y = c * cosines[1], c * (cosines[0] - cosines[1] * cosines[2]) / sine
    rest = c * c - x * x - y * y
    if not (rest > 0 and sine > 0):
        return None
    return np.array([[a, 0.0, 0.0], [b * cosines[2], b * sine, 0.0], [x, y, np.sqrt(rest)]])
