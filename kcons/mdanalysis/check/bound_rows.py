"""Rows with the targets they are checked against, and what rounding of coordinates makes of both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.findings import Part
from kcons.mdanalysis.check.frames.frame_kernels import coordinate_grid
from kcons.mdanalysis.check.frames.row_table import SECOND_ORDER, RowTable, cell_matrix


class BoundRows:
    """Rows at the first frame that is looked at.

    Parameters
    ----------
    given : sequence of Constraint
        Targets left out are taken from this frame.
    masses : ndarray, shape (n_atoms,)
    ts : Timestep
        The frame.
    time : float
        Its time.
    precision : FilePrecision
        Of its coordinates.
    target_error : ndarray, shape (n_atoms,)
        Rounding of the targets that are given, in angstrom a coordinate.
    tolerance : float
        In parts of the size of a row.

    Attributes
    ----------
    positions : ndarray, shape (n_atoms, 3)
        As the file holds them.
    measured : ndarray of bool, shape (n_rows,)
        Rows whose targets are those of this frame, or of the mean of all.
    table : RowTable
    of_targets : ndarray, shape (n_rows,)
        What rounding makes of the targets, at most.
    spread_of_rounding : ndarray, shape (n_rows,)
        Standard deviation of what rounding of one frame makes of a row, in parts of what it makes at most.
    """

    def __init__(
        self,
        given: Sequence[Constraint],
        masses: FloatArray,
        ts: Any,
        time: float,
        precision: FilePrecision,
        target_error: FloatArray,
        tolerance: float,
    ) -> None:
        self.tolerance = tolerance
        x = self.positions = coordinate_grid(ts.positions, precision.grid)
        self.measured: NDArray[np.bool_] = np.concatenate([np.full(c.n_rows, c.target is None) for c in given])
        held = ConstraintSet(given, x, masses, cell=cell_matrix(ts.dimensions), time=time)
        self.table = RowTable(held, precision)
        with np.errstate(all="ignore"):
            slopes = abs(held.jacobian(x, time))
            reach, squares = (np.asarray(part.sum(axis=1)).ravel() for part in (slopes, slopes.power(2)))
        is_length = np.concatenate([np.full(c.n_rows, c.family == "Distance") for c in held.constraints])
        # An error of 1 of each coordinate: the error of a row, at most and in the mean square.
        at_most = np.where(is_length, 2 * np.sqrt(3.0), SECOND_ORDER * reach)
        self.spread_of_rounding: FloatArray = np.sqrt(squares / 3.0) / np.maximum(at_most, np.finfo(float).tiny)
        found, told = (
            self.table.errors_of(errors, x, ts.dimensions, time) for errors in (precision.half_step(x), target_error)
        )
        self._allow(np.where(self.measured, found, told))

    def _allow(self, of_targets: FloatArray) -> None:
        """Say what rounding makes of the targets, at most; the tolerance and the rounding of frames come besides."""
        self.of_targets = of_targets
        self.table.allow(of_targets + self.tolerance * self.table.sizes)

    def hold_means(self, part: Part, first: Any) -> None:
        """Take the means that a first pass found as targets; `first` is the Timestep of a frame."""
        held, found = self.table.set, part.found
        means = found.mean(found.total)
        moved = [
            item if item.moving or not item.holonomic else item.with_target(item.target_at(0.0) + means[a:b])
            for item, a, b in zip(held.constraints, held.starts[:-1], held.starts[1:], strict=True)
        ]
        precision = self.table.precision
        positions = coordinate_grid(first.positions, precision.grid)
        self.table = RowTable(held.replaced(moved, positions, float(first.time)), precision)
        seen = self.measured & (found.counted > 0)
        self._allow(np.where(seen, found.mean(found.rounded), self.of_targets))
