"""Where a trajectory ends: whole frames, and what lies behind them.

MDAnalysis does not tell: it counts the whole frames of DCD and of text formats, and those of XTC and TRR up to the
first that it does not recognise. Of formats of structures, such as GRO, it reads one frame.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from MDAnalysis.lib.util import anyopen

from kcons.mdanalysis.check.precision import XTC_MAGIC
from kcons.mdanalysis.loading import format_of


@dataclass(frozen=True)
class Break:
    """Where a trajectory cannot be read any further.

    Attributes
    ----------
    frame : int
        The first frame that cannot be used.
    reason : str
    ends : bool
        Whether the file ends or is damaged there; else it can be read but its numbers are none.
    """

    frame: int
    reason: str
    ends: bool = True

    @property
    def text(self) -> str:
        """For a person."""
        if self.ends:
            return f"the file ends too early, at frame {self.frame}: {self.reason}"
        return f"frame {self.frame} cannot be used, nor what follows: {self.reason}"


def ending_of(reader: Any) -> Break | None:
    """`leftover` of the file of a reader, or of the first file of a chain that has one."""
    return _first(reader, lambda r, path: leftover(path, format_of(r), r.n_frames, r.n_atoms, _offset(r)))


def damage_of(reader: Any) -> Break | None:
    """`damage` of the file of a reader, or of the first file of a chain that has one."""
    return _first(reader, lambda r, path: damage(path, format_of(r), r.n_frames, r.n_atoms))


def _first(reader: Any, look: Callable[[Any, str], Break | None]) -> Break | None:
    """What is found first; in a chain of files, frames are counted from its beginning."""
    parts, begin = getattr(reader, "readers", None) or [reader], 0
    for part in parts:
        path = str(getattr(part, "filename", None) or "")
        found = look(part, path) if os.path.isfile(path) else None
        if found is not None:
            where = f"{path}: " if len(parts) > 1 else ""
            return replace(found, frame=begin + found.frame, reason=where + found.reason)
        begin += part.n_frames
    return None


def leftover(path: str | Path, file_format: str, n_frames: int, n_atoms: int, last_offset: int | None) -> Break | None:
    """What lies behind the last whole frame: a frame that was cut off, or that cannot be read; None if nothing does.

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
            layout = _dcd_layout(path)
            end = layout.second + (n_frames - 1) * layout.size
            if end >= size and layout.announced > n_frames:
                return Break(n_frames, f"its header announces {layout.announced} frames, and it has {n_frames}")
        elif file_format == "XTC" and last_offset is not None:
            end = last_offset + _xtc_frame_size(path, last_offset)
        elif file_format == "TRR" and last_offset is not None:
            end = last_offset + _trr_frame_size(path, last_offset)
        elif more := _behind_the_only_frame(path, file_format, n_atoms):
            return Break(
                1,
                f"MDAnalysis reads one frame of {file_format} files, and {more}; write the frames as XTC, DCD or PDB",
                ends=False,
            )
        else:
            return None
    except (OSError, EOFError, struct.error) as error:
        return Break(n_frames, f"its frames cannot be followed ({error})")
    if end < size:
        return Break(n_frames, f"{size - end} bytes follow the last whole frame")
    if end > size:
        return Break(n_frames - 1, f"its last frame lacks {end - size} bytes")
    return None


def damage(path: str | Path, file_format: str, n_frames: int, n_atoms: int) -> Break | None:
    """The first frame of a DCD file whose records are not where they must be; of a text file the first whose lines are
    not all there, to their ends, or that has another number of atoms. None where there is no such frame, and for other
    formats.

    The reader does not look: it takes what it finds for coordinates.
    """
    try:
        if file_format != "DCD":
            return _text_break(path, file_format, n_atoms)
        layout = _dcd_layout(path)
    except (OSError, EOFError, struct.error):
        return None
    n_later = min(n_frames - 1, (os.path.getsize(path) - layout.second) // layout.size)
    if n_later < 1:
        return None
    # Records are framed by their lengths.
    begins = np.cumsum([0, *(n + 8 for n in layout.records)])[:-1]
    words = np.memmap(path, layout.order + "i4", "r", layout.second, (n_later, layout.size // 4))
    lengths = np.array(layout.records)
    wrong = (words[:, begins // 4] != lengths) | (words[:, (begins + lengths) // 4 + 1] != lengths)
    return Break(1 + int(np.argmax(wrong.any(axis=1))), "its records are damaged") if wrong.any() else None


def _behind_the_only_frame(path: str | Path, file_format: str, n_atoms: int) -> str:
    """What lies behind the frame of a format of which MDAnalysis reads one; '' if nothing does."""
    if file_format == "CIF":
        import gemmi

        of_atoms = [block.find_values("_atom_site.pdbx_PDB_model_num") for block in gemmi.cif.read(str(path))]
        models = sum(len(set(numbers)) for numbers in of_atoms)
        return f"this one has {models}" if models > 1 else ""
    if file_format == "COOR":
        more = os.path.getsize(path) - 4 - 24 * n_atoms
        return f"{more} bytes follow it" if more > 0 else ""
    if file_format not in ("GRO", "INPCRD", "CONFIG", "PQR", "PDBQT"):
        return ""
    lines = atoms = models = 0
    with anyopen(str(path), "rb") as file:
        for number, line in enumerate(file, 1):
            lines = number if line.strip() else lines
            atoms += line.startswith((b"ATOM", b"HETATM"))
            models += line.startswith(b"MODEL")
    if file_format in ("PQR", "PDBQT"):
        if models > 1:
            return f"this one has {models}"
        return f"{atoms - n_atoms} atoms follow it" if atoms > n_atoms else ""
    # At most: title, number of atoms and a cell; of INPCRD two atoms a line, with velocities.
    most = {"GRO": n_atoms + 3, "INPCRD": 3 + 2 * ((n_atoms + 1) // 2)}.get(file_format)
    if most is None:
        most = 5 + n_atoms * (2 + int(_line(path, 1).split()[0]))
    return f"{lines - most} lines follow it" if lines > most else ""


def _text_break(path: str | Path, file_format: str, n_atoms: int) -> Break | None:
    """Where the whole frames of a text format end whose frames have equal numbers of lines; None for other formats.

    Of PDB, whose frames may differ, only a last line without an end is seen.
    """
    if file_format == "PDB":
        return _pdb_break(path)
    if file_format not in ("XYZ", "LAMMPSDUMP", "TXYZ", "TRJ"):
        return None
    # Lines of a title; those of a frame besides its atoms, and which of them says how many atoms there are.
    title, more, count = {"XYZ": (0, 2, 0), "LAMMPSDUMP": (0, 9, 3), "TXYZ": (0, 1, 0), "TRJ": (1, 0, -1)}[file_format]
    per_frame = n_atoms + more
    if file_format == "TRJ":
        # Ten numbers a line; a line of three for the cell may follow.
        per_frame = -(-3 * n_atoms // 10)
        per_frame += _all_numbers(_line(path, 1 + per_frame), 3)
    elif file_format == "TXYZ":
        # Six numbers of the cell may follow the number of atoms.
        per_frame += _all_numbers(_line(path, 1), 6)
    lines, blank, line, wrong = -title, 0, b"", None
    with anyopen(str(path), "rb") as file:
        for line in file:
            blank = 0 if line.strip() else blank + 1
            if count >= 0 and lines % per_frame == count and wrong is None and line.endswith(b"\n"):
                word = next(iter(line.split()), b"")
                if not (word.isdigit() and int(word) == n_atoms):
                    wrong = lines // per_frame, line
            # Empty lines at the end are no frame.
            if wrong is not None and not blank:
                said = wrong[1].decode(errors="replace").strip()
                return Break(
                    wrong[0], f"it has {said!r:.40} where its number of atoms has to be, {n_atoms}", ends=False
                )
            lines += 1
    lines -= blank
    whole = (lines - (not line.endswith(b"\n"))) // per_frame
    more = lines - whole * per_frame
    return Break(whole, f"{more} lines follow the last whole frame") if more > 0 else None


def _pdb_break(path: str | Path) -> Break | None:
    models, line = 0, b""
    with anyopen(str(path), "rb") as file:
        for line in file:
            models += line.startswith(b"MODEL")
    if line.startswith((b"ATOM", b"HETATM")) and not line.endswith(b"\n"):
        return Break(max(models, 1) - 1, "its last line has no end")
    return None


def _line(path: str | Path, number: int) -> bytes:
    """A line of a text file, counted from 0; b'' behind its end."""
    with anyopen(str(path), "rb") as file:
        found: bytes = next(islice(file, number, None), b"")
    return found


def _all_numbers(line: bytes, n: int) -> bool:
    """Whether a line consists of n numbers with points."""
    words = line.split()
    return len(words) == n and all(b"." in word for word in words)


class _DcdLayout(NamedTuple):
    """Order of bytes, frames that the header announces, where the second frame begins; of all but the first the bytes
    of a frame and of its records (a cell, x, y, z and maybe a fourth): with fixed atoms, these are shorter."""

    order: str
    announced: int
    second: int
    size: int
    records: list[int]


def _dcd_layout(path: str | Path) -> _DcdLayout:
    with open(path, "rb") as file:
        head = file.read(88)
        order = "<" if struct.unpack("<i", head[:4])[0] in (84, 164) else ">"
        words = struct.unpack(order + "21i", head[4:])
        fixed, charmm = words[9], words[20] != 0
        n_atoms = begin = 0
        # Header, title, number of atoms; the free ones where others are fixed.
        for record in range(3 + (fixed > 0)):
            file.seek(begin)
            length, n = struct.unpack(order + "2i", file.read(8))
            n_atoms = n if record == 2 else n_atoms
            begin += 8 + length
    cell, fourth = charmm and words[11] != 0, charmm and words[12] == 1

    def records(n: int) -> list[int]:
        return [48] * cell + [4 * n] * (3 + fourth)

    first, later = (records(n) for n in (n_atoms, n_atoms - fixed))
    return _DcdLayout(order, words[1], begin + sum(first) + 8 * len(first), sum(later) + 8 * len(later), later)


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


def _offset(reader: Any) -> int | None:
    """Where the last frame of an XTC or TRR file begins."""
    offsets = getattr(getattr(reader, "_xdr", None), "offsets", None)
    return int(offsets[-1]) if offsets is not None and len(np.atleast_1d(offsets)) else None
