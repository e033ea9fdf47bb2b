"""Opening files through MDAnalysis, with errors that name the file, what is wrong with it and the remedy."""

from __future__ import annotations

import re
import struct
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import MDAnalysis
from MDAnalysis.lib.util import anyopen, guess_format

from kcons.errors import InputError, UnreadableError, unknown

#: What MDAnalysis and the readers below it raise on a bad file; the last two of sizes that are not so.
READ_ERRORS = (
    *(OSError, EOFError, ValueError, TypeError, RuntimeError, LookupError, StopIteration, struct.error),
    *(MemoryError, ArithmeticError),
)
#: The same where a file is opened: of formats whose package is missing, and of readers that are not MDAnalysis' own.
_OPEN_ERRORS = (*READ_ERRORS, ImportError, SyntaxError, AttributeError, NotImplementedError)

#: Formats of files whose endings, or names without one, MDAnalysis does not know.
_FORMATS = {"LAMMPSTRJ": "LAMMPSDUMP", "DUMP": "LAMMPSDUMP", "REVCON": "CONFIG", "NCRST": "NCDF", "RST": "RST7"}


@contextmanager
def quiet() -> Iterator[None]:
    """Without MDAnalysis' warnings about files: what matters is checked and said here."""
    with warnings.catch_warnings(action="ignore"):
        yield


@contextmanager
def _opening() -> Iterator[None]:
    """`quiet`; a reader that could not open its file also fails when it is deleted, and once is enough."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda unraisable: None
    try:
        with quiet():
            yield
    finally:
        sys.unraisablehook = hook


def open_universe(
    topology: str | Path,
    trajectory: str | Path | None = None,
    *,
    format: str | None = None,
    topology_format: str | None = None,
    **options: Any,
) -> Any:
    """A Universe from files.

    Parameters
    ----------
    topology : path
        Any topology that MDAnalysis reads.
    trajectory : path, optional
        Any trajectory that MDAnalysis reads.
    format, topology_format : str, optional
        Formats of both files, as MDAnalysis names them; by default what their names tell.
    **options
        For `MDAnalysis.Universe`.

    Raises
    ------
    InputError
        A file that is missing, a topology that is unreadable; a format that MDAnalysis does not have, or needs a
        package for; atom counts that differ.
    UnreadableError
        A trajectory that is empty, or cannot be read.
    """
    for path, what in ((topology, "topology"), (trajectory, "trajectory")):
        if path is not None:
            _look_at(Path(path), what)
    # Without a format, MDAnalysis asks every package it can convert from whether a path is an object of its own, which
    # imports OpenMM with all its platforms: 80 MB, 70 of them the compiler of an OpenCL platform.
    kind = _format(topology, topology_format, "topology_format")
    failure = ""
    with _opening():
        try:
            universe = MDAnalysis.Universe(str(topology), topology_format=kind, **options)
        except _OPEN_ERRORS as error:
            failure = _first_line(error)
    if failure:
        advice = _advice_on_packages(failure) or "give a file such as PSF, PRMTOP, TPR, GRO, PDB or mmCIF"
        raise InputError(f"{topology}: MDAnalysis cannot read this topology ({failure}); {advice}", item="topology")
    if not (hasattr(universe.atoms, "names") or hasattr(universe.atoms, "types")):
        raise InputError(
            f"{topology} says nothing of its atoms, as trajectories do; give a topology such as PSF, PRMTOP, TPR, GRO, "
            "PDB or mmCIF, and the trajectory beside it (check_trajectory takes the trajectory first)",
            item="topology",
        )
    if trajectory is not None:
        load_trajectory(universe, trajectory, topology, format=format)
    else:
        _warn_of_a_cell(topology, getattr(universe, "trajectory", None))
    return universe


def load_trajectory(
    universe: Any, trajectory: str | Path, topology: str | Path = "the topology", *, format: str | None = None
) -> None:
    """Give a Universe another trajectory.

    Parameters
    ----------
    universe : MDAnalysis.Universe
    trajectory : path
    topology : path
        What to call the topology.
    format : str, optional
        As for `open_universe`.

    Raises
    ------
    InputError, UnreadableError
        As `open_universe`.
    """
    _look_at(Path(trajectory), "trajectory")
    named = _format(trajectory, format, "format")
    failure, n_frames = "", 0
    n_atoms: int | None = None
    with _opening():
        try:
            universe.load_new(str(trajectory), format=named)
            # Some readers look at the file only now, and some take the number of atoms of the topology for theirs.
            n_frames, n_atoms = universe.trajectory.n_frames, len(universe.trajectory.ts.positions)
        except _OPEN_ERRORS as error:
            failure = _first_line(error) if str(error) else "no message"
    if failure:
        n_atoms = _stored_atoms(Path(trajectory), named)
    elif not n_frames:
        raise UnreadableError(f"{trajectory} has no whole frame; was it cut off?", item="trajectory")
    if n_atoms is not None and n_atoms != len(universe.atoms):
        raise InputError(
            f"{trajectory} has {n_atoms} atoms, {topology} has {len(universe.atoms)}; give the topology of the atoms "
            "that were written (engines often leave out water or virtual sites)",
            item="topology",
        )
    if not failure:
        return _warn_of_a_cell(trajectory, universe.trajectory)
    packages, advice = _advice_on_packages(failure), "is it complete, and does its ending tell its format?"
    if named in ("NC", "NCDF", "H5MD"):
        advice = "files of this format that were cut off cannot be read at all: write DCD, XTC or TRR if that happens"
    said = f"{trajectory}: MDAnalysis cannot read this trajectory ({failure}); {packages or advice}"
    raise (InputError if packages else UnreadableError)(said, item="trajectory")


def _format(path: str | Path, given: str | None, item: str) -> str:
    """What MDAnalysis calls the format of a file: the one given, or what its name tells; `item` says another one."""
    readers = set(MDAnalysis._READERS) | (set(MDAnalysis._PARSERS) if item == "topology_format" else set())
    name = format_named(path) if given is None else given.upper()
    if name in readers:
        return name
    option = f"--{item.replace('_', '-')}"
    if given is not None:
        raise InputError(f"MDAnalysis has no format {unknown(given, sorted(readers))}", item=item)
    if name == "TRAJ":
        raise InputError(
            f"{path}: that is ASE's own format: write with kcons.mdanalysis.write_ase, or ase convert run.traj run.pdb "
            "(run.xyz has more digits, and no cell)",
            item="trajectory",
        )
    what = "trajectory" if item == "format" else "topology"
    raise InputError(
        f"{path}: its name tells no format of a {what} that MDAnalysis reads; rename it, or give its format ({item}=, "
        f"kcons check {option} NAME): {', '.join(sorted(readers))}",
        item=item,
    )


def format_named(path: str | Path) -> str:
    """What MDAnalysis calls the format that a name tells; '' where there is no ending and the name is none.

    The file is looked into where two formats share an ending: restarts of AMBER, and topologies of AMBER and GROMACS.
    """
    name = guess_format(str(path)) or Path(path).name.upper()
    name = _FORMATS.get(name, name)
    if name in ("RST7", "TOP"):
        with anyopen(str(path), "rb") as file:
            head: bytes = file.read(8)
        if name == "TOP":
            return "TOP" if head.startswith(b"%") else "ITP"
        return "NCDF" if head.startswith((b"CDF", b"\x89HDF")) else "INPCRD"
    return name


def _advice_on_packages(failure: str) -> str:
    """How to get the package that MDAnalysis says is missing; '' where it does not."""
    found = re.findall(r"install (\w+)", failure)
    return f"python -m pip install {found[-1].lower()}, or give another format" if found else ""


def format_of(reader: Any) -> str:
    """What MDAnalysis calls the format of a reader; '' of none."""
    name = getattr(reader, "format", "")
    return str(name if isinstance(name, str) else name[0]).upper()


def _warn_of_a_cell(path: str | Path, reader: Any) -> None:
    if format_of(reader) == "XYZ":
        said = line_of(path, 1)
        if b"Lattice=" in said and b'pbc="F F F"' not in said:
            remedy = "convert it by ase convert to a format that has one, such as PDB"
            warnings.warn(f"{path}: its cell is not read, since it is an XYZ file; {remedy}", UserWarning, stacklevel=3)


def line_of(path: str | Path, number: int) -> bytes:
    """A line of a text file, counted from 0; b'' behind its end."""
    with anyopen(str(path), "rb") as file:
        found: bytes = next(islice(file, number, None), b"")
    return found


def _look_at(path: Path, what: str) -> None:
    if not path.is_file():
        raise InputError(f"there is no file {path} (the {what})", item=what)
    if path.stat().st_size == 0:
        kind = UnreadableError if what == "trajectory" else InputError
        raise kind(f"{path} is empty; give another {what}", item=what)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    # MDAnalysis says with which class it failed, and why in the next line.
    told = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")] or lines
    return f"{type(error).__name__}: {told[0].strip()}" if told else type(error).__name__


def _stored_atoms(path: Path, named: str) -> int | None:
    """Number of atoms that a trajectory says it has."""
    with _opening():
        try:
            reader = MDAnalysis.coordinates.core.get_reader_for(str(path), format=named)
            try:
                return int(reader.parse_n_atoms(str(path)))
            except NotImplementedError:  # of formats that say it frame by frame
                return int(reader(str(path)).n_atoms)
        except _OPEN_ERRORS:
            return None
