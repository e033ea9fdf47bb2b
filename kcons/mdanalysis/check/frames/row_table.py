"""All rows of a set in one frame after another: compiled for lengths, by the constraint objects for the rest."""

from __future__ import annotations

import copy
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import NonFiniteError
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import Block
from kcons.mdanalysis.check.frames.deviations import UNITS, Deviations
from kcons.mdanalysis.check.frames.frame_kernels import coordinate_grid, farthest
from kcons.mdanalysis.check.frames.length_table import LengthTable, size_of
from kcons.mdanalysis.topology import NARROWEST
from kcons.solvers.kernels.nearest_image import NO_LATTICE

#: What second order adds to the error of rows other than distances, at most.
SECOND_ORDER = 1.1


def unit_of(item: Constraint) -> int:
    """Which of `UNITS` the coordinate of a constraint has; coordinates of one's own count as lengths."""
    return int(item.family in ("Angle", "Dihedral") or item.period is not None)


class RowTable:
    """Rows of a set, laid out for reading many frames.

    Parameters
    ----------
    constraint_set : ConstraintSet
        In angstrom, with all targets.
    precision : FilePrecision
        Of the coordinates in the file; may be changed from frame to frame.
    """

    def __init__(self, constraint_set: ConstraintSet, precision: FilePrecision) -> None:
        self.set = constraint_set
        self.precision = precision
        self._dimensions: tuple[float, ...] = ()
        self._box = np.zeros((2, 3, 3))
        self._cell: tuple[FloatArray, float] = NO_LATTICE, np.inf
        self.units: IntArray = np.concatenate(
            [np.full(c.n_rows, unit_of(c), dtype=np.int64) for c in constraint_set.constraints] or [np.zeros(0, int)]
        )
        periodic = np.concatenate([np.full(c.n_rows, c.period is not None) for c in constraint_set.constraints])
        #: What a tolerance is a part of: the length held; 1 rad.
        self.sizes: FloatArray = np.where(periodic, 1.0, constraint_set.scale)
        none = np.zeros(0, dtype=np.int64)
        pairs, held, length_rows, other_rows = [np.zeros((0, 2), np.int64)], [np.zeros(0)], [none], [none]
        for item, first, end in zip(
            constraint_set.constraints, constraint_set.starts[:-1], constraint_set.starts[1:], strict=True
        ):
            if item.family == "Distance" and not item.moving:
                # Compiled code takes nearest images; whole rows may be longer than half the cell, and are for the set.
                plain = np.ones(item.n_rows, dtype=bool) if item.whole is None else ~item.whole
                numbers = np.arange(first, end)
                length_rows.append(numbers[plain])
                other_rows.append(numbers[~plain])
                pairs.append(item.atoms[plain])
                held.append(item.target_at(0.0)[plain])
            else:
                other_rows.append(np.arange(first, end))
        self.length_rows: IntArray = np.concatenate(length_rows)
        self.other_rows: IntArray = np.concatenate(other_rows)
        self._pairs = np.concatenate(pairs)
        self._lengths = LengthTable(self.length_rows, self._pairs, np.concatenate(held), constraint_set.n_atoms)
        self._others: ConstraintSet | None = None
        if len(self.other_rows):
            self._others, self._other_atoms = constraint_set.subset(self.other_rows)
            self._other_units = self.units[self.other_rows]
        self.allow(np.zeros(constraint_set.n_rows))

    def allow(self, slack: FloatArray) -> None:
        """Say what each row may be off by, besides the rounding of its coordinates; shape (n_rows,)."""
        self._slack = slack
        self._lengths.allow(slack)

    @property
    def only_lengths(self) -> bool:
        """Whether compiled loops evaluate all rows, so that whole blocks of a file can be read at once."""
        return self._others is None

    def fresh(self) -> RowTable:
        """A copy for one worker: it shares the rows and has statistics and a cell of its own."""
        other = copy.copy(self)
        other._box, other._dimensions = np.zeros((2, 3, 3)), ()
        other._lengths = self._lengths.fresh()
        return other

    def errors_of(
        self, errors: FloatArray, positions: FloatArray, dimensions: NDArray[np.float32] | None, time: float
    ) -> FloatArray:
        """What errors of the coordinates of one frame make of each row, at most, shape (n_rows,).

        Parameters
        ----------
        errors : ndarray, shape (n_atoms,)
            Of each coordinate of an atom, at most, in angstrom; see `FilePrecision.half_step`.
        positions : ndarray, shape (n_atoms, 3)
            In angstrom.
        dimensions : ndarray or None
            Lengths and angles of the cell.
        time : float
        """
        result = np.zeros(self.set.n_rows)
        i, j = self._pairs.T
        result[self.length_rows] = np.sqrt(3.0) * (errors[i] + errors[j])
        if self._others is not None:
            lattice, limit = self.cell_of(dimensions)
            self._others.lattice = lattice if limit < np.inf else None
            atoms = self._other_atoms
            with np.errstate(all="ignore"):
                slopes = self._others.jacobian(positions[atoms], time)
            result[self.other_rows] = self._rounding_of_others(slopes, errors[atoms])
        return result

    def _rounding_of_others(self, slopes: Any, errors: FloatArray) -> FloatArray:
        """First order, and some more; rows that hold velocities only have no position to be off."""
        others = cast(ConstraintSet, self._others)
        result: FloatArray = np.where(others.holonomic, SECOND_ORDER * (abs(slopes) @ np.repeat(errors, 3)), 0.0)
        return result

    # -- cell -----------------------------------------------------------------------------------

    def cell_of(self, dimensions: NDArray[np.float32] | None) -> tuple[FloatArray, float]:
        """Cell with its inverse, shape (2, 3, 3), and the square of half its smallest width; NaN where the cell is."""
        if dimensions is None:
            return NO_LATTICE, np.inf
        values = tuple(dimensions.tolist())
        if not np.isfinite(dimensions).all():
            return NO_LATTICE, np.nan
        if values != self._dimensions:
            self._dimensions, self._cell = values, self._new_cell(values)
        return self._cell

    def _new_cell(self, values: tuple[float, ...]) -> tuple[FloatArray, float]:
        a, b, c, *angles = values
        shortest = min(a, b, c)
        if angles == [90.0, 90.0, 90.0] and shortest > NARROWEST:
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
            A coordinate of a held atom, a velocity or the cell is NaN or infinite.
        """
        lattice, limit = self.cell_of(dimensions)
        if np.isnan(limit):
            self.refuse(x, dimensions)
        into.without_cell[k] = limit == np.inf
        if v is not None and not np.isfinite(size_of(farthest(v))):
            atom = int(np.argmin(np.isfinite(v.reshape(-1, 3)).all(axis=1)))
            raise NonFiniteError(f"velocity of atom {atom} is {v.reshape(-1, 3)[atom]}", item="velocity", atom=atom)
        if len(self.length_rows):
            if not self._lengths.look(into, k, x, (lattice, limit), self.precision, summed):
                self.refuse(x)
            if v is not None:
                self._lengths.look_at_rates(into, k, x, v, (lattice, limit), self.precision.grid)
        if self._others is not None:
            self._look_at_others(into, k, x, v, lattice if limit < np.inf else None, time, summed)

    def look_at_block(
        self,
        into: Deviations,
        k: int,
        block: Block,
        points: NDArray[np.float32],
        every: tuple[int, int],
    ) -> tuple[int, FloatArray]:
        """Put what is found in the frames of a block into the k-th place and those that follow; lengths only.

        Parameters
        ----------
        points : ndarray of float32, shape (n_atoms, 3)
            Room for a frame; on return the last one that was looked at.
        every : (int, int)
            One frame in how many counts in the sums by row, and has its largest coordinate looked up.

        Returns
        -------
        Frames until the first that is not finite, and the largest coordinates of frames, NaN where not looked up.
        """
        n = len(block.words)
        lattices, limits = np.empty((n, 2, 3, 3)), np.empty(n)
        alike = bool((block.dimensions == block.dimensions[0]).all())
        for f in range(1 if alike else n):
            lattices[f], limits[f] = self.cell_of(block.dimensions[f])
        if alike:
            lattices[1:], limits[1:] = lattices[0], limits[0]
        into.without_cell[k : k + n] = limits == np.inf
        coefficients = self.precision.coefficients(0.0)
        return self._lengths.look_at_block(into, k, block, points, every, (lattices, limits), coefficients)

    def collect(self, into: Deviations) -> None:
        """Put what was found by row where it belongs."""
        self._lengths.collect(into)

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
        others, rows = cast(ConstraintSet, self._others), self.other_rows
        others.lattice = lattice
        here = coordinate_grid(x.reshape(-1, 3)[self._other_atoms], self.precision.grid)
        with np.errstate(all="ignore"):
            off = others.value(here, time)
            if not np.isfinite(here).all():
                self.refuse(x)
            slopes = others.jacobian(here, time)
            rounding = self._rounding_of_others(slopes, self.precision.half_step(here))
        # Where atoms coincide, an angle is no number, nor is its rounding.
        clear = np.isfinite(off) & (rounding <= np.maximum(self.sizes[rows], self._slack[rows]))
        off, rounding = np.where(clear, off, 0.0), np.where(np.isfinite(rounding), rounding, np.inf)
        size, known = np.abs(off), np.where(clear, rounding, 0.0)
        margin = size - rounding - self._slack[rows]
        new = margin > into.margins[rows]
        into.margins[rows[new]], into.largest[rows[new]] = margin[new], size[new]
        if summed:
            into.by_row[:, rows] += off, known, clear
        for unit in range(len(UNITS)):
            mine = self._other_units == unit
            if mine.any():
                now = into.by_frame[unit, :, k]
                best = int(np.argmax(np.where(mine, margin, -np.inf)))
                if margin[best] > now[3]:
                    into.worst_row[unit, k] = rows[best]
                now[[0, 1, 5]] += off[mine].sum(), off[mine] @ off[mine], np.count_nonzero(clear & mine)
                now[2:5] = np.maximum(now[2:5], (size[mine].max(), margin[best], known[mine].max()))
        if v is None:
            return
        speeds = v.reshape(-1, 3)[self._other_atoms].astype(np.float64)
        with np.errstate(all="ignore"):
            rates = np.abs(slopes @ speeds.ravel() - others.velocity_target(here, time))
        rates = np.where(clear, rates, 0.0)
        for unit in range(len(UNITS)):
            mine = self._other_units == unit
            if mine.any():
                best = int(np.argmax(np.where(mine, rates, -1.0)))
                before = into.rate_squares[unit, k]
                into.rate_squares[unit, k] = (0.0 if np.isnan(before) else before) + rates[mine] @ rates[mine]
                if not into.rate_worst[unit, k] >= rates[best]:
                    into.rate_worst[unit, k], into.rate_row[unit, k] = rates[best], rows[best]

    def refuse(self, x: NDArray[np.float32], dimensions: NDArray[np.float32] | None = None) -> None:
        """Say what makes a frame undefined: its cell, or which atom.

        Raises
        ------
        NonFiniteError
        """
        if dimensions is not None and not np.isfinite(dimensions).all():
            shown = ", ".join(f"{value:g}" for value in dimensions)
            raise NonFiniteError(f"the cell is ({shown})", item="cell")
        points = x.reshape(-1, 3)
        bad = self.set.touched[~np.isfinite(points[self.set.touched]).all(axis=1)]
        if len(bad):
            raise NonFiniteError(f"position of atom {bad[0]} is {points[bad[0]]}", item="position", atom=int(bad[0]))
        raise NonFiniteError("a length is no number", item="position")


def cell_matrix(dimensions: Any) -> FloatArray | None:
    """Cell vectors as rows, from lengths and angles; None without a cell, or with what files have in place of one."""
    if dimensions is None or not np.all(np.asarray(dimensions)[:3] > NARROWEST):
        return None
    a, b, c, alpha, beta, gamma = (float(value) for value in dimensions)
    # Exactly 90 degrees has no rounding.
    cosines = [0.0 if angle == 90.0 else float(np.cos(np.radians(angle))) for angle in (alpha, beta, gamma)]
    sine = 1.0 if gamma == 90.0 else float(np.sin(np.radians(gamma)))
    if not sine > 0:
        return None
    x, y = c * cosines[1], c * (cosines[0] - cosines[1] * cosines[2]) / sine
    rest = c * c - x * x - y * y
    if not rest > 0:
        return None
    return np.array([[a, 0.0, 0.0], [b * cosines[2], b * sine, 0.0], [x, y, np.sqrt(rest)]])
