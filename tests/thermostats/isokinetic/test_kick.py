"""The closed form of the kick against tanh and an integration, for forces of any size."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kcons.thermostats.isokinetic import kick

RNG = np.random.default_rng(5)
MASSES = np.repeat(RNG.uniform(0.5, 3.0, (4, 1)), 3, axis=1)


def kicked(u, pace, t, masses=MASSES):
    uu, up, pp = kick.sums(u, pace, masses)
    keep, push, log_growth, cancels = kick.weights_of(up, pp, uu, t)
    if cancels:
        return kick.turned(u, pace, masses, uu, t)
    return keep * u + push * pace, log_growth


def by_angle(u, pace, t):
    """u along the force is U tanh(ct + b), and across it falls off as 1/cosh(ct + b)."""
    root = np.sqrt(MASSES)
    a, b = root * u, root * pace
    largest = np.abs(b).max()
    size, strength = np.linalg.norm(a), np.linalg.norm(b / largest) * largest
    e = b / strength
    along = (a * e).sum()
    across = a - along * e
    begin = math.atanh(along / size)
    end = strength / size * t + begin
    ratio = math.exp(math.log(math.cosh(begin)) - abs(end) - math.log1p(math.exp(-2 * abs(end))) + math.log(2))
    return (size * math.tanh(end) * e + ratio * across) / root


@pytest.mark.parametrize("strength", [0.0, 1e-300, 1e-12, 1e-6, 1.0, 50.0, 1e3, 1e6, 1e12, 1e100, 1e200])
@pytest.mark.parametrize("t", [0.01, -0.01])
def test_any_strength(strength, t):
    u, pace = RNG.standard_normal((2, 4, 3))
    pace *= strength
    after, growth = kicked(u, pace, t)
    uu, up, _ = kick.sums(u, pace, MASSES)
    assert kick.square_sum(after, MASSES) == pytest.approx(uu, rel=3e-14)
    if strength > 1e-200:
        np.testing.assert_allclose(after, by_angle(u, pace, t), rtol=1e-13, atol=1e-13)
    else:
        np.testing.assert_allclose(after, u, rtol=1e-15)
    if strength * 0.01 > 100:
        e = pace / np.abs(pace).max()
        np.testing.assert_allclose(
            after, math.copysign(1, t) * e * math.sqrt(uu / kick.square_sum(e, MASSES)), rtol=1e-12
        )
    if strength <= 1e-6:  # log of the growth is the integral of alpha
        assert growth == pytest.approx(t * up / uu, rel=1e-6)
    assert math.isfinite(growth)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("z", [1e-3, 1.0, 10.0, 30.0, 800.0])
def test_against_the_force(tilt, z):
    """u + sF and s' are then differences of nearly equal numbers."""
    pace = RNG.standard_normal((4, 3))
    side = RNG.standard_normal((4, 3))
    side -= pace * (MASSES * side * pace).sum() / (MASSES * pace * pace).sum()
    u = -pace + tilt * side
    uu, _, pp = kick.sums(u, pace, MASSES)
    t = z * math.sqrt(uu / pp)
    after, growth = kicked(u, pace, t)
    assert kick.square_sum(after, MASSES) == pytest.approx(uu, rel=3e-13)
    assert math.isfinite(growth)
    # q/(1 + p) = tan of half the angle falls off as e^-z
    q = tilt * math.sqrt((MASSES * side * side).sum() / uu)
    p = math.copysign(math.sqrt(max(1 - q * q, 0)), -1)
    begin = math.log((1 - p) / q) if q else math.inf
    cosine = (MASSES * after * pace).sum() / math.sqrt(uu * pp)
    if math.isinf(begin):
        if z < 30:  # beyond, rounding decides
            assert cosine == pytest.approx(-1, abs=1e-3)
    elif q > 1e-9 or z < 20:
        assert cosine == pytest.approx(math.tanh(z - begin), abs=1e-6)


def test_the_equation_itself():
    u, pace = RNG.standard_normal((2, 4, 3))
    uu = kick.square_sum(u, MASSES)

    def slope(t, y):
        v = y[:-1].reshape(4, 3)
        alpha = (MASSES * v * pace).sum() / uu
        return np.append((pace - alpha * v).ravel(), alpha)

    for t in (0.7, 5.0, -3.0):
        found = solve_ivp(slope, (0, t), np.append(u.ravel(), 0.0), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        after, growth = kicked(u, pace, t)
        np.testing.assert_allclose(after.ravel(), found[:-1], atol=1e-10)
        assert growth == pytest.approx(found[-1], abs=1e-10)


def test_nan_is_not_hidden():
    u, pace = RNG.standard_normal((2, 4, 3))
    pace[1, 1] = np.nan
    with np.errstate(all="ignore"):
        assert np.isnan(kicked(u, pace, 0.1)[0]).any()
