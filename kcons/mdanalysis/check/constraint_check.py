"""How well a trajectory, of whatever engine, kept its constraints."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from MDAnalysis.analysis.base import AnalysisBase
from MDAnalysis.analysis.results import Results, ResultsGroup
from MDAnalysis.lib.log import ProgressBar
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.arguments import whole_number
from kcons.constraints.constraint import constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnreadableError
from kcons.mdanalysis.check.atom_names import AtomNames
from kcons.mdanalysis.check.bound_rows import BoundRows
from kcons.mdanalysis.check.compiling import compiled_elsewhere, frame_of, look_once, sample_of
from kcons.mdanalysis.check.conclusions import Asked, concluded
from kcons.mdanalysis.check.files.endings import damage_of, ending_of
from kcons.mdanalysis.check.files.file_precision import by_frame, grid_of, precision_of_reader
from kcons.mdanalysis.check.files.plain_dcd import plain_dcd
from kcons.mdanalysis.check.files.target_file import TargetFile
from kcons.mdanalysis.check.findings import (
    Part,
    joined,
)
from kcons.mdanalysis.check.rank_by_pieces import rank_of
from kcons.mdanalysis.check.reading import Reading, blocks_of, broken_by, remarks_on
from kcons.mdanalysis.check.result import Break, CheckResult
from kcons.mdanalysis.check.temperature import masses_of
from kcons.mdanalysis.check.workers import inherited, short_pickle, with_backend
from kcons.mdanalysis.loading import READ_ERRORS, quiet
from kcons.mdanalysis.topology import host_of, require_angstrom, velocities_known
from kcons.topology.rows_by_name import HeldRows

#: Frames, and atoms in each, that a grid of coordinates is looked for in.
GRID_FRAMES, GRID_ATOMS = 5, 1000


class _Remote:
    """What a worker sends back: no trajectory, no tables."""

    def __init__(self, part: Part) -> None:
        self.frames, self.times, self.results = part.frames, part.times, Results(part=part)


class ConstraintCheck(AnalysisBase):
    """Deviations of all constraints along a trajectory, judged by the precision of its file.

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
        No constraints; constraints on atoms that do not exist; rows that were made for a part; a bad option.

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
        require_angstrom(universe.trajectory)
        super().__init__(universe.trajectory, **options)
        if isinstance(constraints, HeldRows):
            constraints.require_atoms(len(universe.atoms), universe.atoms.indices, host_of(universe))
        if isinstance(constraints, ConstraintSet):
            given: tuple[Constraint, ...] = constraints.constraints
        else:
            given = tuple(constraints_in(constraints, "constraints"))
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
        if removed is not None:
            removed = whole_number(removed, "removed", 0)
        if worst < 0:
            raise InputError(f"worst is {worst}; give a number of rows to name", item="worst")
        labels = AtomNames(universe)
        remarks: list[str] = []
        self._unit_masses = np.ones(len(universe.atoms))
        self._masses, reason = masses_of(universe, given, labels)
        if reason:
            remarks.append(f"no temperature: {reason}")
        if targets not in ("given", "first", "mean"):
            file = targets if isinstance(targets, TargetFile) else TargetFile(targets)
            given, mode, text = tuple(file.apply(given, labels)), "given", str(file.path)
        else:
            mode = str(targets)
            text = {"first": "the first frame", "mean": "the mean of the frames"}.get(mode, "as given")
        self._given = given
        self._tolerance, self._target_error = float(tolerance), np.broadcast_to(errors, len(universe.atoms))
        self._wants_rank = rank
        reader = self._trajectory
        self._path = str(getattr(reader, "filename", None) or "")
        called = names or (self._path or "memory", str(getattr(universe, "filename", None) or "topology"))
        in_file = precision_of_reader(reader, precision)
        remarks += remarks_on(reader)
        of_frames = None
        if in_file.exact and precision is None:
            of_frames = by_frame(self._path, reader._xdr.offsets, in_file)
        self._may_be_on_grid = precision is None and not (in_file.step or in_file.digits)
        self._reading = Reading(in_file, of_frames, self._masses, velocities_known(reader))
        self.asked = Asked(called, labels, mode, text, removed, int(worst), remarks)
        self._pass_of_means = False

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
            There are no such frames; threads where the file cannot be read by them.
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
        frames_asked = self._numbers(chosen)
        if self._may_be_on_grid:
            self._look_for_grid(frames_asked)
        self._bind(int(frames_asked[0]))
        in_blocks = blocks_of(self._trajectory, self._rows.table) is not None
        # The compiled look at a block sees damage by itself.
        self._reading.damage = None if in_blocks else damage_of(self._trajectory)
        options = with_backend(options, in_blocks)
        self._pass_of_means = self.asked.mode == "mean"
        with inherited(self, options["backend"]):
            if self._pass_of_means:
                super().run(**chosen, **options)
                self._rows.hold_means(self.results.part, self._trajectory.ts)
                self._pass_of_means = False
            super().run(**chosen, **options)
        return self

    def __reduce_ex__(self, protocol: Any) -> Any:
        return short_pickle(self) or super().__reduce_ex__(protocol)

    def _numbers(self, chosen: dict[str, Any]) -> Sequence[int]:
        """Frames to look at, at least one."""
        numbers: Sequence[int]
        if chosen["frames"] is None:
            if chosen["step"] == 0:
                raise InputError("step is 0; give another whole number", item="step")
            numbers = range(*self._trajectory.check_slice_indices(chosen["start"], chosen["stop"], chosen["step"]))
        else:
            asked, count = np.asarray(chosen["frames"]), self._trajectory.n_frames
            if asked.dtype == bool and asked.shape == (count,):
                asked = np.flatnonzero(asked)
            if asked.ndim != 1 or (asked.size and not np.issubdtype(asked.dtype, np.integer)):
                raise InputError(
                    f"frames are {chosen['frames']!r:.60}; give whole numbers, or True and False for each of the "
                    f"{count} frames; for a slice start, stop and step",
                    item="frames",
                )
            for frame in asked[(asked < -count) | (asked >= count)]:
                raise InputError(f"{self.asked.names[0]}: there is no frame {frame}; it has {count}", item="frames")
            numbers = asked.tolist()
        if not len(numbers):
            raise InputError(
                f"{self.asked.names[0]}: no frames are left by start, stop and step; it has "
                f"{self._trajectory.n_frames}",
                item="frames",
            )
        return numbers

    def _look_for_grid(self, numbers: Sequence[int]) -> None:
        """Take the grid that coordinates lie on, in frames from first to last, for the precision of the file."""
        used = np.unique(np.concatenate([item.atoms.ravel() for item in self._given]))
        used = used[:: -(-len(used) // GRID_ATOMS)]
        seen = []
        for k in np.unique(np.linspace(0, len(numbers) - 1, GRID_FRAMES).astype(int)).tolist():
            # A frame that cannot be read, or has no numbers, is told of where it is looked at.
            with quiet(), suppress(*READ_ERRORS):
                seen.append(np.array(self._trajectory[numbers[k]].positions[used]))
        step = grid_of(seen) if seen and np.isfinite(seen).all() else 0.0
        self._reading.precision = replace(self._reading.precision, step=step)
        remark = (
            f"coordinates lie on a grid of {step:g} Å, as after a conversion from XTC or text: that is taken for their "
            "precision, unless one is given"
        )
        if step and remark not in self.asked.remarks:
            self.asked.remarks.append(remark)

    def _bind(self, frame: int) -> None:
        """Rows and their targets at one frame."""
        try:
            with quiet():
                ts = self._trajectory[frame]
                time = float(ts.time)
        except READ_ERRORS as error:
            raise self._nothing(frame, str(error)) from None
        given = self._given
        if self.asked.mode != "given":
            given = tuple(item if item.moving or not item.holonomic else item.with_target(None) for item in given)
        self._refuse_numbers(ts, frame, given)
        masses = self._unit_masses if self._masses is None else self._masses
        precision = self._reading.precision_at(frame)
        rows = self._rows = BoundRows(given, masses, ts, time, precision, self._target_error, self._tolerance)
        held = rows.table.set
        shot = frame_of(ts, time, plain_dcd(self._trajectory) is not None)
        first_use = partial(compiled_elsewhere, lambda: sample_of(held, shot, precision, self._wants_rank))
        self._rank: int | None = None
        if self._wants_rank:
            try:
                self._rank = first_use(lambda: rank_of(held, rows.positions))
            except KconsError as error:
                self.asked.remarks.append(f"no rank: {error}")
        first_use(lambda: look_once(rows.table, shot))

    def _nothing(self, frame: int, reason: str) -> UnreadableError:
        """Of a trajectory of which nothing can be told."""
        return UnreadableError(
            f"{self.asked.names[0]}: frame {frame}, the first to be checked, cannot be read ({reason}); start at "
            "another frame, or write the file again",
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

    def _prepare_sliced_trajectory(self, slicer: Any) -> None:
        with quiet():
            super()._prepare_sliced_trajectory(slicer)

    def _compute(
        self, indexed_frames: NDArray[np.int64], verbose: bool | None = None, *, progressbar_kwargs: Any = None
    ) -> Any:
        """Read one worker's frames, in order and without seeking where they follow each other; stop at a break."""
        verbose = getattr(self, "_verbose", False) if verbose is None else verbose
        with ProgressBar(total=len(indexed_frames), verbose=verbose, **(progressbar_kwargs or {})) as bar:
            table = self._rows.table.fresh()
            part = self._reading.read(self._trajectory, indexed_frames[:, 1], table, self._pass_of_means, bar)
        return _Remote(part)

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
        if part.broken is None and self._to_the_end:
            part.broken = self._end_of_file()
        masses = self._unit_masses if self._masses is None else self._masses
        n_in_file = int(self._trajectory.n_frames)
        self.results.check = concluded(part, self._rows, self.asked, self._reading, self._rank, masses, n_in_file)

    def _end_of_file(self) -> Break | None:
        """What lies behind the last frame, or keeps it from being read."""
        trajectory = self._trajectory
        n = trajectory.n_frames
        broken = self._reading.damage or ending_of(trajectory)
        try:
            with quiet():
                trajectory[n - 1]
        except READ_ERRORS as error:
            broken = broken or broken_by(error, trajectory, n - 1)
        return broken

    @property
    def remarks(self) -> list[str]:
        """What there is to say besides."""
        return self.asked.remarks

    @property
    def check(self) -> CheckResult:
        """What was found.

        Raises
        ------
        InputError
            Nothing was looked at yet.
        """
        if "check" not in self.results:
            raise InputError("nothing was looked at yet; call run() first", item="check")
        result: CheckResult = self.results.check
        return result


def _open_ended(start: int | None, stop: int | None, step: int | None, n_frames: int) -> bool:
    """Whether a slice means the end of a trajectory, wherever it is."""
    if step is not None and step < 0:
        start, stop = stop, start
    return stop is None or stop < 0 or stop > n_frames or (start or 0) < 0
