"""A step's sums: what is added up is the exact sum, rounded once."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from kcons.errors import NonFiniteError
from kcons.steppers.stages import compiled_operations as compiled

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


def flown(x, v, w, stages, pairs: bool):
    """The same by the loops of the kernel: positions, velocities, and whether all forces were finite."""
    v, sound = v.copy(), True
    low, push = np.zeros_like(x), np.zeros_like(x)
    for kick, f, h in stages:
        out = np.empty_like(x)
        if pairs:
            sound &= compiled.fly(x, low, v, push, kick, f, w, h, out)
        else:
            sound &= compiled.fly_once(x, v, kick, f, w, h, out)
        x = out
    if pairs:
        assert compiled.land(v, push, 0.0, w, w) and not push.any()
    return x, v, sound


@pytest.mark.parametrize("pairs", [True, False])
def test_one_stage(pairs) -> None:
    x, v, f = arrays(3)
    w = np.full((ATOMS, 3), 0.5)
    there, after, sound = flown(x, v, w, [(0.25, f, 0.5)], pairs)
    q, u = exact_flight(x, v, w, [(0.25, f, 0.5)])
    assert sound
    np.testing.assert_allclose(there, q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(after, u, rtol=0, atol=1e-15)


def test_many_stages_round_once() -> None:
    """A hundred stages forth and back leave what one rounding does; a plain sum loses more."""
    x, v = 3 + arrays(2)
    w = np.abs(arrays(1, 2)[0]) + 0.1
    stages = [(h, f, -3 * h) for h, f in zip(0.01 * np.sin(np.arange(100)), arrays(100, 3), strict=True)]
    q, u = exact_flight(x, v, w, stages)
    there, after, _ = flown(x, v, w, stages, True)
    assert np.abs(there - q).max() <= np.spacing(4.0)
    assert np.abs(after - u).max() <= np.spacing(4.0)
    assert np.abs(flown(x, v, w, stages, False)[0] - q).max() > 2 * np.spacing(4.0)


def test_kicks_without_a_flight_and_changes_on_the_way() -> None:
    v, f, change = arrays(3)
    w, push = np.full((ATOMS, 3), 2.0), 0.01 * change
    plain, paired = v.copy(), v.copy()
    assert compiled.add_kick(plain, 0.5, f, w) and compiled.land(paired, push, 0.5, f, w)
    np.testing.assert_allclose(plain, v + f, rtol=0, atol=2e-15)
    np.testing.assert_allclose(paired, v + f + 0.01 * change, rtol=0, atol=2e-15)
    assert not push.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_forces_that_are_not_finite_are_seen_where_they_kick(bad) -> None:
    x, v, f = arrays(3)
    w = np.ones((ATOMS, 3))
    f[3, 1] = bad
    for pairs in (True, False):
        assert not flown(x, v, w, [(0.1, f, 0.5)], pairs)[2]
    assert not compiled.add_kick(v.copy(), 0.1, f, w) and not compiled.land(v.copy(), x * 0, 0.1, f, w)
    assert compiled.add_kick(v.copy(), 0.0, f, w)
    with pytest.raises(NonFiniteError, match="non-finite force at step 7 on atom 3") as caught:
        compiled.check_finite(f, "force", 7)
    assert (caught.value.item, caught.value.atom, caught.value.step) == ("force", 3, 7)


def test_far_is_measured_by_the_size_of_what_is_held() -> None:
    x = np.array([[100.0, 0.0, 0.0], [100.0, 9.0, 0.0], [100.0, 0.0, 60.0]])
    held = np.array([0, 1])
    assert compiled.beyond(x, held, 0, 8.0)
    assert not compiled.beyond(x, held, 0, 12.0)
    assert not compiled.beyond(x, np.array([0, 1, 2]), 0, 8.0)
