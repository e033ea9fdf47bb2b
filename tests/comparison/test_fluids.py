"""The small periodic fluids that tests sample: forces and curvatures by differences, sampling without forces."""

from __future__ import annotations

import fluids
import numpy as np
import pytest
from lennard_jones import LennardJones
from scipy.spatial.transform import Rotation


def triatomics():
    chosen = fluids.triatomics(8)
    rng = np.random.default_rng(0)
    forces = LennardJones(
        chosen.forces.molecule, 3.9, masses=chosen.forces.masses, sigma=np.tile([1.0, 0.7, 0.7], 8),
        charges=np.tile([-0.8, 0.4, 0.4], 8),
    )  # fmt: skip
    return forces, chosen.positions + np.repeat(0.05 * rng.normal(size=(8, 3)), 3, axis=0)


def test_forces_are_the_slope_of_the_potential_and_images_do_not_matter():
    fluid, x = triatomics()
    f, h = fluid.force(x), 1e-6
    for k in range(x.size):
        up, down = x.copy(), x.copy()
        up.flat[k] += h
        down.flat[k] -= h
        assert -(fluid.potential(up) - fluid.potential(down)) / (2 * h) == pytest.approx(f.flat[k], abs=1e-6)
    assert np.abs(f.sum(axis=0)).max() <= 1e-10
    x[3:6] += [3.9, 0, -7.8]
    np.testing.assert_allclose(fluid.force(x), f, atol=1e-9)


def test_shifts_and_turns_of_molecules():
    fluid, x = triatomics()
    m = fluid.masses

    def moved(k, shift, turn):
        y, s = x.copy(), slice(3 * k, 3 * k + 3)
        center = (m[s, None] * x[s]).sum(axis=0) / m[s].sum()
        y[s] = center + shift + (x[s] - center) @ Rotation.from_rotvec(turn).as_matrix().T
        return fluid.potential(y)

    none, h, middle, sums = np.zeros(3), 1e-4, fluid.potential(x), np.zeros(4)
    for k in range(8):
        for e in h * np.eye(3):
            ends = [(moved(k, e, none), moved(k, -e, none)), (moved(k, none, e), moved(k, none, -e))]
            for n, (up, down) in enumerate(ends):
                sums[2 * n : 2 * n + 2] += ((up - down) / (2 * h)) ** 2, (up + down - 2 * middle) / h**2
    assert fluid.split_sample(x) == pytest.approx(sums, rel=1e-4)


def test_metropolis_samples_two_atoms():
    """The mean energy of one pair is an integral over the box."""
    fluid = LennardJones([0, 1], 3.0)
    r = np.linalg.norm(3.0 * (np.random.default_rng(0).random((200_000, 3)) - 0.5), axis=1)
    u = np.array([fluid.potential(np.array([[0.0, 0, 0], [d, 0, 0]])) if d < 1.5 else 0.0 for d in r[:40_000]])
    weights = np.exp(-u / 1.5)
    expected = (u * weights)[weights > 0].sum() / weights.sum()
    energies, _, _ = fluid.metropolis(np.array([[0.0, 0, 0], [1.2, 0, 0]]), 1.5, 400_000, 4, 1, 0.6, 0.0)
    assert energies.mean() == pytest.approx(expected, abs=0.006)


def test_metropolis_keeps_molecules_whole():
    chosen = fluids.water(27)
    energies, y, accepted = chosen.forces.metropolis(
        chosen.positions, chosen.thermal_energy, 200, 10, 1, chosen.shift, chosen.turn
    )
    assert energies[-1] == pytest.approx(chosen.forces.potential(y), rel=1e-9) and 0.1 < accepted < 0.9
    assert np.abs(chosen.constraint_set.value(y)).max() < 1e-10
