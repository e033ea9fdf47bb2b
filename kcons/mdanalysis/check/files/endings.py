"""Where a trajectory ends: whole frames, and what was cut off behind them.

MDAnalysis does not tell: it counts the whole frames of DCD and of text formats, and those of XTC and TRR up to the
first that it does not recognise.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from MDAnalysis.lib.util import anyopen

from kcons.mdanalysis.check.files.file_precision import XTC_MAGIC
from kcons.mdanalysis.check.result import Break


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
            end = _dcd_end(path, n_frames)
            announced = _dcd_announced(path)
            if end >= size and announced > n_frames:
                return Break(n_frames, f"its header announces {announced} frames, and it has {n_frames}")
        elif file_format == "XTC" and last_offset is not None:
            end = last_offset + _xtc_frame_size(path, last_offset)
        elif file_format == "TRR" and last_offset is not None:
            end = last_offset + _trr_frame_size(path, last_offset)
        else:
            whole, more = _lines(path, file_format, n_atoms)
            return None if more <= 0 or whole is None else Break(whole, f"{more} lines follow the last whole frame")
    except (OSError, EOFError, struct.error) as error:
        return Break(n_frames, f"its frames cannot be followed ({error})")
    if end < size:
        return Break(n_frames, f"{size - end} bytes follow the last whole frame")
    if end > size:
        return Break(n_frames - 1, f"its last frame lacks {end - size} bytes")
    return None


def intact_frames(path: str | Path, file_format: str, n_frames: int, n_atoms: int) -> int:
    """Frames of a DCD file up to the first whose records are not where they must be; frames of a text file whose lines
    are all there, to their ends; all frames of other formats.

    The reader does not look: it takes what it finds for coordinates.
    """
    if not os.path.isfile(path):
        return n_frames
    if file_format != "DCD":
        try:
            whole = _lines(path, file_format, n_atoms)[0]
        except (OSError, EOFError):
            return n_frames
        return n_frames if whole is None else min(n_frames, whole)
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


def _lines(path: str | Path, file_format: str, n_atoms: int) -> tuple[int | None, int]:
    """Whole frames of a text format whose frames have equal numbers of lines, and lines that follow them.

    None for other formats; of PDB, whose frames may differ, only a last line without an end is seen.
    """
    if file_format not in ("XYZ", "LAMMPSDUMP", "TXYZ", "TRJ", "PDB"):
        return None, 0
    frames, lines, blank, second, models = 0, 0, 0, b"", 0
    line = b""
    with anyopen(str(path), "rb") as file:
        for line in file:
            lines += 1
            blank = 0 if line.strip() else blank + 1
            second = line if lines == 2 else second
            models += line.startswith(b"MODEL")
    ended = line.endswith(b"\n")
    if file_format == "PDB":
        return (max(models, 1) - 1, 1) if line.startswith((b"ATOM", b"HETATM")) and not ended else (None, 0)
    head = 0
    if file_format == "TRJ":
        # Ten numbers a line, below a title; a line of three for the cell may follow.
        head, per_frame = 1, -(-3 * n_atoms // 10)
        per_frame += _trj_has_cell(path, per_frame)
    elif file_format == "TXYZ":
        # The number of atoms; six numbers of the cell may follow.
        per_frame = n_atoms + 1 + _all_numbers(second, 6)
    else:
        per_frame = n_atoms + (2 if file_format == "XYZ" else 9)
    lines -= blank + head
    frames = (lines - (not ended)) // per_frame
    return frames, lines - frames * per_frame


def _all_numbers(line: bytes, n: int) -> bool:
    """Whether a line consists of n numbers with points."""
    words = line.split()
    return len(words) == n and all(b"." in word for word in words)


def _trj_has_cell(path: str | Path, per_frame: int) -> bool:
    with anyopen(str(path), "rb") as file:
        for number, line in enumerate(file):
            if number == 1 + per_frame:
                return _all_numbers(line, 3)
    return False


def _dcd_announced(path: str | Path) -> int:
    """How many frames the header says there are."""
    with open(path, "rb") as file:
        head = file.read(12)
    order = "<" if struct.unpack("<i", head[:4])[0] in (84, 164) else ">"
    return int(struct.unpack(order + "i", head[8:12])[0])


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
