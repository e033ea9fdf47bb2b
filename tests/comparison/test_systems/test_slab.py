"""Carbon monoxide on copper."""

from __future__ import annotations

import numpy as np
import pytest
from small_test_systems import end

from kcons.comparison import test_systems


@pytest.mark.parametrize("size", [1, 3])
def test_slab_is_periodic_and_its_lower_layers_are_fixed(size):
    scene = test_systems.build("slab", size)
    symbols = np.array(scene.symbols)
    assert list(symbols[-2 * size :]) == ["C", "O"] * size
    metal = np.flatnonzero(symbols == "Cu")
    heights = scene.positions[:, 2]
    assert heights[scene.fixed].max() < np.delete(heights, scene.fixed).min()
    assert len(scene.fixed) == len(metal) // 2
    assert scene.motion.rank == size + 3 * len(scene.fixed)
    assert not scene.velocities[scene.fixed].any()
    assert scene.atoms().pbc.all()
    # Of the molecule, carbon is the closer one, above an atom of the top layer.
    for carbon, oxygen in scene.bonds:
        assert 1.5 < heights[carbon] - heights[metal].max() < 2.1
        assert heights[oxygen] > heights[carbon] + 1.0
    state = end(scene, scene.time_steps[0])
    assert np.array_equal(state.positions[scene.fixed], scene.positions[scene.fixed])
