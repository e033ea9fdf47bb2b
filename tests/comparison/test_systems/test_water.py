"""Boxes of rigid water."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.test_systems import water


@pytest.mark.parametrize("size", [64, 216, 512])
def test_equilibrated_water_needs_no_relaxation(size):
    x, box, equilibrated = water._molecules(size)
    assert equilibrated
    assert x.shape == (3 * size, 3)
    assert size / box**3 * 18.0154 / 0.602214 == pytest.approx(0.98, abs=0.005)  # g/cm3
    oxygen = x[::3]
    d = oxygen[:, None] - oxygen
    d -= box * np.round(d / box)
    distance = np.linalg.norm(d, axis=2)[np.triu_indices(size, 1)]
    assert 2.3 < distance.min() < 2.7
    # First shell: four to five neighbours within 3.3 Å.
    assert 4.0 < 2 * np.sum(distance < 3.3) / size < 5.5


def test_cut_water_has_no_overlaps():
    system = test_systems.build("water", 20, forces="ase")
    d = system.positions[::3][:, None] - system.positions[::3]
    d -= system.cell * np.round(d / system.cell)
    assert np.linalg.norm(d, axis=2)[np.triu_indices(20, 1)].min() > 2.2
    assert system.potential.energy(system.positions) / 20 < -0.2  # eV a molecule; ice is near -0.6
