"""Memory for the kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
