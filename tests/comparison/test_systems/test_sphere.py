"""Particles on spheres."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison import test_systems


def test_free_particles_stay_on_their_great_circles():
    system = test_systems.build("sphere", 3, seed=5)
    center = np.array([0.0, 0.0, 0.0])
    reference = system.reference().positions[0] - center
    normal = np.cross(system.positions[0], system.velocities[0])
    assert np.linalg.norm(reference) == pytest.approx(1.0, abs=1e-14)
    assert reference @ normal == pytest.approx(0.0, abs=1e-14)
    # The angle covered is speed times time.
    speed = np.linalg.norm(system.velocities[0])
    angle = np.arccos(np.clip(reference @ system.positions[0], -1, 1))
    assert np.cos(angle) == pytest.approx(np.cos(speed * system.horizon), abs=1e-13)
