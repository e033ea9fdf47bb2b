"""The compiled moves on spheres: against a fine solution of the equation, and what they must keep."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from thermostat_systems import molecules

from kcons.thermostats.multistep import sphere_kernels as kernels
from kcons.thermostats.multistep.spheres import SphereLayout

KT, L = 0.5, 2


def made(kind):
    """Molecules of three atoms and two ions: tables, squares, and tangent velocities and accelerations."""
    held, state = molecules("bent", 3, ions=2)
    layout = SphereLayout.of(held, state.positions, kind)
    tables = layout.cluster, layout.spheres, layout.masses, layout.totals
    rng = np.random.default_rng(5)
    draw = lambda size: held.motion.project_velocities(state.positions, size * rng.normal(size=(11, 3)))  # noqa: E731
    squares = layout.squares(KT, L)
    v, w = draw(1.0), rng.normal(size=(len(squares), L))
    kernels.rescale(v, w, squares, True, *tables)
    return held, state, tables, squares, v, w, draw


def parts(v, tables):
    """Mass-weighted velocities of each sphere, one after another: written out, one cluster at a time."""
    cluster, spheres, masses, totals = tables
    found = {}
    for c in range(len(totals)):
        mine = np.flatnonzero(cluster == c)
        middle = np.zeros(3)
        if spheres[c, 0] >= 0:
            middle = masses[mine] @ v[mine] / totals[c]
            for k in range(3):
                found.setdefault(spheres[c, k], []).append(np.sqrt(totals[c]) * middle[[k]])
        if spheres[c, 3] >= 0:
            found.setdefault(spheres[c, 3], []).append((np.sqrt(masses[mine])[:, None] * (v[mine] - middle)).ravel())
    return [np.concatenate(found[s]) for s in sorted(found)]


KINDS = ["split", "axes", "cluster", "global"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("strength", [0.0, 1e-9, 1.0, 25.0])
def test_the_kick_solves_its_equation(kind, strength):
    """y' = (1 - y y^T/R^2)(F, 0) on each sphere."""
    _, _, tables, squares, v, w, draw = made(kind)
    a, t = draw(strength), 0.3
    wanted = []
    for u, f, own, square in zip(parts(v, tables), parts(a, tables), w, squares, strict=True):
        push = np.append(f, np.zeros(L))
        slope = lambda _, y, p=push, r=square: p - y * (y @ p) / r  # noqa: E731
        wanted.append(solve_ivp(slope, (0, t), np.append(u, own), method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1])
    kernels.turn(v, w, a, t, squares, *tables)
    for u, own, y in zip(parts(v, tables), w, wanted, strict=True):
        np.testing.assert_allclose(np.append(u, own), y, rtol=0, atol=1e-11)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("strength", [1e4, 1e150])
def test_forces_of_any_strength(strength, sign):
    """Velocities end along the force, with all that their sphere has; with a negative time, against it."""
    _, _, tables, squares, v, w, draw = made("split")
    a = draw(strength)
    kernels.turn(v, w, a, sign, squares, *tables)
    for u, f, square in zip(parts(v, tables), parts(a, tables), squares, strict=True):
        np.testing.assert_allclose(u, sign * f / np.linalg.norm(f) * np.sqrt(square), rtol=1e-10, atol=1e-10)
    assert np.abs(w).max() <= 1e-10


def test_from_rest_and_exactly_against_the_force():
    _, _, tables, squares, v, w, draw = made("cluster")
    a = draw(1.0)
    v[...], w[...] = -1e3 * a, 0.0
    kernels.turn(v, w, a, 50.0, squares, *tables)
    np.testing.assert_allclose([u @ u for u in parts(v, tables)], squares, rtol=1e-13)
    v[...], w[...] = 0.0, 1.0
    kernels.turn(v, w, a, 0.5, squares, *tables)
    for u, f in zip(parts(v, tables), parts(a, tables), strict=True):
        assert u @ f == pytest.approx(np.linalg.norm(u) * np.linalg.norm(f), rel=1e-12) and u @ f > 0


def test_the_bath_leaves_the_uniform_distribution():
    """On the sphere of one free atom: y stays uniform, and forgets at the rate asked for."""
    n = 30_000
    cluster, spheres = np.arange(n), np.full((n, 4), -1)
    spheres[:, :3] = np.arange(n)[:, None]
    tables = cluster, spheres, np.ones(n), np.ones(n)
    rng, squares = np.random.default_rng(2), np.full(n, 3.0)
    v, w = rng.normal(size=(n, 3)), rng.normal(size=(n, 1))
    kernels.rescale(v, w, squares, True, *tables)
    for _ in range(3):
        kernels.stir(v, w, rng.normal(size=(n, 3)), rng.normal(size=(n, 1)), 0.6, 0.8, squares, *tables)
    y = np.concatenate([v, w], axis=1) / np.sqrt(3)
    np.testing.assert_allclose((y**2).mean(axis=0), 1 / 4, rtol=0, atol=4.5 * np.sqrt((1 / 8 - 1 / 16) / n))
    np.testing.assert_allclose((y**4).mean(axis=0), 1 / 8, rtol=0, atol=4.5 * 0.15 / np.sqrt(n))
    np.testing.assert_allclose(y.mean(axis=0), 0, atol=4.5 * 0.5 / np.sqrt(n))
