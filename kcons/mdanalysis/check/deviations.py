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
from functools import lru_cache
from typing import Any, NamedTuple

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
from kcons.solvers.kernels.eight_wide import (
    FASTMATH,
    WIDTH,
    absolute,
    all_within,
    gather_ends,
    load,
    splat,
    square_root,
    store,
    where_greater,
)
from kcons.solvers.kernels.lattices import NO_LATTICE, TRICLINIC, lattice_numbers, minimum_image

#: Natural units of rows, in this order.
UNITS = ("Å", "rad", "own units")
#: What second order adds to the error of rows other than distances, at most.
SECOND_ORDER = 1.1
_ROOT_THREE = np.sqrt(3.0)
#: Bits of the exponent of a single, which are the power of two below it; all of them are set where it is no number.
_EXPONENT = np.int32(0x7F800000)
_NO_SPEEDS = np.zeros((0, 4))

#: Over all frames, by row: the largest excess over what was allowed (negative where there was none), the absolute
#: deviation in that frame and its number; sums of deviations, of what rounding makes of them, and of frames that count.
_BY_ROW = np.dtype([(name, "f8") for name in ("margin", "largest", "frame", "total", "rounded", "counted")])
#: By frame and unit: of deviations; rows that are off by more than allowed and rows that count; of A v; the largest
#: deviation and the largest rounding.
_BY_UNIT = np.dtype(
    [(name, "f8") for name in ("sum", "squares", "violated", "seen", "rate_squares", "rate", "largest", "rounding")]
)
#: By frame: number, time, twice the kinetic energy, and that of a turn of the whole, infinite in a cell; momentum.
_BY_FRAME = np.dtype([("frame", "i8"), ("time", "f8"), ("kinetic", "f8"), ("turning", "f8"), ("momentum", "f8", 3)])


@dataclass
class Found:
    """What was found in some frames. Kinetic energies and rates are NaN without velocities."""

    #: By row, shape (n_rows,); by frame and unit, (n_frames, 3); by frame, (n_frames,).
    rows: NDArray[np.void]
    units: NDArray[np.void]
    frames: NDArray[np.void]
    #: Why there are no more frames.
    broken: Break | None = None
    #: Frames that were looked at so far.
    looked: int = 0

    @classmethod
    def nothing(cls, numbers: IntArray) -> Found:
        """Of frames that were not looked at yet."""
        n = len(numbers)
        found = cls(np.zeros(0, _BY_ROW), np.zeros((n, len(UNITS)), _BY_UNIT), np.zeros(n, _BY_FRAME))
        found.units["rate_squares"] = found.units["rate"] = found.frames["kinetic"] = np.nan
        found.frames["frame"] = numbers
        return found

    @classmethod
    def joined(cls, parts: Sequence[Found]) -> Found:
        """Parts in order, up to the first break."""
        end = next((k for k, part in enumerate(parts) if part.broken is not None), len(parts) - 1)
        parts = parts[: end + 1]
        each = np.stack([part.rows for part in parts])
        rows = each[np.argmax(each["margin"], axis=0), np.arange(each.shape[1])]
        for name in ("total", "rounded", "counted"):
            rows[name] = each[name].sum(axis=0)
        units, frames = (np.concatenate([getattr(part, name) for part in parts]) for name in ("units", "frames"))
        return cls(rows, units, frames, parts[-1].broken)

    def mean(self, name: str) -> FloatArray:
        """Means by row of 'total' or 'rounded'; 0 where no frame counted."""
        return np.asarray(self.rows[name] / np.maximum(self.rows["counted"], 1))

    @property
    def rms(self) -> FloatArray:
        """Root mean square over the rows, shape (n_frames, 2)."""
        return np.asarray(np.sqrt(self.units["squares"] / np.maximum(self.units["seen"], 1)))


class Frames(NamedTuple):
    """Frames one after another; where there are rows that are no lengths, or velocities, a single one."""

    #: Of four bytes, by frame; the last 3 (n_atoms + 2) are x, y and z, with a word before and one behind each.
    words: NDArray[np.int32]
    #: Lengths and angles, as MDAnalysis has them.
    cells: Sequence[bytes]
    times: FloatArray
    velocities: Any = None


class RowTable:
    """Rows with the targets they are checked against, at the first frame that is looked at.

    Targets left out are taken from this frame. `target_error` is the rounding of those that are given, by atom, in
    angstrom a coordinate; the tolerance is in parts of the size of a row.
    """

    def __init__(
        self,
        given: Sequence[Constraint],
        masses: FloatArray | None,
        ts: Any,
        precision: FilePrecision,
        target_error: FloatArray,
        tolerance: float,
    ) -> None:
        time, self.tolerance, self._masses = float(ts.time), tolerance, masses
        lattice, limit = _cell_of(ts._unitcell.tobytes())
        x = precision.stored(ts.positions)
        masses, cell = np.ones(len(x)) if masses is None else masses, lattice[0] if limit < np.inf else None
        self.set = held = ConstraintSet(given, x, masses, cell=cell, time=time)
        #: By row: whether its target is that of this frame, or of the mean of all; which of `UNITS` it has; what a
        #: tolerance is a part of: the length held, 1 rad.
        self.measured = _by_row(given, [item.target is None for item in given])
        angular = [item.period is not None for item in given]
        others = [1 if item.held is ANGLE else 2 * (item.held is not LENGTH) for item in given]
        self.units = _by_row(given, np.where(angular, 1, others).tolist())
        self.sizes = np.where(_by_row(given, angular), 1.0, held.scale)
        # Compiled code takes nearest images; whole rows may be longer than half the cell, and are for the set.
        plain = [
            np.full(item.n_rows, item.holds_length and not item.moving)
            & ~(np.zeros(item.n_rows, dtype=bool) if item.whole is None else item.whole)
            for item in held.constraints
        ]
        self._lengths: NDArray[np.bool_] = np.concatenate(plain)
        # It has lengths, which are all of the first unit, before other rows by their units, in runs of whole vectors.
        kinds, runs, end = np.where(self._lengths, 0, 1 + self.units), [], 0
        self._places = np.empty(held.n_rows, dtype=np.int64)
        for kind in np.unique(kinds).tolist():
            rows = np.flatnonzero(kinds == kind)
            begin, end = end, end - (-len(rows) // WIDTH) * WIDTH
            self._places[rows] = begin + np.arange(len(rows))
            runs.append((begin, end, max(kind - 1, 0), kind == 0))
        self._runs, self._n_places = np.array(runs), end
        # Atoms of lengths, and the targets; 0 of other rows.
        self._pairs, targets = np.zeros((2, held.n_rows), dtype=np.int64), np.zeros(held.n_rows)
        for item, first, mine in zip(held.constraints, held.starts, plain, strict=False):
            if mine.any():
                rows = first + np.flatnonzero(mine)
                self._pairs[:, rows], targets[rows] = item.atoms[mine].T, item.target_at(0.0)[mine]
        offsets = self._placed(4 * self._pairs).reshape(2, -1, WIDTH)
        self._offsets, self._targets = offsets.swapaxes(0, 1).astype(np.uint32, "C"), self._placed(targets)
        self._rows = np.flatnonzero(~self._lengths)
        self._given = np.zeros((3, self._n_places if len(self._rows) else 0))
        self.others: Any = None
        if len(self._rows):
            self.others, self._atoms = held.subset(self._rows)
        self._is_held = np.isin(np.arange(held.n_atoms), held.touched)
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

    def _placed(self, values: NDArray[Any], rest: float = 0.0) -> FloatArray:
        """Numbers by row where compiled code has them, and one for what is no row there."""
        placed = np.full((*values.shape[:-1], self._n_places), rest)
        placed[..., self._places] = values
        return placed

    def __getstate__(self) -> dict[str, Any]:
        """What `look` needs, in other processes: to copy all of it takes longer than to look at some frames."""
        kept = {"_offsets", "_targets", "_slack", "_most", "_given", "_runs", "_is_held"}
        kept |= {"_masses", "_places", "_n_places", "others", "_rows", "_atoms", "means"}
        return {name: value for name, value in vars(self).items() if name in kept}

    def _made_of(self, errors: FloatArray, slopes: Any) -> FloatArray:
        """What errors of coordinates make of each row, at most; rows of velocities have no position to be off."""
        result: FloatArray = SECOND_ORDER * (slopes @ np.repeat(errors, 3))
        result[self._lengths] = _ROOT_THREE * errors[self._pairs[:, self._lengths]].sum(axis=0)
        return np.where(self.set.holonomic, result, 0.0)

    def _allow(self, of_targets: FloatArray) -> None:
        #: What rounding makes of the targets, at most; the tolerance and the rounding of frames come besides.
        self.of_targets = of_targets
        # What rows may be off by besides rounding, and the rounding up to which a frame counts: that or their size.
        slack = of_targets + self.tolerance * self.sizes
        self._slack, self._most = self._placed(slack), self._placed(np.maximum(slack, self.sizes), -1.0)

    def take_means(self, found: Found) -> None:
        """Take the means that a first pass found as targets."""
        self.means = np.where(self.measured & self.set.holonomic, found.mean("total"), 0.0)
        self._targets += self._placed(np.where(self._lengths, self.means, 0.0))
        seen = self.measured & (found.rows["counted"] > 0)
        self._allow(np.where(seen, found.mean("rounded"), self.of_targets))

    def begin(self) -> None:
        """Forget what was found by row."""
        self._by_row = np.zeros((_BY_ROW.itemsize // 8, self._n_places))
        self._by_row[0] = -np.inf

    def end(self, found: Found) -> None:
        """Put what was found by row in the frames that were looked at."""
        found.units, found.frames = found.units[: found.looked], found.frames[: found.looked]
        found.rows = self._by_row[:, self._places].T.copy().view(_BY_ROW)[:, 0]
        # Compiled code counts the others.
        found.rows["counted"] = len(found.frames) - found.rows["counted"]

    def look(self, found: Found, given: Frames, precision: FilePrecision) -> None:
        """Put what is found in frames, which must be finite, into the next places; with velocities rates, too."""
        (words, cells, times, v), n, masses = given, len(self._is_held), self._masses
        frames, units = (part[found.looked : found.looked + len(words)] for part in (found.frames, found.units))
        frames["time"], speeds = times, _NO_SPEEDS
        lattices, limits = (np.array(part) for part in zip(*map(_cell_of, cells), strict=True))
        frames["turning"] = np.where(limits == np.inf, np.nan, np.inf)
        x = words.view(np.float32)[:, -3 * (n + 2) :].reshape(-1, 3, n + 2)[:, :, 1:-1].swapaxes(1, 2)
        if v is not None:
            speeds = np.column_stack([v, np.zeros(len(v))])
            if not np.isfinite(speeds).all():
                atom = int(np.argmin(np.isfinite(speeds).all(axis=1)))
                raise NonFiniteError(f"velocity of atom {atom} is {v[atom]}", item="velocity", atom=atom)
            units["rate_squares"] = units["rate"] = 0.0
            if masses is not None:
                frames["kinetic"], frames["momentum"] = (masses @ (speeds * speeds)).sum(), (masses @ speeds)[:3]
                if limits[0] == np.inf:
                    frames["turning"] = _turning(x[0] - masses @ x[0] / masses.sum(), speeds[:, :3], masses)
        if self.others is not None:
            lattice = lattices[0] if limits[0] < np.inf else None
            self._look_at_others(x[0], speeds[:, :3], lattice, precision, float(times[0]))
        looked, bad = _look(
            (words, self._is_held, speeds),
            (lattices, limits, precision.step * precision.exact, *precision.coefficients),
            (self._offsets, self._targets, self._slack, self._most, self._given, self._runs),
            self._by_row,
            units.view(np.float64),
            frames["frame"].astype(np.float64),
        )
        found.looked += looked
        if bad >= 0:
            raise NonFiniteError(f"position of atom {bad} is {x[looked, bad]}", item="position", atom=bad)
        if looked < len(words):
            said = ", ".join(f"{value:g}" for value in np.frombuffer(cells[looked], np.float32))
            raise NonFiniteError(f"the cell is ({said})", item="cell")

    def _look_at_others(
        self, x: NDArray[np.float32], v: FloatArray, lattice: FloatArray | None, precision: FilePrecision, time: float
    ) -> None:
        """Put deviation, rounding and rate of the rows that are no lengths where compiled code finds them."""
        others, rows, atoms = self.others, self._rows, self._atoms
        others.lattice = lattice
        here = precision.stored(x[atoms])
        with np.errstate(all="ignore"):
            off = others.value(here, time) - self.means[rows]
            slopes = others.jacobian(here, time)
            rounding = SECOND_ORDER * (abs(slopes) @ np.repeat(precision.half_step(here), 3))
            rate = np.abs(slopes @ v[atoms].ravel() - others.velocity_target(here, time)) if len(v) else 0.0 * off
        # Where atoms coincide, an angle is no number, nor is its rounding.
        rounding = np.where(np.isfinite(off + rounding), np.where(others.holonomic, rounding, 0), np.inf)
        self._given[:, self._places[rows]] = off, rounding, rate


@lru_cache(maxsize=1)
def _cell_of(unitcell: bytes) -> tuple[FloatArray, float]:
    """Cell with its inverse, and the square of half its smallest width: infinite without one, -1 if it is no number."""
    dimensions = np.frombuffer(unitcell, np.float32)
    if not np.isfinite(dimensions).all():
        return NO_LATTICE, -1.0
    # Files without a cell have lengths of 1; of angles that cannot be there are no vectors.
    matrix = triclinic_vectors(dimensions * (dimensions[:3] > NARROWEST).all(), dtype=np.float64)
    if not matrix.any():
        return NO_LATTICE, np.inf
    inverse = np.linalg.inv(matrix)
    half = 0.5 / float(np.linalg.norm(inverse, axis=0).max())
    return np.stack([matrix, inverse]), half * half


def _turning(r: FloatArray, v: FloatArray, masses: FloatArray) -> float:
    """Twice the kinetic energy of the turn of the whole, of positions from the center of mass."""
    weighted = masses[:, None] * r
    momentum, inertia = np.cross(weighted, v).sum(axis=0), np.sum(weighted * r) * np.eye(3) - weighted.T @ r
    return float(momentum @ np.linalg.pinv(inertia, hermitian=True) @ momentum)


def _by_row(constraints: Sequence[Constraint], values: Sequence[Any]) -> Any:
    """One value a constraint, for each of its rows."""
    return np.repeat(np.array(values), [item.n_rows for item in constraints])


@njit(cache=True, nogil=True, fastmath=FASTMATH)
def _look(atoms, space, held, by_row, by_unit, frames):  # type: ignore[no-untyped-def]
    """Put deviations of all rows in frames into `by_row` and `by_unit`, up to one whose cell or held atom is no number.

    How many frames were looked at, and this atom, or -1.

    `atoms`: bits of positions, shape (n_frames, 3, n_atoms + 2), of which the first and the last in a row are others;
    which are held; velocities with 0 behind each, or none. `by_unit`: of each frame. `frames`: their numbers.
    `space`: cells and their inverses, and the squares of half their smallest widths, below which vectors are their own
    nearest images; the grid of coordinates in the file, or 0; the coefficients of `FilePrecision`. `held`: where both
    atoms of eight rows at a time are among quads; target, slack and largest rounding of rows; deviation, rounding and
    rate of those that are no lengths; first row, end and unit of runs, and whether they are lengths.
    """
    words, is_held, speeds = atoms
    lattices, limits, step, base, factor, reach = space
    offsets, targets, slack, most, given, runs = held
    n_atoms, n_rows = len(is_held), len(targets)
    quads, inverse = np.empty((n_atoms, 4)), 1.0 / step if step > 0.0 else 0.0
    lanes, zero, one, least = np.empty(8 * WIDTH), splat(0.0), splat(1.0), np.float32(reach).view(np.int32)
    for f in range(len(frames)):
        cell, limit = lattice_numbers(lattices[f]), limits[f]
        if limit < 0.0:
            return f, -1
        # Coordinates as the file holds them, and the power of two below the largest.
        bits, worst = words[f, -3 * (n_atoms + 2) :].reshape((3, n_atoms + 2)), np.int32(0)
        x = bits.view(np.float32)
        for a in range(n_atoms):
            exponent = max(max(bits[0, 1 + a] & _EXPONENT, bits[1, 1 + a] & _EXPONENT), bits[2, 1 + a] & _EXPONENT)
            worst = max(worst, exponent)
            p, q, r = np.float64(x[0, 1 + a]), np.float64(x[1, 1 + a]), np.float64(x[2, 1 + a])
            if step > 0.0:
                p, q, r = np.rint(p * inverse) * step, np.rint(q * inverse) * step, np.rint(r * inverse) * step
            power = np.int32(exponent if exponent >= least else 0).view(np.float32)
            quads[a, 0], quads[a, 1], quads[a, 2], quads[a, 3] = p, q, r, power
        if worst == _EXPONENT:
            for a in range(n_atoms):
                if is_held[a] and not np.isfinite(quads[a, 0] + quads[a, 1] + quads[a, 2]):
                    return f, a
        for run in range(len(runs)):
            begin, end, unit, lengths = runs[run]
            total, squares, violated, seen = zero, zero, zero, zero
            rates, fastest, largest, coarsest = zero, zero, zero, zero
            for r in range(begin, end, WIDTH):
                rate, told = zero, one
                if lengths:
                    dx, dy, dz, power = gather_ends(quads, offsets, 2 * r, 2 * r + WIDTH)
                    square = dx * dx + dy * dy + dz * dz
                    if not all_within(square, limit):
                        dx, dy, dz = minimum_image((dx, dy, dz), cell, TRICLINIC)
                        square = dx * dx + dy * dy + dz * dz
                    off = square_root(square) - load(targets, r)
                    rounding = power * (_ROOT_THREE * factor) + 2.0 * _ROOT_THREE * base
                    if len(speeds):
                        vx, vy, vz, _ = gather_ends(speeds, offsets, 2 * r, 2 * r + WIDTH)
                        along = absolute(dx * vx + dy * vy + dz * vz) / square_root(square)
                        rate = where_greater(square, zero, along, zero)
                else:
                    off, rounding, rate = load(given, r), load(given, n_rows + r), load(given, 2 * n_rows + r)
                size, bound = absolute(off), load(most, r)
                margin = size - rounding - load(slack, r)
                if not all_within(rounding, bound):
                    told = where_greater(rounding, bound, zero, one)
                    off, size = where_greater(rounding, bound, zero, off), where_greater(rounding, bound, zero, size)
                    margin = where_greater(rounding, bound, splat(-np.inf), margin)
                    rate = where_greater(rounding, bound, zero, rate)  # where atoms coincide, no number
                    rounding = where_greater(rounding, bound, zero, rounding)
                    store(by_row, 5 * n_rows + r, load(by_row, 5 * n_rows + r) + one - told)
                total = total + off
                squares = squares + off * off
                violated = violated + where_greater(margin, zero, one, zero)
                seen = seen + told
                rates = rates + rate * rate
                fastest = where_greater(rate, fastest, rate, fastest)
                largest = where_greater(size, largest, size, largest)
                coarsest = where_greater(rounding, coarsest, rounding, coarsest)
                store(by_row, 3 * n_rows + r, load(by_row, 3 * n_rows + r) + off)
                store(by_row, 4 * n_rows + r, load(by_row, 4 * n_rows + r) + rounding)
                best = load(by_row, r)
                if not all_within(margin, best):
                    store(by_row, r, where_greater(margin, best, margin, best))
                    for k, value in ((1, size), (2, splat(frames[f]))):
                        before = load(by_row, k * n_rows + r)
                        store(by_row, k * n_rows + r, where_greater(margin, best, value, before))
            # Sums, then what is largest.
            for k, vector in enumerate((total, squares, violated, seen, rates, fastest, largest, coarsest)):
                store(lanes, k * WIDTH, vector)
            for k in range(8 * WIDTH):
                at = 8 * unit + k // WIDTH
                by_unit[f, at] = by_unit[f, at] + lanes[k] if k < 5 * WIDTH else max(by_unit[f, at], lanes[k])
    return len(frames), -1
