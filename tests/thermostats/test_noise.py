"""Normal numbers drawn in kernels."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.thermostats.langevin import wound
from kcons.thermostats.noise import fill_normal


@pytest.mark.parametrize("seed", [0, 7, 2**63, 2**64 - 1])
@pytest.mark.parametrize(("number", "part"), [(1, 0), (10**9, 3), (0, 2**63)])
def test_numbers_are_those_of_numpy_to_the_last_bit(seed, number, part) -> None:
    """So many that all layers of the ziggurat and its tail are met."""
    found = np.empty(20_001)
    fill_normal(np.uint64(seed), np.uint64(number), np.uint64(part), found)
    np.testing.assert_array_equal(found, wound((seed, 0), number, part).standard_normal(20_001))
    assert np.abs(found).max() > 3.66  # beyond the last layer
