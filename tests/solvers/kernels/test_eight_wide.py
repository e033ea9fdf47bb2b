"""A number eight doubles wide: what it reads, writes and decides, against NumPy."""

import numpy as np
import pytest
from numba import njit

from kcons.solvers.kernels import eight_wide as wide
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH


@njit(fastmath=FASTMATH)
def go_through_points(points, table, out, undo):
    x, y, z = wide.keep_points(points, table, 0, undo, 3 * WIDTH)
    dx, dy, dz = wide.gather_differences(points, table, 0, WIDTH)
    wide.store_triple(out, 0, dx, dy, dz)
    wide.store(out, 3 * WIDTH, wide.gather(points.ravel(), table, 0, 2))
    wide.scatter_points(points, table, WIDTH, x + 1.0, y + 2.0, z + 3.0)


def test_points_of_eight_atoms():
    """Also the last of an array, behind which nothing may be read."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(16, 3))
    given, atoms = points.copy(), rng.permutation(16)
    table = (3 * atoms).astype(np.uint32)
    out, undo = np.zeros(4 * WIDTH), np.zeros(6 * WIDTH)
    go_through_points(points, table, out, undo)
    first, second = given[atoms[:8]], given[atoms[8:]]
    assert np.array_equal(out[: 3 * WIDTH].reshape(3, 8).T, first - second)
    assert np.array_equal(out[3 * WIDTH :], first[:, 2])
    assert np.array_equal(undo[3 * WIDTH :].reshape(3, 8).T, first) and not undo[: 3 * WIDTH].any()
    assert np.array_equal(points[atoms[:8]], first) and np.array_equal(
        points[atoms[8:]], first + np.array([1.0, 2.0, 3.0])
    )


@njit(fastmath=FASTMATH)
def decide(a, b, out):
    x, y = wide.load(a, 0), wide.load(b, 0)
    wide.store(out, 0, wide.where_zero(x, 5.0, y))
    wide.store(out, 8, wide.not_positive(x))
    wide.store(out, 16, wide.where_greater(x, y, x, wide.splat(-1.0)))
    wide.store(out, 24, wide.from_previous(x))
    wide.store(out, 32, wide.from_next(x))
    wide.store(out, 40, wide.square_root(wide.absolute(x)))
    wide.store(out, 48, wide.nearest(x))
    return wide.all_within(x, y), wide.all_within(x, 100.0)


def test_decisions_lane_by_lane():
    a = np.array([0.0, 1.5, -2.0, np.nan, 2.5, -0.0, 7.0, 3.5])
    b = np.array([1.0, 1.0, 9.0, 4.0, 2.5, 2.0, 3.0, 4.0])
    out = np.zeros(56)
    within = decide(a, b, out)
    found = out.reshape(7, 8)
    np.testing.assert_array_equal(found[0], np.where(a == 0, 5.0, b))
    np.testing.assert_array_equal(found[1], np.where(a > 0, 0.0, 1.0))
    np.testing.assert_array_equal(found[2], np.where(a > b, a, -1.0))
    np.testing.assert_array_equal(found[3], [0.0, *a[:-1]])
    np.testing.assert_array_equal(found[4], [*a[1:], 0.0])
    np.testing.assert_array_equal(found[5], np.sqrt(np.abs(a)))
    np.testing.assert_array_equal(found[6], np.rint(a))
    assert within == (False, False)  # NaN is within nothing
    a[3] = 4.0
    assert decide(a, b, out) == (False, True)
    assert decide(np.minimum(a, b), b, out) == (True, True)


@njit(fastmath=FASTMATH)
def through_a_stack(a, out):
    room = wide.stack(3)
    for k in range(3):
        wide.poke(room, k, wide.load(a, 8 * k))
    wide.store(
        out,
        0,
        wide.product_difference(wide.peek(room, 2), wide.peek(room, 1), wide.peek(room, 0), 1.0 * wide.peek(room, 1)),
    )


def test_entries_of_a_stack_and_products_that_are_rounded_once():
    """a b - c d: the second product is rounded, so that what is left of the first is its rounding."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=24)
    a[16:] = a[:8]
    out = np.zeros(8)
    through_a_stack(a, out)
    x, y = a[:8], a[8:16]
    exact = [float(np.longdouble(p) * np.longdouble(q) - np.longdouble(p * q)) for p, q in zip(x, y, strict=True)]
    assert np.abs(exact).max() > 0
    np.testing.assert_allclose(out, exact, rtol=1e-2)


@pytest.mark.parametrize("entries", [1, 2])
def test_a_stack_has_a_fixed_size(entries):
    from numba.core.errors import TypingError

    @njit
    def grow(n):
        wide.poke(wide.stack(n), 0, wide.splat(1.0))

    with pytest.raises(TypingError):
        grow(entries)
