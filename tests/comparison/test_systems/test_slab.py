"""Carbon monoxide on copper."""

from __future__ import annotations

import numpy as np
import pytest
from small_test_systems import end

from kcons.comparison import test_systems


@pytest.mark.parametrize("size", [1, 3])
def test_slab_is_periodic_and_its_lower_layers_are_fixed(size):
    system = test_systems.build("slab", size)
    symbols = np.array(system.symbols)
    assert list(symbols[-2 * size :]) == ["C", "O"] * size
    metal = np.flatnonzero(symbols == "Cu")
    heights = system.positions[:, 2]
    assert heights[system.fixed].max() < np.delete(heights, system.fixed).min()
    assert len(system.fixed) == len(metal) // 2
    assert system.motion.rank == size + 3 * len(system.fixed)
    assert not system.velocities[system.fixed].any()
    assert system.atoms().pbc.all()
    # Of the molecule, carbon is the closer one, above an atom of the top layer.
    for carbon, oxygen in system.bonds:
        assert 1.5 < heights[carbon] - heights[metal].max() < 2.1
        assert heights[oxygen] > heights[carbon] + 1.0
    state = end(system, system.time_steps[0])
    assert np.array_equal(state.positions[system.fixed], system.positions[system.fixed])
