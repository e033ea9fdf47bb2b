"""What was found in some frames of a trajectory, by row and by frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray

#: Natural units of rows, in this order.
UNITS = ("Å", "rad")


@dataclass
class Deviations:
    """What was found in some frames: by row, and by unit (see `UNITS`) in each frame.

    A row in a frame counts unless rounding of its coordinates in the file makes more of it than its size, and more
    than it may be off by anyway: nothing can be told of it there.

    Attributes
    ----------
    margins, largest : ndarray, shape (n_rows,)
        The largest excess over what was allowed, negative where there was none, and the absolute deviation in the
        same frame.
    total, rounded, counted : ndarray, shape (n_rows,)
        Over the frames that were summed: sums of the deviations and of what rounding makes of them at most, and the
        number of frames.
    sums, squares, worst, excess, rounding, seen : ndarray, shape (n_units, n_frames)
        In each frame: sum, sum of squares and largest absolute deviation; the largest excess over what was allowed;
        the largest rounding; how many rows counted.
    worst_row : ndarray of int, shape (n_units, n_frames)
        The row with the largest excess.
    rate_worst, rate_row, rate_squares : ndarray, shape (n_units, n_frames)
        Largest absolute A v, its row, and the sum of squares; NaN without velocities.
    without_cell : ndarray of bool, shape (n_frames,)
        Frames that have no cell.
    """

    n_rows: int
    n_frames: int
    margins: FloatArray = field(init=False)
    largest: FloatArray = field(init=False)
    by_row: FloatArray = field(init=False)
    by_frame: FloatArray = field(init=False)
    worst_row: IntArray = field(init=False)
    rate_worst: FloatArray = field(init=False)
    rate_row: IntArray = field(init=False)
    rate_squares: FloatArray = field(init=False)
    without_cell: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        self.margins, self.largest = np.full(self.n_rows, -np.inf), np.zeros(self.n_rows)
        self.by_row = np.zeros((3, self.n_rows))
        shape = (len(UNITS), self.n_frames)
        self.by_frame = np.zeros((len(UNITS), 6, self.n_frames))
        self.by_frame[:, 3] = -np.inf
        self.rate_worst, self.rate_squares = np.full(shape, np.nan), np.full(shape, np.nan)
        self.worst_row, self.rate_row = np.full(shape, -1, np.int64), np.full(shape, -1, np.int64)
        self.without_cell = np.zeros(self.n_frames, dtype=bool)

    total = property(lambda self: self.by_row[0])
    rounded = property(lambda self: self.by_row[1])
    counted = property(lambda self: self.by_row[2])
    sums = property(lambda self: self.by_frame[:, 0])
    squares = property(lambda self: self.by_frame[:, 1])
    worst = property(lambda self: self.by_frame[:, 2])
    excess = property(lambda self: self.by_frame[:, 3])
    rounding = property(lambda self: self.by_frame[:, 4])
    seen = property(lambda self: self.by_frame[:, 5])

    def mean(self, sums: FloatArray) -> FloatArray:
        """Means by row of `total` or `rounded`; 0 where no frame counted."""
        result: FloatArray = sums / np.maximum(self.counted, 1)
        return result

    def cut(self, n_frames: int) -> None:
        """Leave out what was not reached."""
        self.n_frames = n_frames
        for name in _OF_FRAMES:
            setattr(self, name, getattr(self, name)[..., :n_frames])

    def with_next(self, other: Deviations) -> Deviations:
        """Both, one after the other."""
        both = Deviations(self.n_rows, 0)
        both.n_frames = self.n_frames + other.n_frames
        both.largest = np.where(other.margins > self.margins, other.largest, self.largest)
        both.margins = np.maximum(self.margins, other.margins)
        both.by_row = self.by_row + other.by_row
        for name in _OF_FRAMES:
            setattr(both, name, np.concatenate([getattr(self, name), getattr(other, name)], axis=-1))
        return both


#: Arrays of `Deviations` by frame.
_OF_FRAMES = ("by_frame", "worst_row", "rate_worst", "rate_row", "rate_squares", "without_cell")
