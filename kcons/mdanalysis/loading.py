"""Opening files through MDAnalysis, with errors that name the file, what is wrong with it and the remedy."""

from __future__ import annotations

import gc
import struct
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import MDAnalysis
from MDAnalysis.lib.util import guess_format

from kcons.errors import InputError, UnreadableError

#: What MDAnalysis and the readers below it raise on a bad file.
READ_ERRORS = (OSError, EOFError, ValueError, TypeError, RuntimeError, LookupError, StopIteration, struct.error)
#: The same where a file is opened: of formats whose package is missing, and of readers that are not MDAnalysis' own.
_OPEN_ERRORS = (*READ_ERRORS, ImportError, SyntaxError, AttributeError, NotImplementedError)

_HDF5 = b"\x89HDF\r\n"
#: How files begin, by the ending of their name.
_BEGINS = {
    ".dcd": (b"\x54\x00\x00\x00CORD", b"\x00\x00\x00\x54CORD"),
    ".xtc": (b"\x00\x00\x07\xcb", b"\x00\x00\x07\xe7"),
    ".trr": (b"\x00\x00\x07\xc9",),
    ".nc": (b"CDF", _HDF5),
    ".ncdf": (b"CDF", _HDF5),
    ".h5md": (_HDF5,),
    ".h5": (_HDF5,),
    ".gz": (b"\x1f\x8b",),
    ".bz2": (b"BZh",),
}


@contextmanager
def quiet() -> Iterator[None]:
    """Without MDAnalysis' warnings about files: what matters is checked and said here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def _failing_quietly() -> Iterator[list[str]]:
    """A reader that could not open its file also fails when it is deleted; once is enough.

    The list takes what failed. Only then is there such a reader, and it is looked for.
    """
    hook = sys.unraisablehook
    failures: list[str] = []
    sys.unraisablehook = lambda unraisable: None
    try:
        yield failures
    finally:
        if failures:
            gc.collect()
        sys.unraisablehook = hook


def open_universe(topology: str | Path, trajectory: str | Path | None = None, **options: Any) -> Any:
    """A Universe from files.

    Parameters
    ----------
    topology : path
        Any topology that MDAnalysis reads.
    trajectory : path, optional
        Any trajectory that MDAnalysis reads.
    **options
        For `MDAnalysis.Universe`.

    Raises
    ------
    InputError
        A file that is missing or unreadable; atom counts that differ.
    UnreadableError
        A trajectory that is empty, or begins as it should and cannot be read.
    """
    for path, what in ((topology, "topology"), (trajectory, "trajectory")):
        if path is not None:
            _look_at(Path(path), what)
    with quiet(), _failing_quietly() as failures:
        try:
            # Without a format, MDAnalysis asks every package it can convert from whether a path is an object of its
            # own, which imports OpenMM with all its platforms: 80 MB, 70 of them the compiler of an OpenCL platform.
            universe = MDAnalysis.Universe(str(topology), **{"topology_format": guess_format(str(topology))} | options)
        except _OPEN_ERRORS as error:
            failures.append(_first_line(error))
    if failures:
        raise InputError(
            f"{topology}: MDAnalysis cannot read this topology ({failures[0]}); give a file such as PSF, PRMTOP, TPR, "
            "GRO, PDB or mmCIF",
            item="topology",
        )
    if not (hasattr(universe.atoms, "names") or hasattr(universe.atoms, "types")):
        raise InputError(
            f"{topology} says nothing of its atoms, as trajectories do; give a topology such as PSF, PRMTOP, TPR, GRO, "
            "PDB or mmCIF, and the trajectory beside it (check_trajectory takes the trajectory first)",
            item="topology",
        )
    if trajectory is not None:
        load_trajectory(universe, trajectory, topology)
    return universe


def load_trajectory(universe: Any, trajectory: str | Path, topology: str | Path = "the topology") -> None:
    """Give a Universe another trajectory.

    Raises
    ------
    InputError
        A file that is missing or unreadable; atom counts that differ.
    UnreadableError
        A trajectory that is empty, or begins as it should and cannot be read.
    """
    _look_at(Path(trajectory), "trajectory")
    with quiet(), _failing_quietly() as failures:
        try:
            universe.load_new(str(trajectory), format=guess_format(str(trajectory)))
            # Some readers look at the file only now.
            n_frames = universe.trajectory.n_frames
        except _OPEN_ERRORS as error:
            failures.append(_first_line(error))
            text = str(error)
    if not failures:
        if not n_frames:
            raise UnreadableError(f"{trajectory} has no whole frame; was it cut off?", item="trajectory")
        return
    n_atoms = _stored_atoms(Path(trajectory))
    if n_atoms is not None and n_atoms != len(universe.atoms):
        raise InputError(
            f"{trajectory} has {n_atoms} atoms, {topology} has {len(universe.atoms)}; give the topology of the atoms "
            "that were written (engines often leave out water or virtual sites)",
            item="topology",
        )
    advice = "is it complete, and does its ending tell its format?"
    if Path(trajectory).suffix.lower() in (".nc", ".ncdf", ".h5md", ".h5"):
        advice = (
            "files of this format cannot be read at all when they were cut off; write DCD, XTC or TRR if that happens"
        )
    if Path(trajectory).suffix.lower() == ".traj":
        advice = (
            "that is ASE's own format: write with kcons.mdanalysis.write_ase, or ase convert run.traj run.pdb (run.xyz "
            "has more digits, and no cell)"
        )
    if failures[0].startswith("ImportError"):
        advice = "install that package, or give another format"
    # A file that begins as it should was cut off, or damaged later.
    kind = UnreadableError if _begins_well(Path(trajectory)) else InputError
    raise kind(
        f"{trajectory}: MDAnalysis cannot read this trajectory ({failures[0] if text else 'no message'}); {advice}",
        item="trajectory",
    )


def _begins_well(path: Path) -> bool:
    """Whether the first bytes are those of the format that the name tells."""
    with path.open("rb") as file:
        head = file.read(8)
    begins = _BEGINS.get(path.suffix.lower(), ())
    return head.startswith(begins) if begins else False


def format_of(reader: Any) -> str:
    """What MDAnalysis calls the format of a reader; '' of none."""
    name = getattr(reader, "format", "")
    return str(name if isinstance(name, str) else name[0]).upper()


def _look_at(path: Path, what: str) -> None:
    if not path.is_file():
        raise InputError(f"there is no file {path} (the {what})", item=what)
    if path.stat().st_size == 0:
        kind = UnreadableError if what == "trajectory" else InputError
        raise kind(f"{path} is empty; give another {what}", item=what)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__


def _stored_atoms(path: Path) -> int | None:
    """Number of atoms that a trajectory says it has."""
    with quiet(), _failing_quietly() as failures:
        try:
            reader = MDAnalysis.coordinates.core.get_reader_for(str(path), format=guess_format(str(path)))
            try:
                return int(reader.parse_n_atoms(str(path)))
            except NotImplementedError:  # of formats that say it frame by frame
                return int(reader(str(path)).n_atoms)
        except _OPEN_ERRORS as error:
            failures.append(_first_line(error))
            return None
