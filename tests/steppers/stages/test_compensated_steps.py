"""A step's sums: what is added up is the exact sum, rounded once."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from kcons.steppers.stages.compensated_steps import Point

ATOMS = 5


def arrays(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, ATOMS, 3))


def exact_flight(x, v, w, stages):
    """Position and velocity after kicks (h, f) and flights h, in rational numbers."""
    q = [Fraction(a) for a in x.ravel()]
    u = [Fraction(a) for a in v.ravel()]
    for h_kick, f, h in stages:
        u = [a + Fraction(h_kick) * Fraction(b) * Fraction(c) for a, b, c in zip(u, w.ravel(), f.ravel(), strict=True)]
        q = [a + Fraction(h) * b for a, b in zip(q, u, strict=True)]
    return (np.array([float(a) for a in values]).reshape(x.shape) for values in (q, u))


def fly(point: Point, stages) -> None:
    for h_kick, f, h in stages:
        point.kick(h_kick, f)
        out = np.empty_like(point.x)
        point.fly(h, out)
        point.x = out


@pytest.mark.parametrize("exact", [True, False])
def test_one_stage(exact) -> None:
    x, v, f = arrays(3)
    w = np.full((ATOMS, 3), 0.5)
    point = Point(x, v, w, exact=exact)
    fly(point, [(0.25, f, 0.5)])
    point.land()
    q, u = exact_flight(x, v, w, [(0.25, f, 0.5)])
    np.testing.assert_allclose(point.x, q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(point.v, u, rtol=0, atol=1e-15)


def test_many_stages_round_once() -> None:
    """A hundred stages forth and back leave what one rounding does; a plain sum loses more."""
    x, v = 3 + arrays(2)
    w = np.abs(arrays(1, 2)[0]) + 0.1
    stages = [(h, f, -3 * h) for h, f in zip(0.01 * np.sin(np.arange(100)), arrays(100, 3), strict=True)]
    point = Point(x, v, w, exact=True)
    fly(point, stages)
    point.land()
    q, u = exact_flight(x, v, w, stages)
    assert np.abs(point.x - q).max() <= np.spacing(4.0)
    assert np.abs(point.v - u).max() <= np.spacing(4.0)
    plain = Point(x, v, w, exact=False)
    fly(plain, stages)
    assert np.abs(plain.x - q).max() > 2 * np.spacing(4.0)


@pytest.mark.parametrize("exact", [True, False])
def test_what_came_in_stays_as_it_was(exact) -> None:
    x, v, f = arrays(3)
    before = x.copy(), v.copy(), f.copy()
    point = Point(x, v, np.ones((ATOMS, 3)), exact=exact)
    seen = []
    for k in range(3):
        point.kick(0.1, f)
        out = np.empty_like(x)
        push = point.fly(0.1, out)
        push += 0.01 * k
        seen.append((point.x, point.x.copy()))
        point.x = out
    point.land()
    for array, copy in [*zip((x, v, f), before, strict=True), *seen]:
        assert np.array_equal(array, copy)


@pytest.mark.parametrize("exact", [True, False])
def test_changes_on_the_way_belong_to_the_velocity(exact) -> None:
    x, v, change = arrays(3)
    point = Point(x, v, np.ones((ATOMS, 3)), exact=exact)
    out = np.empty_like(x)
    push = point.fly(0.5, out)
    push += change
    point.x = out
    point.land()
    np.testing.assert_allclose(point.v, v + change, rtol=0, atol=2e-15)
    last = np.empty_like(x)
    point.fly(0.5, last)
    np.testing.assert_allclose(last, x + 0.5 * v + 0.5 * (v + change), rtol=0, atol=4e-15)


@pytest.mark.parametrize("exact", [True, False])
def test_kicks_without_a_flight_between(exact) -> None:
    x, v, f, g = arrays(4)
    w = np.full((ATOMS, 3), 2.0)
    point = Point(x, v, w, exact=exact)
    point.kick(0.5, f)
    point.kick(0.25, g)
    point.land()
    np.testing.assert_allclose(point.v, v + f + 0.5 * g, rtol=0, atol=2e-15)
    assert point.x is x and point.v is not v


@pytest.mark.parametrize("exact", [True, False])
def test_landing_and_starting_again(exact) -> None:
    x, v, other = arrays(3)
    point = Point(x, v, np.ones((ATOMS, 3)), exact=exact)
    point.land()
    point.restart(other)
    out = np.empty_like(x)
    point.fly(1.0, out)
    np.testing.assert_allclose(out, x + other, rtol=0, atol=1e-15)
    assert not np.array_equal(v, point.v)
