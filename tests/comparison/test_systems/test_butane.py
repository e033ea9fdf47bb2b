"""A chain with a free torsion: its energy is that of the angle, and its reference keeps what is held."""

import numpy as np
import pytest

from kcons.comparison.test_systems.butane import BARRIER, MASSES, POSITIONS, VELOCITIES, build, torsion, twist
from kcons.constraints import Dihedral


def test_the_energy_is_that_of_the_dihedral():
    row = Dihedral([[0, 1, 2, 3]])
    for seed in range(4):
        x = POSITIONS + 0.3 * np.random.default_rng(seed).normal(size=(4, 3))
        phi = float(row.measure(x[row.atoms], 0.0)[0])
        energy, forces = torsion(x)
        assert energy == pytest.approx(BARRIER * (1 + np.cos(3 * phi)))
        slope = 3 * BARRIER * np.sin(3 * phi) * row.gradient(x[row.atoms], 0.0)[0]
        np.testing.assert_allclose(forces, slope, atol=1e-12)


def test_the_reference_keeps_rows_momenta_and_energy():
    rows = build().constraint_set
    h = 2e-4
    energies, spins = [], []
    for time in (0.0, 1.0):
        before, here, after = (twist(POSITIONS, VELOCITIES, MASSES, time + s).positions for s in (-h, 0.0, h))
        assert np.abs(rows.value(here)).max() < 1e-12
        v = (after - before) / (2 * h)
        if time == 0.0:
            np.testing.assert_allclose(here, POSITIONS, atol=1e-14)
            np.testing.assert_allclose(v, VELOCITIES, atol=1e-6)
        energies.append(torsion(here)[0] + 0.5 * np.sum(MASSES[:, None] * v**2))
        spins.append(MASSES @ np.cross(here, v))
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)
    np.testing.assert_allclose(spins, [spins[0]] * 2, atol=1e-5)
