"""Potentials: what is counted, and what is handed out."""

from __future__ import annotations

import numpy as np
from small_test_systems import small


def test_potential_counts_points_not_calls():
    system = small("chain")
    system.potential.forget()
    x = system.positions
    system.potential.forces(x)
    system.potential.energy(x)
    system.potential.forces(x.copy())
    assert system.potential.evaluations == 1
    system.potential.forces(x + 0.1)
    assert system.potential.evaluations == 2


def test_potential_hands_out_copies():
    system = small("chain")
    first = system.potential.forces(system.positions)
    first[:] = 0.0
    assert np.abs(system.potential.forces(system.positions)).max() > 0
