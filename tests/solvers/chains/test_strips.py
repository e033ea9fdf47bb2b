"""Every atom and every bond of a chain has one place in its strip."""

import numpy as np
import pytest

from kcons.solvers.chains.strips import SHORT, long_strip, short_strip, whole_slots
from kcons.solvers.kernels.eight_wide import WIDTH


@pytest.mark.parametrize("size", [33, 40, 41, 64, 1000])
def test_a_long_chain_in_eight_pieces(size):
    begin, chain = 70, 2
    place, owned, present, row = long_strip(begin, size, chain)
    assert place.shape == (-(-size // WIDTH), WIDTH)
    assert sorted(place[owned].tolist()) == list(range(begin, begin + size))
    # Two chains before it have a row less each than atoms.
    assert sorted(row[present].tolist()) == list(range(begin - chain, begin - chain + size - 1))
    # A bond's first atom has its slot; down a lane, and from the end of one to the next, the path goes on.
    assert np.array_equal(row[present], place[present] - chain)
    along = place.T.ravel()
    assert np.array_equal(np.unique(along), np.sort(place[owned])) and (np.diff(along) >= 0).all()
    assert place[~owned].size == 0 or (place[~owned] == begin + size - 1).all()


def test_short_chains_take_a_lane_each():
    sizes = np.array([2, SHORT, 5])
    bounds = np.concatenate([[0], np.cumsum(sizes)])
    place, owned, present, row = short_strip(bounds, sizes, np.array([1, 2, 0]))
    assert place.shape == (SHORT, WIDTH)
    for lane, chain in enumerate([1, 2, 0]):
        assert place[owned[:, lane], lane].tolist() == list(range(bounds[chain], bounds[chain + 1]))
        first = bounds[chain] - chain
        assert row[present[:, lane], lane].tolist() == list(range(first, first + sizes[chain] - 1))
    assert not owned[:, 3:].any() and not present[:, 3:].any()
    assert row.min() >= 0 and row.max() < sizes.sum() - len(sizes)


def test_slots_that_are_whole():
    present = np.ones((6, WIDTH), bool)
    present[5, 3] = False  # the separators' do not count
    assert whole_slots(present) == 5 * WIDTH
    present[2, 7] = False
    assert whole_slots(present) == 2 * WIDTH
