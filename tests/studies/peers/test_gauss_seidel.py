"""SHAKE and RATTLE by sweeps: the same answers as the engine, to the tolerance asked for."""

from __future__ import annotations

import numpy as np
import pytest
from peers.gauss_seidel import GaussSeidel

from kcons.comparison import test_systems
from kcons.errors import ConvergenceError, InputError


@pytest.mark.parametrize(("name", "size"), [("rotor", 1), ("chain", 20), ("chain-free", 20), ("dumbbells", 2)])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_positions_and_velocities_are_those_of_the_engine(name, size, tolerance):
    system = test_systems.build(name, size)
    dt, v = system.time_steps[-1], system.velocities
    moved = system.positions + dt * v
    found, speeds = moved.copy(), v.copy()
    held = GaussSeidel(system.bonds, system.masses, system.positions, tolerance)
    held.positions(found, system.positions, speeds, dt)
    change = v.copy()
    wanted = system.motion.project_positions(moved, system.positions, velocities=change, dt=dt)
    # Errors of single rows add up along a chain.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=size**2 * 30 * tolerance)
    np.testing.assert_allclose(found - moved, dt * (speeds - v), rtol=0, atol=1e-14)
    np.testing.assert_allclose(speeds, change, rtol=0, atol=size**2 * 30 * tolerance / dt)
    lengths = np.linalg.norm(system.positions[system.bonds[:, 0]] - system.positions[system.bonds[:, 1]], axis=1)
    now = np.linalg.norm(found[system.bonds[:, 0]] - found[system.bonds[:, 1]], axis=1)
    assert np.abs(now / lengths - 1).max() < 1.1 * tolerance

    rng = np.random.default_rng(0)
    wild = np.abs(system.velocities).max() * rng.standard_normal(found.shape)
    tangent = wild.copy()
    held.velocities(wanted, tangent, dt)
    right = system.motion.project_velocities(wanted, wild)
    np.testing.assert_allclose(tangent, right, rtol=0, atol=size**2 * 30 * tolerance / dt)


def test_failures_are_errors():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = GaussSeidel([[0, 1]], [1.0, 1.0], x, 1e-12)
    turned = np.array([[0.0, 0, 0], [0.0, 1.0001, 0]])
    for wrong in (turned, np.full((2, 3), np.nan)):
        with pytest.raises(ConvergenceError, match="SHAKE did not converge"):
            held.positions(wrong, x, np.zeros((2, 3)), 1.0)
    with pytest.raises(ConvergenceError, match="RATTLE"):
        held.velocities(x, np.full((2, 3), np.nan), 1.0)
    with pytest.raises(InputError, match="whole"):
        GaussSeidel([[0, 1]], [1.0, 1.0], x, 1e-12, lengths=[0.5])
