"""Opening files through MDAnalysis, with errors that name the file, what is wrong with it and the remedy."""

from __future__ import annotations

import gc
import os
import struct
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import MDAnalysis
import numpy as np

from kcons.errors import InputError
from kcons.mdanalysis.precision import XTC_MAGIC

#: What MDAnalysis and the readers below it raise on a bad file.
READ_ERRORS = (OSError, EOFError, ValueError, TypeError, RuntimeError, LookupError, StopIteration, struct.error)


@contextmanager
def quiet() -> Iterator[None]:
    """Without MDAnalysis' warnings about files: what matters is checked and said here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextmanager
def _failing_quietly() -> Iterator[None]:
    """A reader that could not open its file also fails when it is deleted; once is enough."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda unraisable: None
    try:
        yield
    finally:
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
        A file that is missing, empty or unreadable; atom counts that differ.
    """
    for path, what in ((topology, "topology"), (trajectory, "trajectory")):
        if path is not None:
            _look_at(Path(path), what)
    failure = None
    with quiet(), _failing_quietly():
        try:
            universe = MDAnalysis.Universe(str(topology), **options)
        except READ_ERRORS as error:
            failure = _first_line(error)
    if failure is not None:
        raise InputError(
            f"{topology}: MDAnalysis cannot read this topology ({failure}); give a file such as PSF, PRMTOP, TPR, GRO, "
            "PDB or mmCIF",
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
        A file that is missing, empty or unreadable; atom counts that differ.
    """
    _look_at(Path(trajectory), "trajectory")
    failure = None
    with quiet(), _failing_quietly():
        try:
            universe.load_new(str(trajectory))
        except READ_ERRORS as error:
            failure = _first_line(error)
            text = str(error)
    if failure is None:
        return
    n_atoms = _stored_atoms(Path(trajectory))
    if n_atoms is not None and n_atoms != len(universe.atoms):
        raise InputError(
            f"{trajectory} has {n_atoms} atoms, {topology} has {len(universe.atoms)}; give the topology of the atoms "
            "that were written (engines often leave out water or virtual sites), or write that part of the topology "
            "with MDAnalysis: universe.select_atoms(...).write('part.pdb')",
            item="topology",
        )
    advice = "is it complete, and does its ending tell its format?"
    if Path(trajectory).suffix.lower() in (".nc", ".ncdf", ".h5md", ".h5"):
        advice = (
            "files of this format cannot be read at all when they were cut off; write DCD, XTC or TRR if that happens"
        )
    raise InputError(
        f"{trajectory}: MDAnalysis cannot read this trajectory ({failure if text else 'no message'}); {advice}",
        item="trajectory",
    )


def format_of(reader: Any) -> str:
    """What MDAnalysis calls the format of a reader; '' of none."""
    name = getattr(reader, "format", "")
    return str(name if isinstance(name, str) else name[0]).upper()


def _look_at(path: Path, what: str) -> None:
    if not path.is_file():
        raise InputError(f"there is no file {path} (the {what})", item=what)
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty; give another {what}", item=what)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].strip()}" if lines else type(error).__name__


def _stored_atoms(path: Path) -> int | None:
    """Number of atoms that a trajectory says it has."""
    with quiet(), _failing_quietly():
        try:
            reader = MDAnalysis.coordinates.core.get_reader_for(str(path))
            return int(reader.parse_n_atoms(str(path)))
        except (*READ_ERRORS, NotImplementedError, AttributeError):
            return None


# -- the end of a file ------------------------------------------------------------------------------


def leftover(path: str | Path, file_format: str, n_frames: int, n_atoms: int, last_offset: int | None) -> str:
    """What lies behind the last whole frame: a frame that was cut off, or that cannot be read. '' if nothing does.

    MDAnalysis does not tell: it counts the whole frames of DCD and XYZ, and those of XTC and TRR up to the first
    that it does not recognise.

    Parameters
    ----------
    path : path
    file_format : str
    n_frames : int
        Frames that MDAnalysis counts.
    n_atoms : int
    last_offset : int or None
        Where the last of them begins, for XTC and TRR.
    """
    size = os.path.getsize(path)
    try:
        if file_format == "DCD":
            end = _dcd_end(path, n_frames)
        elif file_format == "XTC" and last_offset is not None:
            end = last_offset + _xtc_frame_size(path, last_offset)
        elif file_format == "TRR" and last_offset is not None:
            end = last_offset + _trr_frame_size(path, last_offset)
        elif file_format == "XYZ" and str(path).lower().endswith(".xyz"):
            with open(path, "rb") as file:
                lines = sum(1 for line in file if line.strip()) if n_atoms else 0
            # Comment lines may be blank, so only what exceeds whole frames counts.
            more = lines - n_frames * (n_atoms + 2)
            return f"{more} lines follow the last whole frame" if more > 0 else ""
        else:
            return ""
    except (OSError, struct.error) as error:
        return f"its frames cannot be followed ({error})"
    if end < size:
        return f"{size - end} bytes follow the last whole frame"
    return ""


def intact_frames(path: str | Path, file_format: str, n_frames: int) -> int:
    """Frames of a DCD file up to the first whose records are not where they must be; all frames of other formats.

    The reader does not look: it takes what it finds for coordinates.
    """
    if file_format != "DCD" or not os.path.isfile(path):
        return n_frames
    try:
        order, ends, opening = _dcd_records(path, n_frames)
    except struct.error:
        return n_frames
    if len(ends) < 2:
        return n_frames
    size = ends[1] - ends[0]
    with open(path, "rb") as file:
        for k in range(1, n_frames):
            file.seek(ends[0] + (k - 1) * size)
            word = file.read(4)
            if len(word) < 4 or struct.unpack(order + "i", word)[0] != opening:
                return k
    return n_frames


def _dcd_end(path: str | Path, n_frames: int) -> int:
    """End of the last whole frame."""
    _, ends, _ = _dcd_records(path, n_frames)
    if not ends:
        return os.path.getsize(path)
    # With fixed atoms, frames after the first are shorter.
    later = ends[1] - ends[0] if len(ends) > 1 else 0
    return ends[0] + (n_frames - 1) * later


def _dcd_records(path: str | Path, n_frames: int) -> tuple[str, list[int], int]:
    """Order of bytes, ends of the first two frames, and the word that the second begins with.

    Records are framed by their lengths.
    """
    size = os.path.getsize(path)
    ends: list[int] = []
    opening = 0
    with open(path, "rb") as file:
        order = "<" if struct.unpack("<i", file.read(4))[0] in (84, 164) else ">"

        def skip() -> int:
            length = int(struct.unpack(order + "i", file.read(4))[0])
            file.seek(length + 4, os.SEEK_CUR)
            return length

        file.seek(0)
        for _ in range(3):
            skip()
        while len(ends) < min(n_frames, 2) and file.tell() < size:
            # A unit cell of six doubles may come first; then x, y, z.
            opening = skip()
            for _ in range(3 if opening == 48 else 2):
                skip()
            ends.append(file.tell())
    return order, ends, opening


def _xtc_frame_size(path: str | Path, offset: int) -> int:
    with open(path, "rb") as file:
        file.seek(offset)
        head = file.read(104)
    magic, n_atoms = struct.unpack(">2i", head[:8])
    if magic not in XTC_MAGIC:
        return 0
    if n_atoms <= 9:
        return 56 + 12 * n_atoms
    # magic, atoms, step, time, box (9), atoms, precision, 3 + 3 bounds, small index: then the number of bytes.
    if magic == XTC_MAGIC[0]:
        n_bytes, begin = struct.unpack(">i", head[88:92])[0], 92
    else:
        n_bytes, begin = struct.unpack(">q", head[88:96])[0], 96
    return int(begin + 4 * ((n_bytes + 3) // 4))


def _trr_frame_size(path: str | Path, offset: int) -> int:
    with open(path, "rb") as file:
        file.seek(offset)
        head = file.read(84)
    length = struct.unpack(">i", head[8:12])[0]
    begin = 12 + 4 * ((length + 3) // 4)
    numbers = struct.unpack(">13i", head[begin : begin + 52])
    blocks, n_atoms = numbers[:10], numbers[10]
    # Time and lambda come last, in the precision of the coordinates.
    box, per_atom = blocks[2], [block for block in blocks[7:10] if block]
    double = box == 72 or (n_atoms and per_atom and per_atom[0] == 24 * n_atoms)
    return int(begin + 52 + (16 if double else 8) + sum(blocks))


def last_offset(reader: Any) -> int | None:
    """Where the last frame of an XTC or TRR file begins."""
    offsets = getattr(getattr(reader, "_xdr", None), "offsets", None)
    return int(offsets[-1]) if offsets is not None and len(np.atleast_1d(offsets)) else None
