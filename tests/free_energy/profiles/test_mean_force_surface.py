"""Surfaces from mean forces, against free energies in closed form."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from kcons.free_energy.profiles.profile import fit_surface

TURN = 2 * math.pi


def wells(x):
    """Two minima, one higher than the other; the valley between them is bent."""
    a, b = np.asarray(x).T
    return 5 * (a**2 - 1) ** 2 + 8 * (b - 0.4 * a**2) ** 2 + a


def torsions(x):
    a, b = np.asarray(x).T
    return 5 * np.cos(a) + 4 * np.cos(2 * b) + 3 * np.cos(a - b)


def slopes(value, x):
    """By complex steps."""
    return np.stack([value(x + 1e-30j * e).imag / 1e-30 for e in np.eye(2)], axis=1)


SURFACES = {
    "wells": (wells, [-1.4, -0.6], [1.4, 1.4], None),
    "torsions": (torsions, [-math.pi, -math.pi], [math.pi, math.pi], (TURN, TURN)),
}


@cache
def fitted(name, seed=0, swirl=0.0):
    """Of 60 windows whose errors have correlated components, beside a field that is no gradient."""
    value, low, high, periods = SURFACES[name]
    x = np.random.default_rng(100 + seed).uniform(low, high, (60, 2))
    mixing = 0.4 * np.array([[1.0, 0.0], [0.6, 0.8]])
    drawn = np.random.default_rng(seed).standard_normal((60, 2)) @ mixing.T + swirl * np.stack(
        [-x[:, 1], x[:, 0]], axis=1
    )
    return fit_surface(x, slopes(value, x) + drawn, np.broadcast_to(mixing @ mixing.T, (60, 2, 2)), periods=periods)


@pytest.mark.parametrize("name", SURFACES)
def test_scattered_windows_give_the_surface_within_its_errors(name):
    value = SURFACES[name][0]
    away, sizes = [], []
    for seed in range(3):
        surface = fitted(name, seed)
        at = np.random.default_rng(7 + seed).uniform(surface.low, surface.high, (12, 2))
        F, errors = surface.free_energy(at)
        exact = value(at) - value(surface.zero[None])
        away.append((F - exact) / errors)
        sizes.append(np.abs(F - exact).max() / np.ptp(exact))
    # All against one zero, and so not independent of each other: the mean square is 1 within some tenths.
    assert 0.2 < np.mean(np.square(away)) < 2.0
    assert (np.abs(away) < 2.5).mean() > 0.9
    assert max(sizes) < 0.1


@pytest.mark.parametrize("name", SURFACES)
def test_a_grid_without_noise_gives_the_surface(name):
    value, low, high, periods = SURFACES[name]
    places = [np.linspace(a, b, 9, endpoint=periods is None) for a, b in zip(low, high, strict=True)]
    x = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
    surface = fit_surface(x, slopes(value, x), np.full(x.shape, 1e-4), periods=periods, zero=[0.1, 0.2])
    at = np.random.default_rng(8).uniform(low, high, (200, 2))
    exact = value(at) - value(np.array([[0.1, 0.2]]))
    assert np.abs(surface.free_energy(at)[0] - exact).max() < 0.005 * np.ptp(exact)
    if periods:
        turned, _ = surface.free_energy(at + np.array([TURN, -TURN]))
        assert turned == pytest.approx(surface.free_energy(at)[0], abs=1e-6 * np.ptp(exact))


def test_vectors_that_are_no_gradient_are_warned_of():
    """Warnings are errors in all other tests."""
    with pytest.warns(UserWarning, match="no gradient"):
        fitted("wells", swirl=3.0)
