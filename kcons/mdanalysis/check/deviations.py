"""Deviations of all rows in one frame after another, and what rounding of the coordinates makes of them.

One compiled function looks at a frame: lengths it finds itself, with nearest images; what other rows are off by comes
from their constraint objects. Coordinates are in single precision, statistics in double.

What rounding makes of a length is told for each row by its own two atoms: the coordinates of an atom are off by at most
``base + factor 2^e``, where 2^e is the power of two below the largest of them, and the length by sqrt(3) times the sum
of both. A row in a frame counts unless that is more than its size, and more than it may be off by anyway: nothing can
be told of it there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from MDAnalysis.lib.mdamath import triclinic_vectors
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.arguments import ANGLE, LENGTH
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import NonFiniteError
from kcons.mdanalysis.check.endings import Break
from kcons.mdanalysis.check.precision import FilePrecision
from kcons.mdanalysis.topology import NARROWEST
from kcons.solvers.kernels.lattices import NO_LATTICE, TRICLINIC, lattice_numbers, minimum_image

#: Natural units of rows, in this order.
UNITS = ("Å", "rad", "own units")
#: What second order adds to the error of rows other than distances, at most.
SECOND_ORDER = 1.1
_ROOT_THREE = np.sqrt(3.0)
#: Bits of the exponent of a single, which are the power of two below it; all of them are set where it is no number.
_EXPONENT = np.int32(0x7F800000)

#: What is held: atoms of a length (-1 of other rows), target, what the row may be off by besides rounding, and the
#: rounding up to which a frame counts: that or its size.
_HELD = np.dtype([("i", "i4"), ("j", "u4"), ("target", "f8"), ("slack", "f8"), ("most", "f8")])
#: Over all frames, by row: the largest excess over what was allowed (negative where there was none), the absolute
#: deviation in that frame and its number; sums of deviations, of what rounding makes of them, and of frames that count.
_BY_ROW = np.dtype(
    [(name, "f8") for name in ("margin", "largest", "total", "rounded")] + [("counted", "i4"), ("frame", "i4")]
)
#: By frame and unit: of deviations; the largest excess and the largest rounding; rows that count; of A v.
_BY_UNIT = np.dtype(
    [(name, "f8") for name in ("sum", "squares", "largest", "excess", "rounding", "seen", "rate_squares", "rate")]
)
#: By frame: its number and time, twice the kinetic energy, momentum, and whether it has no cell.
_BY_FRAME = np.dtype([("frame", "i8"), ("time", "f8"), ("kinetic", "f8"), ("momentum", "f8", 3), ("bare", "?")])


@dataclass
class Found:
    """What was found in some frames. Kinetic energies and rates are NaN without velocities."""

    #: By row, shape (n_rows,); by frame and unit, (n_frames, 2); by frame, (n_frames,).
    rows: NDArray[np.void]
    units: NDArray[np.void]
    frames: NDArray[np.void]
    #: Why there are no more frames.
    broken: Break | None = None

    @classmethod
    def nothing(cls, n_rows: int, numbers: IntArray) -> Found:
        """Of frames that were not looked at yet."""
        n = len(numbers)
        found = cls(np.zeros(n_rows, _BY_ROW), np.zeros((n, len(UNITS)), _BY_UNIT), np.zeros(n, _BY_FRAME))
        found.rows["margin"] = found.units["excess"] = -np.inf
        found.units["rate_squares"] = found.units["rate"] = found.frames["kinetic"] = np.nan
        found.frames["frame"] = numbers
        return found

    @classmethod
    def joined(cls, parts: Sequence[Found]) -> Found:
        """Parts in order, up to the first break."""
        end = next((k for k, part in enumerate(parts) if part.broken is not None), len(parts) - 1)
        parts = parts[: end + 1]
        rows = parts[0].rows.copy()
        for part in parts[1:]:
            larger = part.rows["margin"] > rows["margin"]
            for name in ("margin", "largest", "frame"):
                rows[name] = np.where(larger, part.rows[name], rows[name])
            for name in ("total", "rounded", "counted"):
                rows[name] += part.rows[name]
        units, frames = (np.concatenate([getattr(part, name) for part in parts]) for name in ("units", "frames"))
        return cls(rows, units, frames, parts[-1].broken)

    def mean(self, name: str) -> FloatArray:
        """Means by row of 'total' or 'rounded'; 0 where no frame counted."""
        result: FloatArray = self.rows[name] / np.maximum(self.rows["counted"], 1)
        return result

    @property
    def rms(self) -> FloatArray:
        """Root mean square over the rows, shape (n_frames, 2)."""
        result: FloatArray = np.sqrt(self.units["squares"] / np.maximum(self.units["seen"], 1))
        return result


class RowTable:
    """Rows with the targets they are checked against, at the first frame that is looked at.

    Targets left out are taken from this frame. `target_error` is the rounding of those that are given, by atom, in
    angstrom a coordinate; the tolerance is in parts of the size of a row.
    """

    def __init__(
        self,
        given: Sequence[Constraint],
        masses: FloatArray,
        ts: Any,
        precision: FilePrecision,
        target_error: FloatArray,
        tolerance: float,
    ) -> None:
        time, self.tolerance = float(ts.time), tolerance
        self._dimensions, self._cell = b"", (NO_LATTICE, np.inf)
        lattice, limit = self._cell_of(ts.dimensions)
        x = precision.stored(ts.positions)
        self.set = held = ConstraintSet(given, x, masses, cell=lattice[0] if limit < np.inf else None, time=time)
        #: By row: whether its target is that of this frame, or of the mean of all; which of `UNITS` it has; what a
        #: tolerance is a part of: the length held, 1 rad.
        self.measured = _by_row(given, [item.target is None for item in given])
        angular = _by_row(given, [item.period is not None for item in given])
        angles = [item.period is not None or item.held is ANGLE for item in given]
        others = [2 * (item.held is not LENGTH) for item in given]
        self.units = _by_row(given, np.where(angles, 1, others).tolist())
        self.sizes = np.where(angular, 1.0, held.scale)
        # Compiled code takes nearest images; whole rows may be longer than half the cell, and are for the set.
        plain = [
            np.full(item.n_rows, item.holds_length and not item.moving)
            & ~(np.zeros(item.n_rows, dtype=bool) if item.whole is None else item.whole)
            for item in held.constraints
        ]
        self._lengths: NDArray[np.bool_] = np.concatenate(plain)
        self._table = table = np.zeros(held.n_rows, _HELD)
        table["i"] = -1
        for item, first, mine in zip(held.constraints, held.starts, plain, strict=False):
            if mine.any():
                rows = first + np.flatnonzero(mine)
                table["i"][rows], table["j"][rows] = item.atoms[mine].T
                table["target"][rows] = item.target_at(0.0)[mine]
        self._rows = np.flatnonzero(~self._lengths)
        self.others: ConstraintSet | None = None
        if len(self._rows):
            self.others, self._atoms = held.subset(self._rows)
        self._is_held = np.zeros(held.n_atoms, dtype=np.int32)  # 0 where no row has the atom
        self._is_held[held.touched] = _EXPONENT
        # Runs of rows of one unit.
        starts = np.append(0, np.flatnonzero(np.diff(self.units)) + 1)
        self._runs = np.stack([starts, np.append(starts[1:], held.n_rows), self.units[starts]], axis=1)
        self._given = np.zeros((held.n_rows if len(self._rows) else 0, 3))
        #: What was added to the targets.
        self.means = np.zeros(held.n_rows)
        with np.errstate(all="ignore"):
            slopes = abs(held.jacobian(x, time))
            reach, squares = (np.asarray(part.sum(axis=1)).ravel() for part in (slopes, slopes.power(2)))
        # An error of 1 of each coordinate: the error of a row, at most and in the mean square.
        at_most = np.where(self._lengths, 2 * _ROOT_THREE, SECOND_ORDER * reach)
        #: Standard deviation of what rounding of one frame makes of a row, in parts of what it makes at most.
        self.spread: FloatArray = np.sqrt(squares / 3.0) / np.maximum(at_most, np.finfo(float).tiny)
        found, told = (self._made_of(errors, slopes) for errors in (precision.half_step(x), target_error))
        self._allow(np.where(self.measured, found, told))

    @property
    def n_rows(self) -> int:
        return len(self._table)

    def __getstate__(self) -> dict[str, Any]:
        """What `look` needs, in other processes: to copy all of it takes longer than to look at some frames."""
        kept = {"_dimensions", "_cell", "_table", "_given", "_runs", "_is_held", "others", "_rows"}
        kept |= {"_atoms", "means"} if self.others is not None else set()
        return {name: value for name, value in vars(self).items() if name in kept}

    def _made_of(self, errors: FloatArray, slopes: Any) -> FloatArray:
        """What errors of coordinates make of each row, at most; rows of velocities have no position to be off."""
        result: FloatArray = SECOND_ORDER * (slopes @ np.repeat(errors, 3))
        lengths = self._table[self._lengths]
        result[self._lengths] = _ROOT_THREE * (errors[lengths["i"]] + errors[lengths["j"]])
        return np.where(self.set.holonomic, result, 0.0)

    def _allow(self, of_targets: FloatArray) -> None:
        #: What rounding makes of the targets, at most; the tolerance and the rounding of frames come besides.
        self.of_targets = of_targets
        self._table["slack"] = of_targets + self.tolerance * self.sizes
        self._table["most"] = np.maximum(self._table["slack"], self.sizes)

    def take_means(self, found: Found) -> None:
        """Take the means that a first pass found as targets."""
        self.means = np.where(self.measured & self.set.holonomic, found.mean("total"), 0.0)
        self._table["target"] += np.where(self._lengths, self.means, 0.0)
        seen = self.measured & (found.rows["counted"] > 0)
        self._allow(np.where(seen, found.mean("rounded"), self.of_targets))

    def _cell_of(self, dimensions: NDArray[np.float32] | None) -> tuple[FloatArray, float]:
        """Cell with its inverse, shape (2, 3, 3), and the square of half its smallest width, infinite without one."""
        if dimensions is None:
            return NO_LATTICE, np.inf
        if not np.isfinite(dimensions).all():
            raise NonFiniteError(f"the cell is ({', '.join(f'{value:g}' for value in dimensions)})", item="cell")
        if dimensions.tobytes() != self._dimensions:
            self._dimensions, self._cell = dimensions.tobytes(), (NO_LATTICE, np.inf)
            matrix = triclinic_vectors(dimensions, dtype=np.float64)
            # Files without a cell have lengths of 1; of angles that cannot be there are no vectors.
            if (dimensions[:3] > NARROWEST).all() and matrix.any():
                inverse = np.linalg.inv(matrix)
                half = 0.5 / float(np.linalg.norm(inverse, axis=0).max())
                self._cell = np.stack([matrix, inverse]), half * half
        return self._cell

    def look(self, found: Found, k: int, ts: Any, precision: FilePrecision, masses: FloatArray | None, v: Any) -> None:
        """Put what is found in one frame, which must be finite, into the k-th place; with velocities rates, too."""
        frame = found.frames[k]
        frame["time"] = time = float(ts.time)
        lattice, limit = self._cell_of(ts.dimensions)
        frame["bare"] = limit == np.inf
        planes = np.ascontiguousarray(ts.positions.T, dtype=np.float32)
        speeds = np.zeros((0, 3)) if v is None else np.asarray(v, dtype=np.float64)
        if not np.isfinite(speeds).all():
            atom = int(np.argmin(np.isfinite(speeds).all(axis=1)))
            raise NonFiniteError(f"velocity of atom {atom} is {v[atom]}", item="velocity", atom=atom)
        if v is not None and masses is not None:
            frame["kinetic"], frame["momentum"] = masses @ (speeds * speeds).sum(axis=1), masses @ speeds
        if self.others is not None:
            self._look_at_others(planes.T, speeds, lattice if limit < np.inf else None, precision, time)
        bad = _look(
            (planes, planes.view(np.int32), self._is_held, speeds),
            (lattice, limit, precision.grid, *precision.coefficients),
            (self._table, self._given, self._runs),
            found.rows,
            found.units[k],
            found.frames["frame"][k],
        )
        if bad >= 0:
            raise NonFiniteError(f"position of atom {bad} is {planes[:, bad]}", item="position", atom=bad)

    def _look_at_others(
        self, x: NDArray[np.float32], v: FloatArray, lattice: FloatArray | None, precision: FilePrecision, time: float
    ) -> None:
        """Put deviation, rounding and rate of the rows that are no lengths where compiled code finds them."""
        others, rows, atoms = self.others, self._rows, self._atoms
        assert others is not None
        others.lattice = lattice
        here = precision.stored(x[atoms])
        with np.errstate(all="ignore"):
            off = others.value(here, time) - self.means[rows]
            slopes = others.jacobian(here, time)
            rounding = SECOND_ORDER * (abs(slopes) @ np.repeat(precision.half_step(here), 3))
            if len(v):
                self._given[rows, 2] = np.abs(slopes @ v[atoms].ravel() - others.velocity_target(here, time))
        # Where atoms coincide, an angle is no number, nor is its rounding.
        self._given[rows, 0] = off
        self._given[rows, 1] = np.where(np.isfinite(off + rounding), np.where(others.holonomic, rounding, 0), np.inf)


def _by_row(constraints: Sequence[Constraint], values: Sequence[Any]) -> Any:
    """One value a constraint, for each of its rows."""
    return np.repeat(np.array(values), [item.n_rows for item in constraints])


@njit(cache=True, nogil=True)
def _look(atoms, space, held, by_row, by_unit, frame):  # type: ignore[no-untyped-def]
    """Put deviations of all rows in one frame into `by_row` and `by_unit`; the first held atom of no number, or -1.

    `atoms`: positions, shape (3, n_atoms), and their bits; which are held; velocities, shape (n_atoms, 3) or (0, 3).
    `space`: the cell and its inverse, and the square of half its smallest width, below which vectors are their own
    nearest images; the grid of coordinates in the file, or 0; the coefficients of `FilePrecision`. `held`: `_HELD`;
    deviation, rounding and rate of rows that are no lengths; first row, end and unit of runs.
    """
    x, bits, is_held, v = atoms
    lattice, limit, step, base, factor, reach = space
    cell = lattice_numbers(lattice)
    table, given, runs = held
    powers = np.empty(len(is_held), dtype=np.float32)
    exponents, least, worst = powers.view(np.int32), np.float32(reach).view(np.int32), np.int32(0)
    for a in range(len(powers)):
        exponent = max(max(bits[0, a] & _EXPONENT, bits[1, a] & _EXPONENT), bits[2, a] & _EXPONENT)
        worst = max(worst, exponent & is_held[a])
        exponents[a] = exponent if exponent >= least else 0
    if worst == _EXPONENT:
        return np.argmax((is_held != 0) & (exponents == _EXPONENT))
    # As the file holds them.
    points = np.empty(x.shape)
    numbers, stored, inverse = x.reshape(-1), points.reshape(-1), 1.0 / step if step > 0.0 else 0.0
    for k in range(len(numbers)):
        exact = np.float64(numbers[k])
        stored[k] = np.rint(exact * inverse) * step if step > 0.0 else exact
    for run in range(len(runs)):
        first, end, unit = runs[run]
        total, squares, largest, excess, coarsest, seen, rates, fastest = 0.0, 0.0, 0.0, -np.inf, 0.0, 0, 0.0, 0.0
        for r in range(first, end):
            row, rate = table[r], 0.0
            i, j = row.i, row.j
            if i >= 0:
                dx, dy, dz = points[0, i] - points[0, j], points[1, i] - points[1, j], points[2, i] - points[2, j]
                square = dx * dx + dy * dy + dz * dz
                if not square < limit:
                    dx, dy, dz = minimum_image(dx, dy, dz, cell, TRICLINIC)
                    square = dx * dx + dy * dy + dz * dz
                off = np.sqrt(square) - row.target
                rounding = _ROOT_THREE * (2.0 * base + factor * (powers[i] + powers[j]))
                if len(v) and square > 0.0:
                    along = dx * (v[i, 0] - v[j, 0]) + dy * (v[i, 1] - v[j, 1]) + dz * (v[i, 2] - v[j, 2])
                    rate = abs(along) / np.sqrt(square)
            else:
                off, rounding, rate = given[r, 0], given[r, 1], given[r, 2]
            if rounding > row.most:
                continue
            size = abs(off)
            margin = size - rounding - row.slack
            total += off
            squares += off * off
            rates += rate * rate
            seen += 1
            # Not max(), which costs more where a number may be none.
            if size > largest:
                largest = size
            if rounding > coarsest:
                coarsest = rounding
            if margin > excess:
                excess = margin
            if rate > fastest:
                fastest = rate
            mine = by_row[r]
            if margin > mine.margin:
                mine.margin, mine.largest, mine.frame = margin, size, frame
            mine.total += off
            mine.rounded += rounding
            mine.counted += 1
        all_rows = by_unit[unit]
        all_rows.sum += total
        all_rows.squares += squares
        all_rows.largest = max(all_rows.largest, largest)
        all_rows.excess = max(all_rows.excess, excess)
        all_rows.rounding = max(all_rows.rounding, coarsest)
        all_rows.seen += seen
        if len(v):
            before = all_rows.rate_squares
            all_rows.rate_squares = rates if np.isnan(before) else before + rates
            all_rows.rate = max(fastest, 0.0 if np.isnan(before) else all_rows.rate)
    return -1
