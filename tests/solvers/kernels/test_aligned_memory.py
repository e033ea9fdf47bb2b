"""Memory that begins with a cache line."""

import numpy as np

from kcons.solvers.kernels.aligned_memory import LINE, aligned


def test_zeros_begin_with_a_cache_line():
    kept = [aligned(n) for n in (0, 1, 7, 8, 100, 1001)]
    for array in kept[1:]:
        assert array.ctypes.data % LINE == 0
        assert array.dtype == np.float64 and not array.any() and array.flags.carray
    assert [len(array) for array in kept] == [0, 1, 7, 8, 100, 1001]
