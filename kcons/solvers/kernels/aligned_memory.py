"""Memory for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

#: Bytes of a cache line.
LINE = 64


def aligned(n: int) -> NDArray[np.float64]:
    """Zeros that begin with a cache line, shape (n,).

    A vector of eight doubles fills a whole line; on NumPy's 16-byte alignment most accesses would touch
    two, which costs a third of a chain's time.
    """
    room = np.zeros(n + LINE // 8)
    skip = -room.ctypes.data % LINE // 8
    return room[skip : skip + n]


def in_one_array(pieces: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """Flat arrays of float64, int64, uint32 or uint8 as one, which is passed to a kernel in a part of the time.

    It begins with where each piece starts and ends, counted in the piece's own numbers; kernels take them out by
    `array_views.table_array`. Each has cache lines of its own.
    """
    cuts = np.zeros((len(pieces), 2), dtype=np.int64)
    end = 2 * len(pieces)
    for k, part in enumerate(pieces):
        first = -(-end // (LINE // 8)) * LINE // part.itemsize
        cuts[k] = first, first + part.size
        end = -(-(first + part.size) * part.itemsize // 8)
    room = aligned(end)
    room.view(np.int64)[: cuts.size] = cuts.ravel()
    for part, (first, last) in zip(pieces, cuts, strict=True):
        # All is 0; memory for rooms to work in is not asked for before they are used.
        if part.strides != (0,) or part[:1].any():
            room.view(part.dtype)[first:last] = part
    return room


def room(n: int) -> NDArray[np.float64]:
    """A piece of n zeros to work in."""
    return np.broadcast_to(0.0, n)


def part_of(tables: NDArray[np.float64], k: int, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Piece k of what `in_one_array` made, which it shares."""
    first, last = tables.view(np.int64)[2 * k : 2 * k + 2]
    found: NDArray[Any] = tables.view(dtype)[first:last]
    return found
