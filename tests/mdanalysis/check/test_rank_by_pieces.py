"""The rank of a large set is the sum of the ranks of its pieces."""

import numpy as np
import pytest

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.mdanalysis.check import rank_by_pieces
from kcons.mdanalysis.check.rank_by_pieces import rank_of
from kcons.motion import Motion


def clusters(count):
    """Five atoms each, all ten distances of rank nine, and a free atom; in disorder."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(6 * count, 3))
    pairs = np.array([[6 * n + i, 6 * n + j] for n in range(count) for i in range(5) for j in range(i)])
    place = rng.permutation(len(x))
    return ConstraintSet(Distance(rng.permutation(place[pairs])), x, np.ones(len(x))), x


@pytest.mark.parametrize("piece", [1, 10, 35, 10_000])
def test_whole_clusters_are_counted_a_piece_at_a_time(piece, monkeypatch):
    held, x = clusters(8)
    sizes = []

    class Counted(Motion):
        def __init__(self, part, positions):
            sizes.append(part.n_rows)
            super().__init__(part, positions)

    monkeypatch.setattr(rank_by_pieces, "PIECE", piece)
    monkeypatch.setattr(rank_by_pieces, "Motion", Counted)
    assert rank_of(held, x) == 8 * 9
    assert sum(sizes) == 80 and max(sizes) <= max(piece, 10)


def test_nothing_held():
    assert rank_of(ConstraintSet([], np.zeros((3, 3)), np.ones(3)), np.zeros((3, 3))) == 0
