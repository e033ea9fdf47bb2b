"""One meaning of dependent: by angle, in stacks, far from the origin."""

import numpy as np
import pytest

from kcons.solvers.rank_revealing import rank


def rows_at(angle, scale=1.0):
    """Two rows of three numbers with an angle between them."""
    return np.array([[1.0, 0.0, 0.0], [scale * np.cos(angle), scale * np.sin(angle), 0.0]])


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
@pytest.mark.parametrize(("angle", "expected"), [(1e-7, 2), (1e-9, 1), (0.0, 1)])
def test_what_counts_is_the_angle(angle, expected, scale):
    assert rank(rows_at(angle, scale)[None]) == expected


def test_stacks_are_counted_in_all_and_rows_of_zeros_do_not_count():
    assert rank(np.stack([rows_at(1.0), rows_at(0.0), np.zeros((2, 3))])) == 3
    assert rank(np.zeros((0, 2, 3))) == 0
