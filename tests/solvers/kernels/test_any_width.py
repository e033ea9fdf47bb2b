"""Numbers of any width: arithmetic lane by lane, with doubles on either side, and places in arrays."""

import numpy as np
import pytest
from numba import njit

from kcons.solvers.kernels.any_width import FLAGS, vectors


def kernel_of(width):
    load, store = vectors(width).load, vectors(width).store

    @njit(fastmath=set(FLAGS))
    def kernel(a, b, number, out):
        x, y = load(a, 1), load(b, 0)
        store(out, 0, x + y * number)
        store(out, width, -(number - x) / y)
        store(out, 2 * width, x * y - y)

    return kernel


@pytest.mark.parametrize("width", [2, 4, 8])
def test_arithmetic(width):
    rng = np.random.default_rng(width)
    a, b = rng.normal(size=width + 1), rng.normal(size=width) + 3.0
    out = np.full(3 * width + 1, 7.0)
    kernel_of(width)(a, b, 1.75, out)
    x = a[1:]
    np.testing.assert_allclose(out[:-1].reshape(3, width), [x + b * 1.75, -(1.75 - x) / b, x * b - b], rtol=1e-14)
    assert out[-1] == 7.0


def test_there_is_one_kind_a_width():
    assert vectors(4) is vectors(4) and vectors(4).kind == vectors(4).kind != vectors(2).kind
    assert [str(vectors(width).llvm) for width in (2, 8)] == ["<2 x double>", "<8 x double>"]
