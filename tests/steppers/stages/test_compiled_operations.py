"""A step's sums: what is added up is the exact sum, rounded once."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from kcons.steppers import compiled_operations as compiled


def test_many_stages_round_once() -> None:
    """A hundred kicks and flights leave what one rounding does; a plain sum loses more."""
    rng = np.random.default_rng(1)
    x, v, w = 3 + rng.normal(size=(5, 3)), 3 + rng.normal(size=(5, 3)), rng.uniform(0.1, 1, (5, 3))
    q, u, inverse = ([Fraction(a) for a in values.ravel()] for values in (x, v, w))
    y, plain, low, push = x, v.copy(), np.zeros_like(x), np.zeros_like(x)
    for kick in 0.01 * np.sin(np.arange(100)):
        f, h, there, along = rng.normal(size=(5, 3)), -3 * kick, np.empty_like(x), np.empty_like(x)
        assert compiled.fly(x, low, v, push, kick, f, w, h, there)
        assert compiled.fly_once(y, plain, kick, f, w, h, along)
        x, y = there, along
        u = [a + Fraction(kick) * b * Fraction(c) for a, b, c in zip(u, inverse, f.ravel(), strict=True)]
        q = [a + Fraction(h) * b for a, b in zip(q, u, strict=True)]
    assert compiled.land(v, push, 0.0, w, w) and not push.any()
    for found, exact in ((x, q), (v, u)):
        assert np.abs(found.ravel() - np.array([float(a) for a in exact])).max() <= np.spacing(4.0)
    assert np.abs(y.ravel() - np.array([float(a) for a in q])).max() > 2 * np.spacing(4.0)
