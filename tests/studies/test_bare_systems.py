"""Molecules without forces: on their constraints, and off them after a step."""

from __future__ import annotations

import bare_systems
import numpy as np
import pytest

SYSTEMS = {
    "water": bare_systems.water(8),
    "methyl": bare_systems.methyl(8),
    "chain": bare_systems.chain(20),
}


@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
def test_systems_are_on_their_constraints_and_leave_them_in_a_step(system):
    assert system.stretch(system.positions) < 1e-12
    assert system.departure(system.positions, system.tangent) < 1e-13
    assert 1e-4 < system.stretch(system.moved) < 0.5
    assert system.departure(system.positions, system.thermal) > 0.1
    speed = np.mean(system.masses[:, None] * system.thermal**2)
    assert speed == pytest.approx(bare_systems.THERMAL_ENERGY, rel=0.5)
