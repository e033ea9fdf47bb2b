"""What a check says, from what was found in all frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.bound_rows import BoundRows
from kcons.mdanalysis.check.files.file_precision import described
from kcons.mdanalysis.check.findings import Part, by_unit, first_alone, gaps_of, rms_of, row_result, verdict_of
from kcons.mdanalysis.check.frames.deviations import UNITS
from kcons.mdanalysis.check.reading import Reading
from kcons.mdanalysis.check.result import CheckResult
from kcons.mdanalysis.check.temperature import BOLTZMANN, temperature_of


@dataclass
class Asked:
    """What a check was asked for.

    Attributes
    ----------
    names : (str, str)
        What to call trajectory and topology.
    labels : AtomNames
    mode : {'given', 'first', 'mean'}
        Where targets come from.
    target_text : str
        The same in words.
    removed : int or None
        Degrees of freedom that the MD engine took away; None to find them.
    worst : int
        Number of rows to name.
    remarks : list of str
        What there is to say besides.
    gaps : list of str
        What is known beforehand to be missing.
    """

    names: tuple[str, str]
    labels: AtomNames
    mode: str
    target_text: str
    removed: int | None
    worst: int
    remarks: list[str] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)


def concluded(
    part: Part, rows: BoundRows, asked: Asked, reading: Reading, rank: int | None, masses: FloatArray, n_in_file: int
) -> CheckResult:
    """All that there is to say.

    Parameters
    ----------
    part : Part
        All frames.
    rows : BoundRows
    asked : Asked
        More remarks are put there.
    reading : Reading
    rank : int or None
        Of the rows.
    masses : ndarray, shape (n_atoms,)
    n_in_file : int
        Frames in the file.
    """
    found, n_frames = part.found, len(part.frames)
    table, held = rows.table, rows.table.set
    violated = found.margins > 0
    beyond_file = found.margins + rows.tolerance * table.sizes > 0
    # Targets that are nothing but rounding.
    untold = rows.measured & (rows.of_targets > table.sizes)
    gaps = asked.gaps + gaps_of(part, int(rows.measured.sum()), int(untold.sum()), asked.target_text)
    # The rounding of a mean averages out.
    of_targets = rows.of_targets if asked.mode != "mean" else np.where(rows.measured, 0.0, rows.of_targets)
    rounding = rows.spread_of_rounding * np.hypot(found.mean(found.rounded), of_targets)
    units = by_unit(table, part, np.where(untold, 0.0, rows.of_targets), rounding, rows.tolerance)
    order = np.lexsort((-np.where(violated, found.margins, found.largest), ~violated))
    worst = [row_result(table, asked.labels, int(row), part) for row in order[: max(asked.worst, 1)]]
    bare = int(found.without_cell.sum())
    if bare and (violated & (table.units == 0) & (found.largest > table.sizes)).any():
        some = "" if bare == n_frames else f"{bare} of {n_frames} "
        asked.remarks.append(
            f"lengths are off by more than themselves, and {some}frames of {asked.names[0]} have no cell: molecules "
            "cut by a face of one look like this. Give a format that has the cell (not XYZ), or whole molecules"
        )
    if alone := first_alone(table, part, rows.tolerance):
        asked.remarks.append(alone)
    in_frame = (found.excess > 0).any(axis=0)
    frames = part.frames[in_frame]
    status = "tolerated" if beyond_file.any() else "kept"
    status = "violated" if violated.any() else "incomplete" if gaps else status
    freedom, temperature = None, None
    if rank is not None:
        freedom, temperature, remarks = temperature_of(part, rank, masses, asked.removed)
        asked.remarks.extend(remarks)
    series = {
        f"{name} {UNITS[unit]}": values[unit].tolist()
        for unit in range(len(UNITS))
        if (table.units == unit).any()
        for name, values in (("largest", found.worst), ("rms", rms_of(found)), ("rounding", found.rounding))
    }
    if temperature is not None:
        assert freedom is not None
        series["temperature K"] = (part.twice_kinetic / (BOLTZMANN * freedom)).tolist()
    counts = int(violated.sum()), held.n_rows
    return CheckResult(
        trajectory=asked.names[0],
        topology=asked.names[1],
        n_atoms=held.n_atoms,
        n_rows=held.n_rows,
        n_constrained=len(held.touched),
        status=status,
        verdict=verdict_of(status, rows.tolerance, worst[0], units, counts, frames, n_frames, gaps),
        precision=described([reading.precision_at(frame) for frame in part.frames.tolist()], part.reach),
        tolerance=rows.tolerance,
        targets=asked.target_text,
        frames=part.frames.tolist(),
        times=part.times.tolist(),
        n_frames_in_file=n_in_file,
        units=units,
        worst=worst[: asked.worst],
        violated_rows=int(violated.sum()),
        violated_frames=int(in_frame.sum()),
        first_violated_frame=int(frames[0]) if len(frames) else None,
        rank=rank,
        degrees_of_freedom=freedom,
        temperature=temperature,
        broken=part.broken,
        series=series,
        gaps=gaps,
        remarks=list(asked.remarks),
    )
