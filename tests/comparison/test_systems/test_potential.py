"""Potentials: what is counted, and what is handed out."""

from __future__ import annotations

import numpy as np
from small_test_systems import small


def test_potential_counts_points_not_calls():
    scene = small("chain")
    scene.potential.forget()
    x = scene.positions
    scene.potential.forces(x)
    scene.potential.energy(x)
    scene.potential.forces(x.copy())
    assert scene.potential.evaluations == 1
    scene.potential.forces(x + 0.1)
    assert scene.potential.evaluations == 2


def test_potential_hands_out_copies():
    scene = small("chain")
    first = scene.potential.forces(scene.positions)
    first[:] = 0.0
    assert np.abs(scene.potential.forces(scene.positions)).max() > 0
