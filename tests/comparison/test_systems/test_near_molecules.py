"""Forces of near molecules: the gradient of their energy, all of it where everything is near, smooth where it ends."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.comparison import LennardJones, fluid
from kcons.comparison.test_systems.near_molecules import BEGIN, NearMolecules
from kcons.errors import InputError
from kcons.steppers import System
from kcons.thermostats import TemperatureSplit


@pytest.fixture(scope="module")
def water():
    chosen = fluid.water(27)
    x = chosen.forces.metropolis(chosen.positions, chosen.thermal_energy, 200, 10, 1, chosen.shift, chosen.turn)[1]
    return chosen.forces, x


def test_forces_are_the_gradient_of_the_energy(water):
    near, x = NearMolecules(water[0], 4.5), water[1]
    _, f = near.evaluate(x)
    rng = np.random.default_rng(0)
    for _ in range(4):
        along = rng.standard_normal(x.shape)
        slope = (near.evaluate(x + 1e-5 * along)[0] - near.evaluate(x - 1e-5 * along)[0]) / 2e-5
        assert slope == pytest.approx(-(f * along).sum(), rel=1e-7)
    assert np.abs(f.sum(axis=0)).max() < 1e-12 * np.abs(f).sum()


def test_pairs_that_are_near_count_in_full():
    """Two molecules at three distances: all of it, a part of it, nothing."""
    forces = LennardJones([0, 0, 1, 1], 20.0, charges=[0.3, -0.3, 0.3, -0.3], cutoff=9.0)
    near = NearMolecules(forces, 6.0)
    for apart, share in ((3.0, 1.0), (BEGIN * 6.0, 1.0), (5.0, 0.5), (6.0, 0.0), (7.0, 0.0)):
        x = np.array([[0, 0, 0], [0, 0.7, 0.0], [apart, 0, 0], [apart, 0.3, 0.6]])
        assert near.evaluate(x)[0] == pytest.approx(share * forces.evaluate(x)[0], rel=1e-12, abs=1e-15)
    x[2:, 0] -= 2.5
    assert near.evaluate(x)[1] != pytest.approx(forces.evaluate(x)[1])


def test_metropolis_is_at_the_temperature_asked_for():
    """Sampled without forces, judged by forces: shifts and turns, and the energy that it adds up."""
    chosen = fluid.dumbbells(8)
    near, kt = NearMolecules(chosen.forces, 1.5), chosen.thermal_energy
    x, split = chosen.positions, TemperatureSplit(System(chosen.motion, lambda x, t: near.evaluate(x)[1]))
    _, x, _ = near.metropolis(x, kt, 1000, 10, 1, chosen.shift, chosen.turn)
    for k in range(400):
        energies, x, accepted = near.metropolis(x, kt, 40, 40, (2, k), chosen.shift, chosen.turn)
        split.add(x)
    assert energies[-1] == pytest.approx(near.evaluate(x)[0], rel=1e-9) and 0.1 < accepted < 0.9
    found = split.result()
    assert abs(found.shift.off(kt)) <= 3.5 and abs(found.turn.off(kt)) <= 3.5 and found.shift.error < 0.1 * kt


@pytest.mark.parametrize("reach", [0.0, -1.0, 10.1, float("nan")])
def test_bad_reach(reach):
    with pytest.raises(InputError, match="molecules reach"):
        NearMolecules(LennardJones([0, 1], 20.0, cutoff=9.0), reach)
