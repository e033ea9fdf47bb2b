"""What was found in the frames of a trajectory, and what it says of rows and units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.frames.deviations import UNITS, Deviations
from kcons.mdanalysis.check.frames.row_table import RowTable
from kcons.mdanalysis.check.result import Break, RowResult, UnitResult, fitted


@dataclass
class Part:
    """What one worker found in its frames; `reach` is the largest coordinate, NaN where it was not looked up."""

    frames: IntArray
    times: FloatArray
    found: Deviations
    twice_kinetic: FloatArray
    momentum: FloatArray
    reach: FloatArray
    broken: Break | None = None

    @classmethod
    def of(cls, frames: IntArray, n_rows: int) -> Part:
        """Frames that were not looked at yet."""
        n = len(frames)
        nothing = np.full(n, np.nan)
        return cls(
            np.array(frames, dtype=np.int64),
            np.zeros(n),
            Deviations(n_rows, n),
            nothing,
            np.zeros((n, 3)),
            nothing.copy(),
        )

    def cut(self, n_frames: int) -> None:
        """Leave out what was not reached."""
        self.found.cut(n_frames)
        for name in ("frames", "times", "twice_kinetic", "momentum", "reach"):
            setattr(self, name, getattr(self, name)[:n_frames])

    def with_next(self, other: Part) -> Part:
        return Part(
            np.concatenate([self.frames, other.frames]),
            np.concatenate([self.times, other.times]),
            self.found.with_next(other.found),
            np.concatenate([self.twice_kinetic, other.twice_kinetic]),
            np.concatenate([self.momentum, other.momentum]),
            np.concatenate([self.reach, other.reach]),
            other.broken,
        )


def joined(parts: Sequence[Part]) -> Part:
    """Parts in order, up to the first break."""
    whole = parts[0]
    for part in parts[1:]:
        if whole.broken is not None:
            break
        whole = whole.with_next(part)
    return whole


def rms_of(found: Deviations) -> FloatArray:
    """Root mean square over the rows of each unit and frame, shape (units, frames)."""
    result: FloatArray = np.sqrt(found.squares / np.maximum(found.seen, 1))
    return result


def by_unit(
    table: RowTable, part: Part, of_targets: FloatArray, rounding: FloatArray, tolerance: float
) -> list[UnitResult]:
    """All rows of a unit together.

    Parameters
    ----------
    table : RowTable
    part : Part
        All frames.
    of_targets : ndarray, shape (n_rows,)
        What rounding makes of the targets, at most.
    rounding : ndarray, shape (n_rows,)
        Standard deviation of what rounding makes of the rows.
    tolerance : float
    """
    found = part.found
    result = []
    rms = rms_of(found)
    for unit, name in enumerate(UNITS):
        mine = table.units == unit
        n = int(mine.sum())
        if not n:
            continue
        seen = max(float(found.seen[unit].sum()), 1.0)
        rates = np.isfinite(found.rate_squares[unit])
        rate_rms = float(np.sqrt(found.rate_squares[unit][rates].mean() / n)) if rates.any() else None
        result.append(
            UnitResult(
                unit=name,
                n_rows=n,
                largest=float(found.worst[unit].max()),
                rms=float(np.sqrt(found.squares[unit].sum() / seen)),
                mean=float(found.sums[unit].sum() / seen),
                bound=float(found.rounding[unit].max() + of_targets[mine].max()),
                tolerance=float(tolerance * table.sizes[mine].min()),
                rounding_rms=float(np.sqrt(np.mean(rounding[mine] ** 2))),
                largest_mean=float(np.abs(found.mean(found.total)[mine]).max()),
                drift=fitted(part.times, rms[unit]),
                rate_largest=float(np.nanmax(found.rate_worst[unit])) if rates.any() else None,
                rate_rms=rate_rms,
            )
        )
    return result


def row_result(table: RowTable, labels: AtomNames, row: int, part: Part) -> RowResult:
    """One row, by name."""
    found, held = part.found, table.set
    unit = int(table.units[row])
    item, k = held.locate(row)
    # By row, single precision is kept; by frame, double.
    mine = np.flatnonzero(found.worst_row[unit] == row)
    at = mine[np.float32(found.excess[unit][mine]) >= np.float32(found.margins[row])]
    largest, margin = found.largest[row], found.margins[row]
    if len(at):
        margin = found.excess[unit][at[0]]
        if np.float32(found.worst[unit][at[0]]) == np.float32(largest):
            largest = found.worst[unit][at[0]]
    atoms = item.atoms[k]
    return RowResult(
        row=row,
        name=f"{item.family} {labels.row(atoms)}",
        atoms=[int(a) for a in atoms],
        unit=UNITS[unit],
        target=float(item.target_at(float(part.times[0]))[k]),
        largest=float(largest),
        mean=float(found.mean(found.total)[row]),
        allowed=float(largest - margin),
        frame=int(part.frames[at[0]]) if len(at) else None,
    )


def first_alone(table: RowTable, part: Part, tolerance: float) -> str:
    """What to say where the first frame alone differs; '' where it does not, or there are fewer than three.

    Where targets come from it, all others are off; they agree if they differ among themselves by no more than rounding
    and the tolerance, in the root mean square.

    Parameters
    ----------
    table : RowTable
    part : Part
        All frames.
    tolerance : float
    """
    found = part.found
    off = (found.excess > 0).any(axis=0)
    if len(off) < 3 or off[0] == off[1] or (off[1:] != off[1]).any():
        return ""
    spreads = []
    for unit, name in enumerate(UNITS):
        mine = table.units == unit
        if off[1] and mine.any():
            means = found.total[mine] / np.maximum(found.counted[mine] - 1, 1)
            rms = float(np.sqrt(max(found.squares[unit, 1:].mean() - means @ means, 0.0) / mine.sum()))
            if rms > found.rounding[unit].max() + tolerance * table.sizes[mine].min():
                return ""
            spreads.append(f"{rms:.1e} {name}")
    among = f": the others agree to {' and '.join(spreads)} (root mean square)" if spreads else ""
    return (
        f"the first frame alone differs{among}. Programs such as LAMMPS write it before they hold the constraints; "
        f"begin at frame {part.frames[1]} (--frames {part.frames[1]}:)"
    )


def verdict_of(
    status: str,
    tolerance: float,
    row: RowResult,
    units: list[UnitResult],
    rows: tuple[int, int],
    frames: IntArray,
    n_frames: int,
    gaps: Sequence[str],
) -> str:
    """The result in a sentence; `rows`: how many are violated, and of how many; `gaps`: what could not be told."""
    most = ", ".join(f"{unit.largest:.2g} {unit.unit} (rounding: up to {unit.bound:.2g})" for unit in units)
    if status == "incomplete":
        return f"incomplete: {'; '.join(gaps)}; no violation otherwise in {n_frames} frames: largest deviation {most}"
    if status == "kept":
        return f"kept to the precision of the file: largest deviation {most}"
    if status == "tolerated":
        return f"kept to the tolerance of {tolerance:g}: largest deviation {most}"
    where = f" in frame {row.frame}" if row.frame is not None else ""
    seen = f"; {len(frames)} of {n_frames} frames, from frame {frames[0]}" if len(frames) else ""
    return (
        f"violated by {row.largest:.3g} {row.unit} ({row.largest - row.allowed:.2g} more than allowed): "
        f"{row.name}{where}; {rows[0]} of {rows[1]} rows{seen}"
    )


def gaps_of(part: Part, from_frames: int, untold: int, what: str) -> list[str]:
    """Why a check is no verdict on all that was asked; empty where it is.

    Parameters
    ----------
    part : Part
        All frames.
    from_frames : int
        Rows whose targets come from the frames themselves.
    untold : int
        Rows whose targets are as imprecise as they are long.
    what : str
        Where targets come from.
    """
    gaps = [] if part.broken is None else [part.broken.text]
    n_rows = part.found.n_rows
    if len(part.frames) == 1 and from_frames:
        which = "targets" if from_frames == n_rows else f"targets of {from_frames} of {n_rows} rows"
        gaps.append(
            f"{which} come from the only frame that was looked at, so that it cannot be off; look at more frames, or "
            "take targets from the topology or a parameter file"
        )
    if untold:
        gaps.append(
            f"coordinates in {what} are so large that their rounding exceeds the lengths of {untold} of {n_rows} rows: "
            "these have no targets; begin at another frame, or take targets from the topology or a parameter file"
        )
    unseen = n_rows - part.found.seen.sum(axis=0)
    frames = np.flatnonzero(unseen > 0)
    if len(frames):
        gaps.append(
            f"nothing can be told of up to {unseen.max():.0f} of {n_rows} rows in {len(frames)} of {len(part.frames)} "
            f"frames, from frame {part.frames[frames[0]]}: coordinates are so large that their rounding exceeds the "
            "lengths, or atoms coincide"
        )
    return gaps
