"""What was found in some frames: nothing at first, means, pieces put together."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.mdanalysis.check.frames.deviations import UNITS, Deviations

ROWS, FRAMES = 4, 6
BY_FRAME = ("by_frame", "worst_row", "rate_worst", "rate_row", "rate_squares")


def made(n_frames, seed):
    """Something in every place."""
    rng = np.random.default_rng(seed)
    found = Deviations(ROWS, n_frames)
    found.margins, found.largest = rng.normal(size=ROWS), rng.random(ROWS)
    found.by_row = rng.integers(1, 9, size=(3, ROWS)).astype(float)
    for name in BY_FRAME:
        getattr(found, name)[...] = rng.integers(0, 99, size=getattr(found, name).shape)
    return found


def test_nothing_was_seen_at_first():
    found = Deviations(ROWS, FRAMES)
    assert np.all(found.margins == -np.inf) and np.all(found.excess == -np.inf)
    assert not found.largest.any() and not found.counted.any() and not found.seen.any()
    assert np.all(found.worst_row == -1) and np.all(found.rate_row == -1)
    assert np.isnan(found.rate_worst).all() and np.isnan(found.rate_squares).all()
    assert found.sums.shape == found.rate_worst.shape == (len(UNITS), FRAMES)


def test_names_are_views_of_one_array_each():
    found = Deviations(ROWS, FRAMES)
    for number, name in enumerate(("sums", "squares", "worst", "excess", "rounding", "seen")):
        getattr(found, name)[1, 3] = 10.0 + number
    assert found.by_frame[1, :, 3].tolist() == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    for number, name in enumerate(("total", "rounded", "counted")):
        getattr(found, name)[2] = number
    assert found.by_row[:, 2].tolist() == [0.0, 1.0, 2.0]


def test_means_are_over_the_frames_that_counted():
    found = Deviations(ROWS, FRAMES)
    found.total[:], found.counted[:] = [6.0, -6.0, 0.0, 2.0], [3.0, 2.0, 0.0, 1.0]
    assert found.mean(found.total).tolist() == [2.0, -3.0, 0.0, 2.0]


def test_frames_that_were_not_reached_are_left_out():
    found, whole = made(FRAMES, 1), made(FRAMES, 1)
    found.cut(4)
    assert found.n_frames == 4
    for name in BY_FRAME:
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name)[..., :4])
    np.testing.assert_array_equal(found.by_row, whole.by_row)


def test_two_pieces_follow_each_other():
    first, second = made(FRAMES, 1), made(3, 2)
    both = first.with_next(second)
    assert (both.n_rows, both.n_frames) == (ROWS, FRAMES + 3)
    for name in BY_FRAME:
        np.testing.assert_array_equal(getattr(both, name)[..., :FRAMES], getattr(first, name))
        np.testing.assert_array_equal(getattr(both, name)[..., FRAMES:], getattr(second, name))
    np.testing.assert_array_equal(both.by_row, first.by_row + second.by_row)


@pytest.mark.parametrize("second", [(0.5, 0.1), (1.5, 0.1), (1.0, 0.1)])
def test_the_deviation_is_that_of_the_frame_with_the_largest_excess(second):
    """A larger one elsewhere, where more was allowed, is not; of equal ones the first counts."""
    a, b = Deviations(1, 1), Deviations(1, 1)
    a.margins[:], a.largest[:] = 1.0, 0.3
    b.margins[:], b.largest[:] = second
    both = a.with_next(b)
    wanted = second if second[0] > 1.0 else (1.0, 0.3)
    assert (both.margins[0], both.largest[0]) == wanted
