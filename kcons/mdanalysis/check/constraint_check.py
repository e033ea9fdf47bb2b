"""How well a trajectory, of whatever MD engine, kept its constraints: from Python, and from files in one call."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from MDAnalysis.analysis.base import AnalysisBase
from MDAnalysis.analysis.results import Results, ResultsGroup
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.coordinates.timestep import Timestep
from MDAnalysis.lib.log import ProgressBar
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.arguments import not_negative, whole_number
from kcons.constraints.constraint import constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, NonFiniteError, UnreadableError
from kcons.mdanalysis.check.deviations import Found, Frames, RowTable
from kcons.mdanalysis.check.endings import DAMAGED, Break, broken_by, damage, dcd_head, ending, first_break
from kcons.mdanalysis.check.precision import FilePrecision, by_frame, described, grid_of, precision_of_reader
from kcons.mdanalysis.check.result import Asked, CheckResult, result_of
from kcons.mdanalysis.check.targets import label, read_targets, with_targets
from kcons.mdanalysis.loading import READ_ERRORS, format_of, load_trajectory, open_universe, quiet
from kcons.mdanalysis.topology import constraints_of, host_of, require_angstrom, topology_of, velocities_known
from kcons.motion.motion import Motion
from kcons.topology.rows_by_name import HeldRows, Options
from kcons.topology.topology import Topology

#: Frames, and atoms in each, that a grid of coordinates is looked for in.
GRID_FRAMES, GRID_ATOMS = 5, 1000
#: Where targets come from, in words.
_MODES = {"given": "as given", "first": "the first frame", "mean": "the mean of the frames"}
#: Positions, of all frames together, up to which one process is quickest: of files that need no unpacking, of others.
ALONE = {"DCD": 5_000_000, "": 500_000}
#: Bytes of a file that are looked at together.
AT_ONCE = 2**20


class ConstraintCheck(AnalysisBase):  # type: ignore[misc]
    """Deviations of all constraints along a trajectory, judged by the precision of its file.

    Parameters
    ----------
    atoms : MDAnalysis.Universe or AtomGroup
        With the trajectory; of a group, its Universe.
    constraints : Constraint, iterable of Constraint, or ConstraintSet
        What should be held, in angstrom, on the atoms of the Universe.
    targets : {'given', 'first', 'mean'} or path
        Where the lengths come from. 'given': what the constraints say, and the first frame for those that do not
        say. 'first': the first frame looked at. 'mean': the mean over the frames, which are read twice. A path: a
        parameter file, see `kcons.mdanalysis.check.targets`.
    tolerance : float
        Relative violation that counts as the engine's tolerance and not as a violation, in parts of the length (of
        1 rad for angles).
    precision : float, optional
        Step of the coordinates in the file, in angstrom, for formats where it cannot be known.
    rank : bool
        Whether to find the rank, which takes longer than the frames of a short trajectory.
    worst : int
        Number of rows to name.

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

    Backends are those of MDAnalysis, serial, multiprocessing and dask: `run(backend=..., n_workers=...)`.
    """

    _analysis_algorithm_is_parallelizable = True

    def __init__(
        self,
        atoms: Any,
        constraints: Constraint | Iterable[Constraint] | ConstraintSet,
        *,
        targets: Literal["given", "first", "mean"] | str | Path = "given",
        tolerance: float = 1e-4,
        precision: float | None = None,
        rank: bool = True,
        worst: int = 10,
        verbose: bool = False,
    ) -> None:
        universe = atoms.universe
        n_atoms = len(universe.atoms)
        require_angstrom(universe.trajectory)
        super().__init__(universe.trajectory, verbose=verbose)
        if isinstance(constraints, HeldRows):
            constraints.require_atoms(n_atoms, universe.atoms.indices, host_of(universe))
        held = constraints.constraints if isinstance(constraints, ConstraintSet) else constraints
        given = tuple(constraints_in(held, "constraints"))
        if not sum(item.n_rows for item in given):
            remedy = "select others, or look at the bonds of the topology"
            raise InputError(f"there are no constraints to check; {remedy}", item="constraints")
        topology = topology_of(universe)
        self._used = np.unique(np.concatenate([item.atoms.ravel() for item in given]))
        self._masses, reason = _masses(universe, topology, given, self._used)
        mode, text = str(targets), _MODES.get(str(targets), "")
        if not text:
            given, mode, text = tuple(with_targets(targets, given, topology)), "given", str(targets)
        elif mode != "given":
            given = tuple(item if item.moving or not item.holonomic else item.with_target(None) for item in given)
        reader = self._trajectory
        self._path = str(getattr(reader, "filename", None) or "")
        names = self._path or "memory", str(getattr(universe, "filename", None) or "topology")
        remarks = [*filter(None, [reason]), *_remarks_on(reader, self._masses)]
        self.asked = Asked(names, topology, mode, text, whole_number(worst, "worst"), remarks)
        self._given, self._tolerance, self._wants_rank = given, not_negative(tolerance, "tolerance"), rank
        #: Rounding of given targets that were measured in another file, in angstrom a coordinate, by atom.
        self.target_error: FloatArray = np.zeros(n_atoms)
        usual = precision_of_reader(reader, precision)
        self._may_be_on_grid = precision is None and not (usual.step or usual.digits)
        #: Of each frame.
        self._precision = [usual] * reader.n_frames
        if usual.exact and precision is None:
            self._precision = by_frame(self._path, reader._xdr.offsets, usual)

    @classmethod
    def get_supported_backends(cls) -> tuple[str, ...]:
        return ("serial", "multiprocessing", "dask")

    # -- running --------------------------------------------------------------------------------

    @quiet()
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
            There are no such frames.
        UnreadableError
            The first frame cannot be read.
        KconsError
            Constraints that cannot be, at the first frame.
        """
        part = slice(start, stop, step)
        numbers = self._numbers(part if frames is None else np.asarray(frames))
        chosen = {"start": start, "stop": stop, "step": step, "frames": None if frames is None else numbers}
        remarks = self._look_for_grid(numbers) if self._may_be_on_grid else []
        remarks += self._bind(int(numbers[0]))
        damaged = None if _lies_plainly(self._trajectory) else first_break(self._trajectory, damage)
        self._compute = partial(_look_at, self._trajectory, self._rows, damaged, self._precision)
        super().run(**chosen, **options)
        if self.asked.mode == "mean":
            self._rows.take_means(self.results.found)
            super().run(**chosen, **options)
        found: Found = self.results.found
        if not len(found.frames):
            raise self._nothing(found.broken)
        # Whether frames that were cut off would have been looked at.
        more = frames is None and range(sys.maxsize)[part] != range(self._trajectory.n_frames)[part]
        if found.broken is None and Path(self._path).is_file() and more:
            found.broken = damaged or first_break(self._trajectory, ending)
        text = described([self._precision[frame] for frame in self.frames.tolist()], self._largest)
        asked = replace(self.asked, remarks=self.asked.remarks + remarks)
        self.results.check = result_of(found, self._rows, asked, text, self._rank, int(self._trajectory.n_frames))
        return self

    def _numbers(self, part: slice | NDArray[Any]) -> list[int]:
        """Frames to look at, at least one, counted from the beginning."""
        count, name = self._trajectory.n_frames, self.asked.names[0]
        try:
            numbers: list[int] = np.arange(count)[part].tolist()
        except (IndexError, ValueError, TypeError) as error:
            remedy = f"give start, stop and step, or frames: whole numbers, or {count} times True or False"
            raise InputError(
                f"{name}: its {count} frames have no {part!r:.60} ({error}); {remedy}", item="frames"
            ) from None
        if not numbers:
            raise InputError(f"{name}: no frames are left by start, stop and step; it has {count}", item="frames")
        return numbers

    def _look_for_grid(self, numbers: Sequence[int]) -> list[str]:
        """Take the grid that coordinates lie on, in frames from first to last, for the precision; what to say of it."""
        used = self._used[:: -(-len(self._used) // GRID_ATOMS)]
        seen = []
        for k in np.unique(np.linspace(0, len(numbers) - 1, GRID_FRAMES).astype(int)).tolist():
            # A frame that cannot be read, or has no numbers, is told of where it is looked at.
            with suppress(*READ_ERRORS):
                seen.append(np.array(self._trajectory[numbers[k]].positions[used]))
        step = grid_of(seen) if seen and np.isfinite(seen).all() else 0.0
        self._precision = [replace(self._precision[0], step=step)] * len(self._precision)
        said = f"coordinates lie on a grid of {step:g} Å, as after a conversion from XTC or text: that is taken for"
        return [f"{said} their precision, unless one is given"] if step else []

    def _bind(self, frame: int) -> list[str]:
        """Rows and their targets at one frame, which must be finite; what to say of their rank."""
        try:
            ts = self._trajectory[frame]
            bad = self._used[~np.isfinite(ts.positions[self._used]).all(axis=1)]
            if len(bad):
                raise NonFiniteError(f"position of atom {bad[0]} is {ts.positions[bad[0]]}")
            if ts.dimensions is not None and not np.isfinite(ts.dimensions).all():
                raise NonFiniteError(f"the cell is {ts.dimensions}")
        except (*READ_ERRORS, NonFiniteError) as error:
            raise self._nothing(Break(frame, str(error))) from None
        self._largest = float(np.abs(ts.positions[self._used]).max())
        precision = self._precision[frame]
        self._rows = RowTable(self._given, self._masses, ts, precision, self.target_error, self._tolerance)
        self._rank: int | None = None
        try:
            if self._wants_rank:
                self._rank = Motion(self._rows.set, precision.stored(ts.positions)).rank
        except KconsError as error:
            return [f"no rank: {error}"]
        return []

    def _nothing(self, broken: Any) -> UnreadableError:
        """Of a trajectory of which nothing can be told."""
        said = f"{self.asked.names[0]}: frame {broken.frame}, the first to be checked, cannot be read ({broken.reason})"
        return UnreadableError(f"{said}; start at another frame, or write the file again", item="trajectory")

    def _get_aggregator(self) -> ResultsGroup:
        return ResultsGroup(lookup={"found": Found.joined})

    @property
    def check(self) -> CheckResult:
        """What was found, after `run`."""
        if "check" not in self.results:
            raise InputError("nothing was looked at yet; call run() first", item="check")
        return self.results.check  # type: ignore[no-any-return]


def _lies_plainly(reader: Any) -> bool:
    """Whether a file is DCD with all atoms in each frame, in angstrom."""
    if not isinstance(reader, DCDReader) or reader.transformations:
        return False
    file = reader._file
    sizes = {file._firstframesize, file._framesize, 56 * file.is_periodic + 12 * reader.n_atoms + 24}
    return len(sizes) == 1 and not (reader.convert_units and reader.units["length"] != "Angstrom")


def _lying(reader: Any, numbers: NDArray[np.int64], rows: RowTable) -> Iterator[Frames]:
    """Frames of DCD as they lie in the file: its reader takes longer than all else."""
    file, n, known, cell = reader._file, reader.n_atoms, b"", reader.ts._unitcell.tobytes()
    at_once = 1 if rows.others is not None else max(AT_ONCE // file._framesize, 1)
    words = np.empty((at_once, file._framesize // 4), dcd_head(reader.filename).dtype)
    begin = file.header["istart"] / file.header["nsavc"]
    cells, planes = words[:, : -3 * (n + 2)], words[:, -3 * (n + 2) :].reshape(-1, 3, n + 2)
    with open(reader.filename, "rb", buffering=0) as opened:
        for some in np.split(numbers, range(at_once, len(numbers), at_once)):
            words[:, -1] = 0  # where less than a frame can be read
            for row, number in zip(words, some.tolist(), strict=False):
                opened.seek(file._header_size + number * file._framesize)
                opened.readinto(row)
            # Records are framed by their lengths.
            whole = (planes[:, :, :: n + 1] == 4 * n).all(axis=(1, 2)) & (cells[:, ::13] == 48).all(axis=1)
            end = int(np.argmin([*whole[: len(some)], False]))
            dimensions = []
            for raw in map(bytes, cells[:end]):
                if raw != known:
                    stored = np.frombuffer(raw, np.dtype("f8").newbyteorder(words.dtype.byteorder), 6, 4)
                    frame = SimpleNamespace(xyz=np.zeros((1, 3), np.float32), unitcell=stored.astype(np.float64))
                    known, cell = raw, reader._frame_to_ts(frame, Timestep(1))._unitcell.tobytes()
                dimensions.append(cell)
            times = (some[:end] + begin) * reader.ts.dt + reader.ts.data.get("time_offset", 0)
            if end:
                yield Frames(words[:end].astype(np.int32, copy=False), dimensions, times)
            if end < len(some):
                raise OSError(DAMAGED)
    _ = reader[numbers[-1]]


def _read(reader: Any, numbers: NDArray[np.int64], damaged: Break | None) -> Iterator[Frames]:
    """Frames as a reader gives them, up to one that is damaged."""
    words, previous = np.empty((1, 3 * (reader.n_atoms + 2)), np.int32), -1
    x = words.view(np.float32).reshape(3, -1)[:, 1:-1]
    for number in numbers.tolist():
        if damaged is not None and number >= damaged.frame:
            return
        # Seeking reads compressed files from their beginning.
        ts = reader.next() if 0 <= previous == number - 1 else reader[number]
        previous = number
        x[:] = ts.positions.T
        v = ts.velocities if ts.has_velocities and velocities_known(reader) else None
        yield Frames(words, [ts._unitcell.tobytes()], np.array([ts.time]), v)


def _look_at(
    trajectory: Any, rows: RowTable, damaged: Break | None, precision: Sequence[FilePrecision], part: Any, **shown: Any
) -> Any:
    """Look at frames, in order, up to the first that cannot be used: the work of one process.

    MDAnalysis' own loop takes the analysis, and ends in errors. `damaged`: in files that are not read as they lie
    there. `precision`: of each frame. `part`, `shown`: as for that loop.
    """
    numbers, options = part[:, 1], {"verbose": bool(shown["verbose"]), **(shown["progressbar_kwargs"] or {})}
    given = _lying(trajectory, numbers, rows) if _lies_plainly(trajectory) else _read(trajectory, numbers, damaged)
    found = Found.nothing(numbers)
    rows.begin()
    with quiet(), ProgressBar(total=len(numbers), **options) as bar:
        try:
            for frames in given:
                rows.look(found, frames, precision[numbers[found.looked]])
                bar.update(len(frames.words))
        except (*READ_ERRORS, KconsError) as error:
            found.broken = broken_by(error, trajectory, int(numbers[min(found.looked, len(numbers) - 1)]))
    if found.looked < len(numbers):
        found.broken = found.broken or damaged
    rows.end(found)
    return SimpleNamespace(frames=found.frames["frame"], times=found.frames["time"], results=Results(found=found))


def _masses(
    universe: Any, topology: Topology, given: Sequence[Constraint], used: NDArray[np.int64]
) -> tuple[FloatArray | None, str]:
    """Masses, or None where they cannot be used; and what to say of them."""
    masses = topology.masses
    if used[-1] >= len(masses):
        said = f"there is no atom {used[-1]}; the topology has atoms 0 to {len(masses) - 1}"
        raise InputError(said, item="constraints", atoms=[int(used[-1])])
    bad = used[~(np.isfinite(masses[used]) & (masses[used] > 0))]
    remedy = "give a topology with masses, such as PSF, PRMTOP or TPR"
    if not len(bad):
        own = [a for a in universe._topology.attrs if a.attrname == "masses" and not a.is_guessed]
        said = f"masses are those of the elements: temperatures are wrong if the run had others (heavy H); {remedy}"
        return masses, said if universe.trajectory.ts.has_velocities and not own else ""
    reason = f"{label(topology, bad[:1].tolist())} has mass {masses[bad[0]]:g}; {remedy}"
    if not hasattr(universe.atoms, "masses"):
        reason = f"the topology has no masses; {remedy}"
    needing = next((item for item in given if item.uses_masses), None)
    if needing is not None:
        raise InputError(f"{needing!r} needs masses, but {reason}", item="masses")
    return None, f"no temperature: {reason}"


def _remarks_on(reader: Any, masses: FloatArray | None) -> list[str]:
    """What a reader of MDAnalysis does not know, or was told to do; atoms that have masses and do not move."""
    remarks, name = [], format_of(reader)
    if masses is not None and reader.ts.has_velocities:
        still = int(np.count_nonzero(masses[~reader.ts.velocities.any(axis=1)]))
        if 0 < still < np.count_nonzero(masses):
            remarks.append(f"{still} atoms have no velocity: if the run fixed them, the temperature is too low")
        if light := int(np.count_nonzero((masses > 0) & (masses < 0.9))):
            said = "are lighter than hydrogen: if they are Drude particles, which are cold, the temperature is too low"
            remarks.append(f"{light} atoms {said}")
    if getattr(reader, "transformations", ()):
        remarks.append("the trajectory has transformations; deviations are those of transformed coordinates")
    if reader.ts.has_velocities and not velocities_known(reader):
        remarks.append(f"no temperature: velocities of {name} files have no unit")
    # Dumps of LAMMPS have numbers of steps.
    timed = name in ("MEMORY", "CHAIN") or hasattr(reader, "_get_dt") or "dt" in getattr(reader, "_ts_kwargs", {})
    if not timed and (name == "LAMMPSDUMP" or "time" not in reader.ts.data) and reader.n_frames > 1:
        apart = "steps" if name == "LAMMPSDUMP" else "frames"
        remarks.append(f"{name} files have no times: {apart} are taken to be 1 ps apart, in drifts too")
    # The defaults of MDAnalysis, and of VMD and MDTraj: 1 ps and the unit of time of the format.
    if name == "DCD" and reader.skip_timestep == 1 and round(reader.dt, 4) in (1.0, 0.0489) and reader.n_frames > 1:
        remarks.append(f"DCD says frames are {reader.dt:.3g} ps apart, as files do by default: drifts may be wrong")
    return remarks


# -- files ------------------------------------------------------------------------------------------


def check_trajectory(
    trajectory: str | Path,
    topology: str | Path,
    constrain: str | None = "hbonds",
    *,
    targets: str | Path = "first",
    frames: str | None = None,
    format: str | None = None,
    topology_format: str | None = None,
    workers: int = 1,
    **options: Any,
) -> CheckResult:
    """How well a trajectory kept its constraints.

    Parameters
    ----------
    trajectory, topology : path
        Files that MDAnalysis reads.
    constrain
        What is held; see `kcons.mdanalysis.constraints_of`.
    targets : {'first', 'mean', 'topology'} or path
        'topology': the coordinates in the topology's file; else as for `ConstraintCheck`.
    frames : str, optional
        'A:B:STEP' as in a slice; all by default.
    format, topology_format : str, optional
        Formats of the files, as MDAnalysis names them; by default what their names tell.
    workers : int
        How many processes read at the same time, unless one is done before others would have started.
    **options
        What is held besides, such as select, rigid_water and rigid_residues, for `kcons.mdanalysis.constraints_of`;
        all others for `ConstraintCheck`.

    Raises
    ------
    InputError
        Files that cannot be read, selections that match nothing, unknown names, atom counts that differ.
    UnreadableError
        A trajectory of which nothing can be told: cut off, or not finite, in its first frame.
    """
    try:
        numbers = [int(word) if word.strip() else None for word in (":" if frames is None else str(frames)).split(":")]
    except ValueError:
        numbers = []
    if not 2 <= len(numbers) <= 3 or (numbers[2:] and numbers[2] is not None and numbers[2] < 1):
        raise InputError(f"frames are {frames!r}; give them as A:B or A:B:STEP, such as 100::10", item="frames")
    chosen: dict[str, Any] = dict(zip(("start", "stop", "step"), numbers, strict=False))
    whole_number(workers, "workers", 1)
    if str(targets) not in ("topology", "first", "mean"):
        read_targets(targets)  # complain of it before anything long
    of_topology, errors = str(targets) == "topology", None
    universe = open_universe(topology, topology_format=topology_format)
    if of_topology:
        if not hasattr(universe, "trajectory"):
            said = f"{topology} has no coordinates to take lengths from; give --targets first, mean, or a TOML file"
            raise InputError(said, item="targets")
        with quiet():
            errors = precision_of_reader(universe.trajectory).half_step(universe.atoms.positions)
    else:
        load_trajectory(universe, trajectory, topology, format=format)
        # Bonds are looked for in the first frame that is looked at; one that is not there is for the check to refuse.
        with quiet(), suppress(*READ_ERRORS):
            _ = universe.trajectory[chosen.get("start") or 0]
    given = {name: options.pop(name) for name in Options.__annotations__ if name in options}
    held = _held(universe, constrain, given)
    if of_topology:
        load_trajectory(universe, trajectory, topology, format=format)
    check = ConstraintCheck(universe, held, targets="given" if of_topology else targets, **options)
    check.asked.names = str(trajectory), str(topology)
    if errors is not None:
        check.asked.targets, check.target_error = f"coordinates of {topology}", errors
    check.asked.part = str(given.get("select", "all")) != "all"
    if guessed := held.bonds_guessed:
        check.asked.remarks.append(
            f"{guessed} bonds were guessed from distances and covalent radii: {topology} does not have them; give a "
            "topology with bonds, such as PSF, PRMTOP or TPR"
        )
    if len(loose := held.loose_hydrogens):
        check.asked.gaps.append(
            f"no bond was found for {len(loose)} hydrogens, the first of which is "
            f"{held.topology.atom_name(int(loose[0]))}, so that rows are missing; give files with the cell, at "
            "whose faces molecules may be cut, or a topology with bonds"
        )
    few = ALONE.get(format_of(universe.trajectory), ALONE[""])
    if workers > 1 and universe.trajectory.n_frames * len(universe.atoms) > few:
        chosen |= {"backend": "multiprocessing", "n_workers": workers}
    return check.run(**chosen).check


def _held(universe: Any, constrain: str | None, held: dict[str, Any]) -> HeldRows:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*bonds? (was|were) guessed", category=UserWarning)  # said above
        try:
            return constraints_of(universe, constrain, **held)
        except InputError as error:
            if error.item != "positions" or np.isfinite(universe.atoms.positions).all():
                raise
            reader = universe.trajectory
            raise UnreadableError(
                f"{reader.filename}: {error}, in frame {reader.frame}, the first to be looked at; begin at a later "
                "one (--frames A:), or write the file again",
                item="trajectory",
            ) from None
