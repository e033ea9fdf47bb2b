"""What a sweep reduces a chain to: a few separators, against dense algebra."""

import numpy as np
import pytest

from kcons.solvers.chains.sweeps import _reduce
from kcons.solvers.kernels.eight_wide import WIDTH


@pytest.mark.parametrize("upward", [False, True])
def test_separators_are_solved_for(upward):
    """Diagonals have what lanes add at their heads and tails; couplings need not be symmetric."""
    small = np.random.default_rng(5).normal(size=(8, WIDTH))
    small[0] += 10.0
    given = small.copy()
    n = WIDTH - 1
    head, tail = (1, 0) if upward else (0, 1)
    matrix = np.diag(given[0, :n] + given[2, head : n + head] + given[5, tail : n + tail])
    right = given[1, :n] + given[3, head : n + head] + given[6, tail : n + tail]
    lower, upper = (given[7], given[4]) if upward else (given[4], given[7])
    for j in range(1, n):
        matrix[j, j - 1], matrix[j - 1, j] = lower[j], upper[j]
    _reduce(small, upward)
    np.testing.assert_allclose(small[1, :n], np.linalg.solve(matrix, right), rtol=1e-13)
    assert small[1, n] == 0.0
