"""How well a trajectory, of whatever engine, kept its constraints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from MDAnalysis.analysis.base import AnalysisBase
from MDAnalysis.analysis.results import Results, ResultsGroup
from MDAnalysis.lib.log import ProgressBar
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, NonFiniteError, UnreadableError
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.compiling import compiled_elsewhere, frame_of, look_once, sample_of
from kcons.mdanalysis.check.deviations import UNITS, Deviations
from kcons.mdanalysis.check.files.endings import intact_frames, last_offset, leftover
from kcons.mdanalysis.check.files.file_precision import FilePrecision, by_frame, described, precision_of
from kcons.mdanalysis.check.files.plain_dcd import PlainDcd, plain_dcd
from kcons.mdanalysis.check.files.target_file import TargetFile
from kcons.mdanalysis.check.findings import (
    Part,
    by_unit,
    gaps_of,
    joined,
    rms_of,
    row_result,
    verdict_of,
)
from kcons.mdanalysis.check.frame_kernels import coordinate_grid, farthest, kinetic
from kcons.mdanalysis.check.rank_by_pieces import rank_of
from kcons.mdanalysis.check.result import Break, CheckResult
from kcons.mdanalysis.check.row_table import SECOND_ORDER, RowTable, cell_matrix, size_of
from kcons.mdanalysis.check.temperature import BOLTZMANN, masses_of, temperature_of
from kcons.mdanalysis.check.workers import inherited, short_pickle, with_backend
from kcons.mdanalysis.loading import READ_ERRORS, format_of, quiet

#: Times a run that the largest coordinate is looked up; frames, at least, that a mean of a row is taken over, and one
#: in how many frames at least.
SAMPLES, SUMMED, MOST_SKIPPED = 32, 100, 8


class _Remote:
    """What a worker sends back: no trajectory, no tables."""

    def __init__(self, part: Part) -> None:
        self.frames, self.times, self.results = part.frames, part.times, Results(part=part)


class ConstraintCheck(AnalysisBase):
    """Deviations of all constraints along a trajectory, told by the precision of its file.

    Parameters
    ----------
    atoms : MDAnalysis.Universe or AtomGroup
        With the trajectory; of a group, its Universe.
    constraints : Constraint, iterable of Constraint, or ConstraintSet
        What should be held, in angstrom, on the atoms of the Universe.
    targets : {'given', 'first', 'mean'}, path or TargetFile
        Where the lengths come from. 'given': what the constraints say, and the first frame for those that do not
        say. 'first': the first frame looked at. 'mean': the mean over the frames, which are read twice. A path: a
        parameter file, see `kcons.mdanalysis.check.files.target_file`.
    tolerance : float
        Relative violation that counts as the engine's tolerance and not as a violation, in parts of the length (of
        1 rad for angles).
    precision : float, optional
        Step of the coordinates in the file, in angstrom, for formats where it cannot be known.
    target_error : float or ndarray, shape (n_atoms,)
        Rounding of the targets, in angstrom a coordinate, of each atom or of all; for 'given' targets that were
        measured in another file.
    removed : int, optional
        Degrees of freedom that the engine took away besides: 3 where it stops the centre of mass. Found from the
        total momentum by default.
    rank : bool
        Whether to find the rank, which takes longer than the frames of a short trajectory.
    worst : int
        Number of rows to name.
    names : tuple of str, optional
        What to call trajectory and topology.

    Raises
    ------
    InputError
        No constraints; constraints on atoms that do not exist; a bad option.

    Notes
    -----
    An atom whose coordinates were rounded by at most h each moves a distance by at most √3 h, both atoms by the sum,
    and any other row by Σ h |∂q/∂x| to first order. h is that of the largest coordinate of the atom, in its frame.
    Targets that were read from a frame are rounded themselves, which about doubles the bound. Velocities of leapfrog
    integrators belong to the middle of a step and are not tangent at the positions they are stored with.

    Backends: serial, multiprocessing, dask, and threads for DCD files and rows that are all lengths
    (`run(backend=..., n_workers=...)`); of several workers, threads where they can be had, processes otherwise.
    """

    _analysis_algorithm_is_parallelizable = True

    def __init__(
        self,
        atoms: Any,
        constraints: Constraint | Iterable[Constraint] | ConstraintSet,
        *,
        targets: Literal["given", "first", "mean"] | str | Path | TargetFile = "given",
        tolerance: float = 1e-4,
        precision: float | None = None,
        target_error: float | FloatArray = 0.0,
        removed: int | None = None,
        rank: bool = True,
        worst: int = 10,
        names: tuple[str, str] | None = None,
        **options: Any,
    ) -> None:
        universe = atoms.universe
        super().__init__(universe.trajectory, **options)
        if isinstance(constraints, ConstraintSet):
            given: tuple[Constraint, ...] = constraints.constraints
        else:
            given = (constraints,) if isinstance(constraints, Constraint) else tuple(constraints)
        if not sum(item.n_rows for item in given):
            raise InputError(
                "there are no constraints to check; select others, or look at the bonds of the topology",
                item="constraints",
            )
        if not (np.isfinite(tolerance) and tolerance >= 0):
            raise InputError(f"the tolerance is {tolerance}; give a number such as 1e-4, or 0", item="tolerance")
        errors = np.asarray(target_error, dtype=np.float64)
        if errors.shape not in ((), (len(universe.atoms),)) or not (errors >= 0).all() or not np.isfinite(errors).all():
            raise InputError(
                f"target_error is {target_error}; give a length in angstrom, or one for each atom", item="target_error"
            )
        if worst < 0:
            raise InputError(f"worst is {worst}; give a number of rows to name", item="worst")
        self._labels = AtomNames(universe)
        self.remarks: list[str] = []
        self._unit_masses = np.ones(len(universe.atoms))
        self._masses, reason = masses_of(universe, given, self._labels)
        if reason:
            self.remarks.append(f"no temperature: {reason}")
        if targets not in ("given", "first", "mean"):
            file = targets if isinstance(targets, TargetFile) else TargetFile(targets)
            given, self.target_text = tuple(file.apply(given, self._labels)), str(file.path)
            self._mode = "given"
        else:
            self._mode = str(targets)
            self.target_text = {"first": "the first frame", "mean": "the mean of the frames"}.get(
                self._mode, "as given"
            )
        self._given = given
        self._tolerance, self._target_error = float(tolerance), np.broadcast_to(errors, len(universe.atoms))
        self._removed, self._wants_rank, self._n_worst = removed, rank, int(worst)
        reader = self._trajectory
        self._path = str(getattr(reader, "filename", None) or "")
        self._format = format_of(reader)
        self._names = names or (self._path or "memory", str(getattr(universe, "filename", None) or "topology"))
        if self._path and Path(self._path).is_file():
            self._precision = precision_of(self._path, self._format, precision)
        else:
            self._precision = FilePrecision(self._format or "MEMORY", precision or 0.0)
        if getattr(reader, "transformations", ()):
            # What a transformation did to the coordinates no longer lies on the grid of the file.
            self._precision = FilePrecision(self._format, self._precision.step, self._precision.unit)
            self.remarks.append("the trajectory has transformations; deviations are those of transformed coordinates")
        self._by_frame = None
        if self._precision.exact and precision is None:
            self._by_frame = by_frame(self._path, reader._xdr.offsets, self._precision)
        self._pass_of_means = False
        self._intact = reader.n_frames

    @classmethod
    def get_supported_backends(cls) -> tuple[str, ...]:
        return ("serial", "multiprocessing", "dask")

    # -- running --------------------------------------------------------------------------------

    def run(
        self,
        start: int | None = None,
        stop: int | None = None,
        step: int | None = None,
        frames: Any = None,
        **options: Any,
    ) -> ConstraintCheck:
        """Read the frames, by default all of them; arguments are those of MDAnalysis.

        Raises
        ------
        InputError
            There are no frames; threads where the file cannot be read by them.
        UnreadableError
            The first frame cannot be read.
        KconsError
            Constraints that cannot be, at the first frame.
        """
        chosen = {"start": start, "stop": stop, "step": step, "frames": frames}
        # Whether frames that were cut off would have been looked at.
        n_frames = self._trajectory.n_frames
        self._to_the_end = (
            Path(self._path).is_file() and chosen["frames"] is None and _open_ended(start, stop, step, n_frames)
        )
        self._bind(self._first(chosen))
        in_blocks = self._blocks_of() is not None
        # The compiled look at a block sees damage by itself.
        self._intact = n_frames
        if not in_blocks:
            self._intact = intact_frames(self._path, self._format, n_frames, self._trajectory.n_atoms)
        options = with_backend(options, in_blocks)
        self._pass_of_means = self._mode == "mean"
        with inherited(self, options["backend"]):
            if self._pass_of_means:
                super().run(**chosen, **options)
                self._hold_means()
                self._pass_of_means = False
            super().run(**chosen, **options)
        return self

    def __reduce_ex__(self, protocol: Any) -> Any:
        return short_pickle(self) or super().__reduce_ex__(protocol)

    def _first(self, chosen: dict[str, Any]) -> int:
        if chosen["frames"] is None:
            numbers = range(*self._trajectory.check_slice_indices(chosen["start"], chosen["stop"], chosen["step"]))
            first = numbers[0] if len(numbers) else None
        else:
            asked = np.asarray(chosen["frames"])
            asked = np.flatnonzero(asked) if asked.dtype == bool else asked
            first = int(asked[0]) if len(asked) else None
        if first is None:
            raise InputError(
                f"{self._names[0]}: no frames are left by start, stop and step; it has {self._trajectory.n_frames}",
                item="frames",
            )
        return first

    def _bind(self, frame: int) -> None:
        """Rows and their targets at one frame."""
        try:
            with quiet():
                ts = self._trajectory[frame]
                time = float(ts.time)
        except READ_ERRORS as error:
            raise self._nothing(frame, str(error)) from None
        precision = self._precision_at(frame)
        x = coordinate_grid(ts.positions, precision.grid)
        given = self._given
        if self._mode != "given":
            given = tuple(item if item.moving or not item.holonomic else item.with_target(None) for item in given)
        masses = self._unit_masses if self._masses is None else self._masses
        # Rows whose targets are those of this frame, or of the mean of all.
        self._measured = np.concatenate([np.full(item.n_rows, item.target is None) for item in given])
        self._refuse_numbers(ts, frame, given)
        cell = cell_matrix(ts.dimensions)
        held = ConstraintSet(given, x, masses, cell=cell, time=time)
        table = self._table = RowTable(held, precision)
        with np.errstate(all="ignore"):
            slopes = abs(held.jacobian(x, time))
            reach, squares = (np.asarray(part.sum(axis=1)).ravel() for part in (slopes, slopes.power(2)))
        is_length = np.concatenate([np.full(c.n_rows, c.family == "Distance") for c in held.constraints])
        # An error of 1 of each coordinate: the error of a row, at most and in the mean square.
        self._reach = np.where(is_length, 2 * np.sqrt(3.0), SECOND_ORDER * reach)
        self._spread = np.sqrt(squares / 3.0)
        measured, told = (
            table.errors_of(errors, x, ts.dimensions, time) for errors in (precision.half_step(x), self._target_error)
        )
        self._allow(np.where(self._measured, measured, told))
        shot = frame_of(ts, time, plain_dcd(self._trajectory) is not None)
        first_use = partial(compiled_elsewhere, lambda: sample_of(held, shot, precision, self._wants_rank))
        self._rank: int | None = None
        if self._wants_rank:
            try:
                self._rank = first_use(lambda: rank_of(held, x))
            except KconsError as error:
                self.remarks.append(f"no rank: {error}")
        first_use(lambda: look_once(table, shot))

    def _precision_at(self, frame: int) -> FilePrecision:
        return self._precision if self._by_frame is None else self._by_frame[frame]

    def _allow(self, of_targets: FloatArray) -> None:
        """Say what rounding makes of the targets, at most; the tolerance and the rounding of frames come besides."""
        self._of_targets = of_targets
        self._table.allow(of_targets + self._tolerance * self._table.sizes)

    def _nothing(self, frame: int, reason: str) -> UnreadableError:
        """Of a trajectory of which nothing can be told."""
        return UnreadableError(
            f"{self._names[0]}: frame {frame}, the first to be checked, cannot be read ({reason}); start at another "
            "frame, or write the file again",
            item="trajectory",
        )

    def _refuse_numbers(self, ts: Any, frame: int, given: Sequence[Constraint]) -> None:
        """A frame that gives targets, or scales, must be finite."""
        used = np.unique(np.concatenate([item.atoms.ravel() for item in given]))
        bad = used[~np.isfinite(ts.positions[used]).all(axis=1)]
        if len(bad):
            raise self._nothing(frame, f"position of atom {bad[0]} is {ts.positions[bad[0]]}")
        if ts.dimensions is not None and not np.isfinite(ts.dimensions).all():
            raise self._nothing(frame, f"the cell is {ts.dimensions}")

    def _hold_means(self) -> None:
        """Take the means that the first pass found as targets."""
        part: Part = self.results.part
        held, found = self._table.set, part.found
        means = found.mean(found.total)
        moved = [
            item if item.moving or not item.holonomic else item.with_target(item.target_at(0.0) + means[a:b])
            for item, a, b in zip(held.constraints, held.starts[:-1], held.starts[1:], strict=True)
        ]
        first, precision = self._trajectory.ts, self._table.precision
        positions = coordinate_grid(first.positions, precision.grid)
        self._table = RowTable(held.replaced(moved, positions, float(first.time)), precision)
        seen = self._measured & (found.counted > 0)
        self._allow(np.where(seen, found.mean(found.rounded), self._of_targets))

    def _prepare_sliced_trajectory(self, slicer: Any) -> None:
        with quiet():
            super()._prepare_sliced_trajectory(slicer)

    def _compute(
        self, indexed_frames: NDArray[np.int64], verbose: bool | None = None, *, progressbar_kwargs: Any = None
    ) -> Any:
        """Read one worker's frames, in order and without seeking where they follow each other; stop at a break."""
        numbers = indexed_frames[:, 1]
        n = len(numbers)
        found = Deviations(self._table.set.n_rows, n)
        part = Part(
            np.array(numbers, dtype=np.int64),
            np.zeros(n),
            found,
            np.full(n, np.nan),
            np.zeros((n, 3)),
            np.full(n, np.nan),
        )
        # Means need all frames; what is only told about rows does not.
        every = (1 if self._pass_of_means else min(max(n // SUMMED, 1), MOST_SKIPPED), max(n // SAMPLES, 1))
        table = self._table.fresh()
        file = self._blocks_of()
        verbose = getattr(self, "_verbose", False) if verbose is None else verbose
        with ProgressBar(total=n, verbose=verbose, **(progressbar_kwargs or {})) as bar:
            if file is not None:
                done = self._read_blocks(file, table, part, every, bar)
            else:
                with quiet():
                    done = self._read_frames(table, part, every, bar)
        table.collect(found)
        found.cut(done)
        part.frames, part.times = part.frames[:done], part.times[:done]
        part.twice_kinetic, part.momentum, part.reach = (
            array[:done] for array in (part.twice_kinetic, part.momentum, part.reach)
        )
        return _Remote(part)

    def _blocks_of(self) -> PlainDcd | None:
        """The file, where it can be read in blocks."""
        return plain_dcd(self._trajectory) if self._table.only_lengths else None

    def _read_blocks(self, file: PlainDcd, table: RowTable, part: Part, every: tuple[int, int], bar: Any) -> int:
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
            part.broken = self._break(error, int(part.frames[done]))
        return done

    def _read_frames(self, table: RowTable, part: Part, every: tuple[int, int], bar: Any) -> int:
        """Frames that MDAnalysis' reader gave, up to a break."""
        trajectory = self._trajectory
        n = len(part.frames)
        previous = None
        for k, frame in enumerate(part.frames.tolist()):
            try:
                if frame >= self._intact:
                    raise OSError("its records or lines are damaged")
                ts = trajectory.next() if previous is not None and frame == previous + 1 else trajectory[frame]
                previous = frame
                table.precision = self._precision_at(frame)
                self._look(table, part, k, ts, k % every[1] == 0 or k == n - 1, k % every[0] == 0)
            except (*READ_ERRORS, KconsError, FloatingPointError) as error:
                part.broken = self._break(error, frame)
                return k
            bar.update()
        return n

    def _break(self, error: BaseException, frame: int) -> Break:
        """What the reader says; iteration hides it."""
        if isinstance(error, StopIteration):
            try:
                self._trajectory[frame]
            except READ_ERRORS as hidden:
                error = hidden
        lines = str(error).strip().splitlines()
        return Break(frame, lines[0].strip() if lines else "the file ends", not isinstance(error, NonFiniteError))

    def _look(self, table: RowTable, part: Part, k: int, ts: Any, sample: bool, summed: bool) -> None:
        x = _flat(ts.positions)
        v = _flat(ts.velocities) if ts.has_velocities else None
        time = float(ts.time)
        part.times[k] = time
        table.look(part.found, k, x, v, ts.dimensions, time, summed)
        if sample:
            part.reach[k] = size_of(farthest(x))
        if v is not None and self._masses is not None:
            part.twice_kinetic[k], *part.momentum[k] = kinetic(v, self._masses)

    def _get_aggregator(self) -> ResultsGroup:
        return ResultsGroup(lookup={"part": joined})

    # -- conclusions ----------------------------------------------------------------------------

    def _conclude(self) -> None:
        part: Part = self.results.part
        self.frames, self.times = part.frames, part.times
        if self._pass_of_means:
            return
        if not len(part.frames):
            assert part.broken is not None
            raise self._nothing(part.broken.frame, part.broken.reason)
        self.results.check = self._concluded(part)

    @property
    def check(self) -> CheckResult:
        """What was found."""
        result: CheckResult = self.results.check
        return result

    def _concluded(self, part: Part) -> CheckResult:
        found, n_frames = part.found, len(part.frames)
        table, held = self._table, self._table.set
        if part.broken is None and self._to_the_end:
            n = self._trajectory.n_frames
            atoms, last = self._trajectory.n_atoms, last_offset(self._trajectory)
            part.broken = leftover(self._path, self._format, n, atoms, last)
            try:
                with quiet():
                    self._trajectory[n - 1]
            except READ_ERRORS as error:
                part.broken = part.broken or self._break(error, n - 1)
        violated = found.margins > 0
        beyond_file = found.margins + self._tolerance * table.sizes > 0
        # Targets that are nothing but rounding.
        untold = self._measured & (self._of_targets > table.sizes)
        gaps = gaps_of(part, int(self._measured.sum()), int(untold.sum()), self.target_text)
        # The rounding of a mean averages out.
        of_targets = self._of_targets if self._mode != "mean" else np.where(self._measured, 0.0, self._of_targets)
        rounding = (
            self._spread
            / np.maximum(self._reach, np.finfo(float).tiny)
            * np.hypot(found.mean(found.rounded), of_targets)
        )
        units = by_unit(table, part, np.where(untold, 0.0, self._of_targets), rounding, self._tolerance)
        order = np.lexsort((-np.where(violated, found.margins, found.largest), ~violated))
        worst = [row_result(table, self._labels, int(row), part) for row in order[: max(self._n_worst, 1)]]
        in_frame = (found.excess > 0).any(axis=0)
        frames = part.frames[in_frame]
        status = "tolerated" if beyond_file.any() else "kept"
        status = "violated" if violated.any() else "incomplete" if gaps else status
        masses = self._unit_masses if self._masses is None else self._masses
        freedom, temperature = None, None
        if self._rank is not None:
            freedom, temperature, remarks = temperature_of(part, self._rank, masses, self._removed)
            self.remarks.extend(remarks)
        series = {
            f"{name} {UNITS[unit]}": values[unit].tolist()
            for unit in range(len(UNITS))
            if (self._table.units == unit).any()
            for name, values in (
                ("largest", found.worst),
                ("rms", rms_of(found)),
                ("rounding", found.rounding),
            )
        }
        if temperature is not None:
            assert freedom is not None
            series["temperature K"] = (part.twice_kinetic / (BOLTZMANN * freedom)).tolist()
        return CheckResult(
            trajectory=self._names[0],
            topology=self._names[1],
            n_atoms=held.n_atoms,
            n_rows=held.n_rows,
            n_constrained=len(held.touched),
            status=status,
            verdict=verdict_of(
                status, self._tolerance, worst[0], units, (int(violated.sum()), held.n_rows), frames, n_frames, gaps
            ),
            precision=described([self._precision_at(frame) for frame in part.frames.tolist()], part.reach),
            tolerance=self._tolerance,
            targets=self.target_text,
            frames=part.frames.tolist(),
            times=part.times.tolist(),
            n_frames_in_file=int(self._trajectory.n_frames),
            units=units,
            worst=worst[: self._n_worst],
            violated_rows=int(violated.sum()),
            violated_frames=int(in_frame.sum()),
            first_violated_frame=int(frames[0]) if len(frames) else None,
            rank=self._rank,
            degrees_of_freedom=freedom,
            temperature=temperature,
            broken=part.broken,
            series=series,
            gaps=gaps,
            remarks=list(self.remarks),
        )


def _open_ended(start: int | None, stop: int | None, step: int | None, n_frames: int) -> bool:
    """Whether a slice means the end of a trajectory, wherever it is."""
    if step is not None and step < 0:
        start, stop = stop, start
    return stop is None or stop < 0 or stop > n_frames or (start or 0) < 0


def _flat(values: Any) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32).reshape(-1)
