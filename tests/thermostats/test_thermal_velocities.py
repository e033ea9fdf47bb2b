"""Velocities drawn on the constraints: covariance k T M_par^+, zero momentum."""

from __future__ import annotations

import math

import numpy as np
import pytest
from thermostat_systems import METHANE, TEN, system

from kcons.constraints import Distance, FixedAtoms, Plane
from kcons.errors import UnsupportedError
from kcons.thermostats import thermal_velocities


def test_covariance_is_the_constrained_one():
    """<v v^T> = kT M_par^+, dense and by definition, with redundant rows."""
    x = METHANE
    held = system([Distance(TEN)], x, [12.0, 1, 1, 1, 1])
    rng = np.random.default_rng(0)
    n, kt = 20_000, 0.7
    drawn = np.array([thermal_velocities(held, x, kt, rng).ravel() for _ in range(n)])
    rows = held.motion.constraint_set.jacobian(x).toarray()
    inverse = np.repeat(1 / held.masses, 3)
    spread = rows * inverse
    expected = kt * (np.diag(inverse) - spread.T @ np.linalg.pinv(rows @ spread.T, rcond=1e-10) @ spread)
    found = drawn.T @ drawn / n
    # Standard error of each element of a covariance matrix.
    error = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / n) + 1e-15
    assert (np.abs(found - expected) / error).max() <= 4.5
    kinetic = 0.5 * (held.masses.repeat(3) * drawn**2).sum(axis=1)
    g = 15 - 9
    assert kinetic.mean() == pytest.approx(0.5 * g * kt, abs=4 * kt * math.sqrt(g / 2 / n))
    assert kinetic.var() == pytest.approx(0.5 * g * kt**2, rel=0.06)
    assert np.abs(rows @ drawn.T).max() <= 1e-12


def test_momentum_is_taken_out_along_open_directions_only():
    x = np.random.default_rng(0).standard_normal((5, 3)) * [1, 1, 0]
    flat = system([Plane(range(5), [0, 0, 1.0], lambda t: 0.3 * t)], x, np.arange(1.0, 6))
    v = thermal_velocities(flat, x, 1.0, 5, zero_momentum=True)
    np.testing.assert_allclose(flat.masses @ v, [0, 0, 0.3 * 15], atol=1e-14)


def test_moving_targets_are_followed():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([Distance([[0, 1]], lambda t: 1 + 0.5 * t)], x, [1.0, 3.0])
    v = thermal_velocities(held, x, 1.0, 5)
    assert v[1, 0] - v[0, 0] == pytest.approx(0.5, rel=1e-13)


def test_fixed_atoms_stay():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([FixedAtoms([0]), Distance([[0, 1]])], x, [1.0, 3.0])
    v = thermal_velocities(held, x, 1.0, 5)
    assert (v[0] == 0).all() and v[1, 0] == 0 and np.abs(v[1, 1:]).min() > 0
    with pytest.raises(UnsupportedError, match="hold atoms in space in every direction"):
        thermal_velocities(held, x, 1.0, 5, zero_momentum=True)
    still = system([FixedAtoms([0, 1])], x, [1.0, 3.0])
    assert (thermal_velocities(still, x, 1.0, 5) == 0).all()
