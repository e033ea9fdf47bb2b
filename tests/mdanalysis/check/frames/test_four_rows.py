"""Vectors of four numbers against the same arithmetic on single ones."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from kcons.mdanalysis.check.frames import four_rows
from kcons.solvers.kernels.two_and_four_wide import load_quad, store_quad


@nb.njit
def distances(x, first, second, powers, step, out, sums):
    squares = (
        four_rows.four_squares_on_grid(x, first, second, 4, step)
        if step > 0.0
        else four_rows.four_squares(x, first, second, 4, step)
    )
    store_quad(out, 0, four_rows.roots(squares))
    store_quad(sums, 0, four_rows.sums_of_powers(powers, first, second, 4))


@pytest.mark.parametrize("step", [0.0, 0.01])
def test_distances_of_four_pairs_from_a_place_on(step):
    rng = np.random.default_rng(0)
    points = rng.normal(scale=5.0, size=(9, 3)).astype(np.float32)
    first, second = rng.integers(0, 9, (2, 8)).astype(np.uint32)
    first[7], second[7] = 8, 0  # the last atom: nothing is read behind it
    powers = rng.random(9).astype(np.float32)
    out, sums = np.zeros(4), np.zeros(4)
    distances(points.ravel(), first, second, powers, step, out, sums)
    x = points.astype(np.float64)
    if step:
        x = np.rint(x * (1 / step)) * step
    np.testing.assert_allclose(out, np.linalg.norm(x[first] - x[second], axis=1)[4:], rtol=1e-14)
    np.testing.assert_array_equal(sums, (powers[first] + powers[second])[4:])


@nb.njit
def compared(a, b, limit, larger, clear):
    p, q = load_quad(a, 0), load_quad(b, 0)
    store_quad(larger, 0, four_rows.larger_of(four_rows.sizes(p), q))
    store_quad(clear, 0, four_rows.not_coarse(p, q))
    return four_rows.all_below(p, limit)


def test_comparisons_and_what_is_no_number():
    larger, clear = np.zeros(4), np.zeros(4)
    a, b = np.array([-3.0, 1.0, np.nan, np.inf]), np.array([2.0, 2.0, 2.0, 2.0])
    assert not compared(a, b, 10.0, larger, clear)
    assert larger.tolist() == [3.0, 2.0, 2.0, np.inf]
    # Where rounding is no number, others see it; what exceeds the limit tells nothing.
    assert clear.tolist() == [1.0, 1.0, 1.0, 1.0]
    assert compared(np.array([-3.0, 1.0, 0.0, 9.9]), b, 10.0, larger, clear)
    assert clear.tolist() == [1.0, 1.0, 1.0, 0.0]


@nb.njit
def recorded(most, beside, a, b):
    four_rows.record(most, beside, 0, load_quad(a, 0), load_quad(b, 0))


def test_records_take_what_comes_with_them():
    most, beside = np.array([1, 5, 1, 5], np.float32), np.array([-1, -1, -1, -1], np.float32)
    recorded(most, beside, np.array([2.0, 2.0, np.nan, 6.0]), np.array([10.0, 20.0, 30.0, 40.0]))
    assert most.tolist() == [2.0, 5.0, 1.0, 6.0]
    assert beside.tolist() == [10.0, -1.0, -1.0, 40.0]
