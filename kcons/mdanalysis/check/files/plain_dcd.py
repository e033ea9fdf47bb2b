"""DCD files read in blocks, past MDAnalysis' Timestep: three arrays of coordinates a frame, looked at where they lie.

MDAnalysis' reader spends six sevenths of its time on copies of a frame into its Timestep and from one Timestep to
the next. Here bytes go from the file into one small block, and compiled code takes the frames of a block one after
another without the interpreter's lock, so that several threads read one file. What a number in the file means (unit
cells, times) MDAnalysis still says.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from MDAnalysis.coordinates.DCD import DCDReader
from MDAnalysis.coordinates.timestep import Timestep
from MDAnalysis.lib.formats.libdcd import DCDFrame
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray

#: Bytes of a block: what stays in the cache of a core.
BLOCK = 1 << 20
#: Bytes of a unit cell, and of the two words around every record.
CELL, AROUND = 48, 8


@dataclass
class Block:
    """Frames that follow each other in a file.

    Attributes
    ----------
    words : ndarray of int32, shape (n_frames, words)
        As in the file, with the lengths of the records around them.
    x : int
        Where the record of x begins in a frame.
    dimensions : ndarray, shape (n_frames, 6)
        Cells as MDAnalysis has them; zeros without one.
    """

    words: NDArray[np.int32]
    x: int
    dimensions: NDArray[np.float32]


class PlainDcd:
    """A DCD file whose frames are all alike: no fixed atoms, no fourth dimension, in this machine's order of bytes.

    Parameters
    ----------
    reader : MDAnalysis.coordinates.DCD.DCDReader
        Asked for the meaning of unit cells and for times; its place in the file is left alone.
    begin : int
        Where the first frame begins.
    has_cell : bool
    """

    def __init__(self, reader: DCDReader, begin: int, has_cell: bool) -> None:
        self.path, self.n_atoms, self.n_frames = str(reader.filename), int(reader.n_atoms), int(reader.n_frames)
        self._begin, self._x = begin, (CELL + AROUND) // 4 if has_cell else 0
        self.size = 4 * self._x + 3 * (4 * self.n_atoms + AROUND)
        # Places and values of the words that say how long records are.
        record = self.n_atoms + 2
        starts = [0] * has_cell + [self._x + k * record for k in range(4)]
        lengths_of = [CELL] * has_cell + [4 * self.n_atoms] * 3
        self._around = np.array([at for a, b in pairwise(starts) for at in (a, b - 1)])
        self._lengths = np.repeat(np.array(lengths_of, dtype=np.int32), 2)
        self._reader = reader
        self._one = Timestep(1)
        self._point = np.zeros((1, 3), dtype=np.float32)

    def times(self, frames: IntArray) -> FloatArray:
        """Times of frames, in ps."""
        header, ts = self._reader._file.header, self._reader.ts
        result: FloatArray = (frames + header["istart"] / header["nsavc"]) * ts.dt + ts.data.get("time_offset", 0)
        return result

    def blocks(self, frames: IntArray) -> Iterator[Block]:
        """Frames in the order asked for.

        Raises
        ------
        OSError
            The next frame is damaged, or the file ends; all that come before were given.
        """
        at_once = max(BLOCK // self.size, 1)
        # Beginnings of runs of frames that follow each other.
        ends = np.append(np.flatnonzero(np.diff(frames) != 1) + 1, len(frames))
        words = np.empty((at_once, self.size // 4), dtype=np.int32)
        cells = _Cells(self)
        done = 0
        with open(self.path, "rb", buffering=0) as file:
            for end in ends.tolist():
                while done < end:
                    n = min(at_once, end - done)
                    file.seek(self._begin + int(frames[done]) * self.size)
                    got = file.readinto(words[:n].data)
                    read = words[: got // self.size]
                    whole = (read[:, self._around] == self._lengths).all(axis=1)
                    n_whole = len(read) if whole.all() else int(np.argmin(whole))
                    if n_whole:
                        yield Block(read[:n_whole], self._x, cells.of(read[:n_whole]))
                        done += n_whole
                    if n_whole < len(read):
                        raise OSError("its records are damaged")
                    if not n_whole:
                        raise OSError("the file ends")

    def dimensions_of(self, cell: FloatArray) -> NDArray[np.float32]:
        """What MDAnalysis takes six numbers of the file for; zeros if it is no cell."""
        ts, reader = self._one, self._reader
        # The meaning lies in a method that fills a Timestep; one of a single atom is filled soon.
        ts.dt = reader.ts.dt
        with np.errstate(all="ignore"):
            ts = type(reader)._frame_to_ts(reader, DCDFrame(self._point, cell), ts)
        result = np.zeros(6, dtype=np.float32) if ts.dimensions is None else ts.dimensions
        return np.array(result, dtype=np.float32)


class _Cells:
    """Unit cells of frames; those that follow their like are not computed again."""

    def __init__(self, file: PlainDcd) -> None:
        self._file = file
        self._raw = b""
        self._dimensions = np.zeros(6, dtype=np.float32)

    def of(self, words: NDArray[np.int32]) -> NDArray[np.float32]:
        n = len(words)
        if words.shape[1] == 3 * (self._file.n_atoms + 2):
            return np.zeros((n, 6), dtype=np.float32)
        raw = np.ascontiguousarray(words[:, 1 : 1 + CELL // 4])
        cells = raw.view(np.float64)
        result = np.empty((n, 6), dtype=np.float32)
        for k in range(n):
            mine = raw[k].tobytes()
            if mine != self._raw:
                self._raw = mine
                a, gamma, b, beta, alpha, c = cells[k].tolist()
                if alpha == beta == gamma == 0.0 and min(a, b, c) >= 0.0:
                    # Cosines of right angles, by far the most frequent.
                    self._dimensions = np.array([a, b, c, 90.0, 90.0, 90.0], dtype=np.float32)
                else:
                    self._dimensions = self._file.dimensions_of(cells[k].copy())
            result[k] = self._dimensions
        return result


def plain_dcd(reader: Any) -> PlainDcd | None:
    """The file of a reader where `PlainDcd` gives what the reader gives, None otherwise."""
    if type(reader) is not DCDReader or len(reader.transformations) or not os.path.isfile(reader.filename):
        return None
    try:
        with open(reader.filename, "rb") as file:
            head = file.read(88)
            if struct.unpack("=i", head[:4])[0] != 84:
                return None
            words = struct.unpack("=21i", head[4:])
            file.seek(4, os.SEEK_CUR)
            for _ in range(2):
                length = struct.unpack("=i", file.read(4))[0]
                file.seek(length + 4, os.SEEK_CUR)
            begin = file.tell()
            opening = struct.unpack("=i", file.read(4))[0]
    except struct.error:
        return None
    # Only CHARMM's kind has flags: a unit cell, a fourth dimension; fixed atoms make later frames shorter.
    charmm, cell, fourth, fixed = words[20] != 0, words[11] != 0, words[12] == 1, words[9] != 0
    if fixed or (charmm and fourth) or opening != (CELL if charmm and cell else 4 * reader.n_atoms):
        return None
    return PlainDcd(reader, begin, charmm and cell)
