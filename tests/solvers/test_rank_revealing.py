"""One meaning of dependent: by angle, in stacks, far from the origin."""

import numpy as np
import pytest

from kcons.solvers.rank_revealing import independent, least_norm, rank
from kcons.solvers.tolerances import RANK_TOLERANCE


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


def test_the_tolerance_is_of_the_largest():
    s = np.array([[2.0, 3 * RANK_TOLERANCE, 1 * RANK_TOLERANCE]])
    np.testing.assert_array_equal(independent(s), [[True, True, False]])


def test_dependent_rows_share_what_they_hold():
    once, thrice = rows_at(0.3)[:1], np.repeat(rows_at(0.3)[:1], 3, axis=0)
    x = least_norm(thrice[None], np.full((1, 3), 2.0))[0]
    np.testing.assert_allclose(x, least_norm(once[None], np.full((1, 1), 2.0))[0], rtol=1e-14)
    np.testing.assert_allclose(least_norm(thrice.T[None], np.array([[6.0, 0, 0]]))[0], [2.0, 2.0, 2.0], rtol=1e-14)
