"""Frames of a trajectory looked at one after another, in blocks of the file or by MDAnalysis' reader, up to a break."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from MDAnalysis.lib.log import ProgressBar
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import KconsError, NonFiniteError
from kcons.mdanalysis.check.files.file_precision import FilePrecision
from kcons.mdanalysis.check.files.plain_dcd import PlainDcd, plain_dcd
from kcons.mdanalysis.check.findings import Part
from kcons.mdanalysis.check.frames.frame_kernels import farthest, kinetic
from kcons.mdanalysis.check.frames.length_table import size_of
from kcons.mdanalysis.check.frames.row_table import RowTable
from kcons.mdanalysis.check.result import Break
from kcons.mdanalysis.loading import READ_ERRORS, format_of, quiet
from kcons.mdanalysis.topology import velocities_known

#: Times a run that the largest coordinate is looked up; frames, at least, that a mean of a row is taken over, and one
#: in how many frames at least.
SAMPLES, SUMMED, MOST_SKIPPED = 32, 100, 8


@dataclass
class Reading:
    """How the frames of a trajectory are looked at.

    Attributes
    ----------
    precision : FilePrecision
        Of the coordinates in the file.
    by_frame : sequence of FilePrecision or None
        Where it differs from frame to frame.
    masses : ndarray, shape (n_atoms,), or None
        For the kinetic energy.
    velocities : bool
        Whether velocities, where there are any, are in angstrom/ps.
    damage : Break or None
        Where the file is known to be damaged.
    """

    precision: FilePrecision
    by_frame: Any
    masses: FloatArray | None
    velocities: bool = True
    damage: Break | None = None

    def precision_at(self, frame: int) -> FilePrecision:
        """Of the coordinates of one frame."""
        return self.precision if self.by_frame is None else self.by_frame[frame]

    def read(self, trajectory: Any, numbers: IntArray, table: RowTable, all_summed: bool, bar: ProgressBar) -> Part:
        """Look at frames in order, without seeking where they follow each other; stop at a break.

        Parameters
        ----------
        trajectory : ReaderBase
        numbers : ndarray of int
        table : RowTable
            Its own one for each worker.
        all_summed : bool
            Whether all frames count in the sums by row: means need all of them, what is only told about rows does not.
        bar : ProgressBar
        """
        n = len(numbers)
        part = Part.of(numbers, table.set.n_rows)
        every = (1 if all_summed else min(max(n // SUMMED, 1), MOST_SKIPPED), max(n // SAMPLES, 1))
        file = blocks_of(trajectory, table)
        if file is not None:
            done = self._read_blocks(trajectory, file, table, part, every, bar)
        else:
            with quiet():
                done = self._read_frames(trajectory, table, part, every, bar)
        table.collect(part.found)
        part.cut(done)
        return part

    def _read_blocks(
        self, trajectory: Any, file: PlainDcd, table: RowTable, part: Part, every: tuple[int, int], bar: ProgressBar
    ) -> int:
        """Frames that were looked at, up to a break."""
        numbers = np.where(part.frames < 0, part.frames + file.n_frames, part.frames)
        part.times[:] = file.times(numbers)
        points = np.empty((file.n_atoms, 3), dtype=np.float32)
        done = 0
        try:
            for block in file.blocks(numbers):
                looked, part.reach[done : done + len(block.words)] = table.look_at_block(
                    part.found, done, block, points, every
                )
                done += looked
                bar.update(looked)
                if looked < len(block.words):
                    table.refuse(points, block.dimensions[looked])
        except (OSError, KconsError) as error:
            part.broken = broken_by(error, trajectory, int(part.frames[done]))
        return done

    def _read_frames(
        self, trajectory: Any, table: RowTable, part: Part, every: tuple[int, int], bar: ProgressBar
    ) -> int:
        """Frames that MDAnalysis' reader gave, up to a break."""
        n = len(part.frames)
        previous = None
        for k, frame in enumerate(part.frames.tolist()):
            try:
                if self.damage is not None and frame >= self.damage.frame:
                    part.broken = self.damage
                    return k
                ts = trajectory.next() if previous is not None and frame == previous + 1 else trajectory[frame]
                previous = frame
                table.precision = self.precision_at(frame)
                self._look(table, part, k, ts, k % every[1] == 0 or k == n - 1, k % every[0] == 0)
            except (*READ_ERRORS, KconsError, FloatingPointError) as error:
                part.broken = broken_by(error, trajectory, frame)
                return k
            bar.update()
        return n

    def _look(self, table: RowTable, part: Part, k: int, ts: Any, sample: bool, summed: bool) -> None:
        x = _flat(ts.positions)
        v = _flat(ts.velocities) if ts.has_velocities and self.velocities else None
        time = float(ts.time)
        part.times[k] = time
        table.look(part.found, k, x, v, ts.dimensions, time, summed)
        if sample:
            part.reach[k] = size_of(farthest(x))
        if v is not None and self.masses is not None:
            part.twice_kinetic[k], *part.momentum[k] = kinetic(v, self.masses)


def remarks_on(reader: Any) -> list[str]:
    """What a reader of MDAnalysis does not know, or was told to do."""
    remarks, name = [], format_of(reader)
    if getattr(reader, "transformations", ()):
        remarks.append("the trajectory has transformations; deviations are those of transformed coordinates")
    if reader.ts.has_velocities and not velocities_known(reader):
        remarks.append(f"no temperature: velocities of {name} files have no unit")
    # Dumps of LAMMPS have numbers of steps.
    timed = name in ("MEMORY", "CHAIN") or hasattr(reader, "_get_dt") or "dt" in getattr(reader, "_ts_kwargs", {})
    if not timed and (name == "LAMMPSDUMP" or "time" not in reader.ts.data) and reader.n_frames > 1:
        apart = "steps" if name == "LAMMPSDUMP" else "frames"
        remarks.append(f"{name} files have no times: {apart} are taken to be 1 ps apart, in drifts too")
    return remarks


def blocks_of(trajectory: Any, table: RowTable) -> PlainDcd | None:
    """The file, where it can be read in blocks."""
    return plain_dcd(trajectory) if table.only_lengths else None


def broken_by(error: BaseException, trajectory: Any, frame: int) -> Break:
    """Where and why a trajectory cannot be read further; what the reader says, which iteration hides."""
    if isinstance(error, StopIteration):
        try:
            trajectory[frame]
        except READ_ERRORS as hidden:
            error = hidden
    lines = str(error).strip().splitlines()
    return Break(frame, lines[0].strip() if lines else "the file ends", not isinstance(error, NonFiniteError))


def _flat(values: Any) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
