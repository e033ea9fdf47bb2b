"""Where a trajectory ends: whole frames, and what lies behind them.

MDAnalysis does not tell: it counts the whole frames of DCD and of text formats, and those of XTC and TRR up to the
first that it does not recognize. Of formats of structures, such as GRO, it reads one frame.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.exceptions import NoDataError
from MDAnalysis.lib.util import anyopen
from numpy.typing import NDArray

from kcons.errors import NonFiniteError
from kcons.mdanalysis.loading import READ_ERRORS, format_of, line_of

#: What is said of a frame of DCD whose records are not as long as they say.
DAMAGED = "its records are damaged"


@dataclass(frozen=True)
class Break:
    """Where a trajectory cannot be read any further: the first frame that cannot be used, and why."""

    frame: int
    reason: str
    #: Whether the file ends or is damaged there; else it can be read but its numbers are none.
    ends: bool = True

    @property
    def text(self) -> str:
        """For a person."""
        if self.ends:
            return f"the file ends too early, at frame {self.frame}: {self.reason}"
        return f"frame {self.frame} cannot be used, nor what follows: {self.reason}"


def broken_by(error: BaseException, reader: Any, frame: int) -> Break:
    """Where and why a trajectory cannot be read further; what the reader says, which iteration hides."""
    if isinstance(error.__cause__ or error, StopIteration):
        try:
            reader[frame]
        except READ_ERRORS as hidden:
            error = hidden
    said = str(error).strip().partition("\n")[0].strip() or "the file ends"
    # So it is said of any frame of DCD.
    said = DAMAGED if said.startswith("Reading DCD header failed") else said
    return Break(frame, said, not isinstance(error, NonFiniteError | NoDataError))


def first_break(reader: Any, look: Callable[[Any, str], Break | None]) -> Break | None:
    """What `ending` or `damage` finds first; in a chain of files, frames are counted from its beginning."""
    parts, begin = getattr(reader, "readers", None) or [reader], 0
    for part in parts:
        path = str(getattr(part, "filename", None) or "")
        found = look(part, path) if os.path.isfile(path) else None
        if found is not None:
            where = f"{path}: " if len(parts) > 1 else ""
            return replace(found, frame=begin + found.frame, reason=where + found.reason)
        begin += part.n_frames
    return None


def ending(reader: Any, path: str) -> Break | None:
    """What keeps the last frame of a file from being read, or lies behind it; None if nothing does."""
    name, n, size = format_of(reader), reader.n_frames, os.path.getsize(path)
    try:
        reader[n - 1]
    except READ_ERRORS as error:
        return broken_by(error, reader, n - 1)
    if isinstance(reader, DCDReader):
        file = reader._file
        end = file._header_size + file._firstframesize + (n - 1) * file._framesize
        if end >= size and (announced := dcd_head(path)[2]) > n:
            return Break(n, f"its header announces {announced} frames, and it has {n}")
    elif name in ("XTC", "TRR"):
        end = reader._xdr._bytes_tell()
    elif more := _behind_the_only_frame(path, name, reader.n_atoms):
        reason = f"MDAnalysis reads one frame of {name} files, and {more}; write the frames as XTC, DCD or PDB"
        return Break(1, reason, ends=False)
    else:
        return None
    return Break(n, f"{size - end} bytes follow the last whole frame") if end < size else None


def dcd_head(path: str) -> NDArray[np.int32]:
    """The first three words of a DCD file: bytes of the first record, its name, number of frames."""
    head = np.fromfile(path, "<i4", 3)
    return head if head[0] in (84, 164) else head.view(">i4")


def damage(reader: Any, path: str) -> Break | None:
    """The first damaged frame of a DCD or text file that the reader does not refuse itself."""
    if not isinstance(reader, DCDReader):
        with suppress(OSError, EOFError):
            return _text_break(path, format_of(reader), reader.n_atoms)
    elif (file := reader._file).is_periodic:
        # Records are framed by their lengths, at which the reader looks itself, but for the one behind a cell.
        with open(path, "rb") as opened:
            for k in range(reader.n_frames):
                # Of fixed atoms, the first frame alone has coordinates.
                opened.seek(file._header_size + (file._firstframesize + (k - 1) * file._framesize if k else 0))
                cell = opened.read(56)
                # 48, in either order of bytes.
                if cell[:4] != cell[52:] or cell[:4] not in (b"0\0\0\0", b"\0\0\x000"):
                    return Break(k, DAMAGED)
    return None


def _behind_the_only_frame(path: str, file_format: str, n_atoms: int) -> str:
    """What lies behind the frame of a format of which MDAnalysis reads one; '' if nothing does."""
    more, what, models = 0, "lines", 0
    if file_format == "CIF":
        import gemmi

        of_atoms = [block.find_values("_atom_site.pdbx_PDB_model_num") for block in gemmi.cif.read(path)]
        models = sum(len(set(numbers)) for numbers in of_atoms)
    elif file_format == "COOR":
        more, what = os.path.getsize(path) - 4 - 24 * n_atoms, "bytes"
    elif file_format in ("PQR", "PDBQT"):
        with anyopen(path, "rb") as file:
            begins = [line[:5] for line in file if line.startswith((b"ATOM", b"HETATM", b"MODEL"))]
        models = begins.count(b"MODEL")
        more, what = len(begins) - models - n_atoms, "atoms"
    elif file_format in ("GRO", "INPCRD", "CONFIG"):
        with anyopen(path, "rb") as file:
            lines = max((number for number, line in enumerate(file, 1) if line.strip()), default=0)
        # At most: title, number of atoms and a cell; of INPCRD two atoms a line, with velocities.
        most = {"GRO": n_atoms + 3, "INPCRD": 3 + 2 * ((n_atoms + 1) // 2)}.get(file_format)
        more = lines - (most or 5 + n_atoms * (2 + int(line_of(path, 1).split()[0])))
    if models > 1:
        return f"this one has {models}"
    return f"{more} {what} follow it" if more > 0 else ""


def _text_break(path: str, file_format: str, n_atoms: int) -> Break | None:
    """Where the whole frames of a text format end whose frames have equal numbers of lines; None for other formats."""
    lines, blank, models, line, wrong = 0, 0, 0, b"", None
    if file_format == "PDB":  # whose frames may differ
        with anyopen(path, "rb") as file:
            for line in file:
                models += line.startswith(b"MODEL")
        cut = line.startswith((b"ATOM", b"HETATM")) and not line.endswith(b"\n")
        return Break(max(models, 1) - 1, "its last line has no end") if cut else None
    if file_format not in ("XYZ", "LAMMPSDUMP", "TXYZ", "TRJ"):
        return None
    # Lines of a title; those of a frame besides its atoms, and which of them says how many atoms there are.
    title, more, count = {"XYZ": (0, 2, 0), "LAMMPSDUMP": (0, 9, 3), "TXYZ": (0, 1, 0), "TRJ": (1, 0, -1)}[file_format]
    per_frame = n_atoms + more
    if file_format == "TRJ":
        # Ten numbers a line; a line of three for the cell may follow.
        per_frame = -(-3 * n_atoms // 10)
        per_frame += _all_numbers(line_of(path, 1 + per_frame), 3)
    elif file_format == "TXYZ":
        # Six numbers of the cell may follow the number of atoms.
        per_frame += _all_numbers(line_of(path, 1), 6)
    lines = -title
    with anyopen(path, "rb") as file:
        for line in file:
            blank = 0 if line.strip() else blank + 1
            if count >= 0 and lines % per_frame == count and wrong is None and line.endswith(b"\n"):
                word = next(iter(line.split()), b"")
                if not (word.isdigit() and int(word) == n_atoms):
                    wrong = lines // per_frame, line
            # Empty lines at the end are no frame.
            if wrong is not None and not blank:
                said = f"{wrong[1].decode(errors='replace').strip()!r:.40}"
                reason = f"it has {said} where its number of atoms has to be, {n_atoms}"
                return Break(wrong[0], reason, ends=False)
            lines += 1
    lines -= blank
    whole = (lines - (not line.endswith(b"\n"))) // per_frame
    more = lines - whole * per_frame
    return Break(whole, f"{more} lines follow the last whole frame") if more > 0 else None


def _all_numbers(line: bytes, n: int) -> bool:
    """Whether a line consists of n numbers with points."""
    words = line.split()
    return len(words) == n and all(b"." in word for word in words)
