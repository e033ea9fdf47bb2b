"""Minima of potentials on constraints."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import MovingTarget, Sphere
from kcons.errors import ConvergenceError, InputError, NonFiniteError
from kcons.motion import minimize


def repulsion(x, t):
    d = x[:, None] - x[None]
    r = np.linalg.norm(d, axis=-1) + np.eye(len(x))
    return np.sum(d / r[..., None] ** 3, axis=1)


@pytest.mark.parametrize("masses", [np.ones(12), np.geomspace(1, 200, 12)], ids=["equal", "unequal"])
def test_twelve_charges_on_a_sphere_make_an_icosahedron(masses):
    """Thomson's problem; its energy from Wales and Ulker, Phys. Rev. B 74, 212101 (2006)."""
    x = np.random.default_rng(1).normal(size=(12, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    motion = Motion(ConstraintSet(Sphere(range(12), [0, 0, 0], 1.0), x, masses), x)
    found = minimize(motion, repulsion, x, tolerance=1e-9, longest=0.2)
    assert found.largest < 1e-9
    np.testing.assert_allclose(np.linalg.norm(found.positions, axis=1), 1, rtol=1e-14)
    r = np.linalg.norm(found.positions[:, None] - found.positions[None], axis=-1)
    assert np.sum(1 / r[np.triu_indices(12, 1)]) == pytest.approx(49.165253058, abs=1e-8)
    assert found.evaluations < 150


def test_moving_targets_hold_still_at_their_time():
    x = np.array([[1.0, 0.2, 0.0]])
    motion = Motion(
        ConstraintSet(Sphere([0], [0, 0, 0], MovingTarget(lambda t: 1 + t, lambda t: 1.0, lambda t: 0.0)), x, [1.0]), x
    )
    found = minimize(motion, lambda x, t: np.array([[0.0, t, 0.0]]), x, tolerance=1e-10, longest=0.3, time=2.0)
    np.testing.assert_allclose(found.positions, [[0, 3, 0]], atol=1e-9)


def test_what_stops_it():
    x = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    motion = Motion(ConstraintSet(Sphere([0, 1], [0, 0, 0], 1.0), x, [1.0, 1.0]), x)
    with pytest.raises(NonFiniteError, match="force on atom 1 is not finite"):
        minimize(motion, lambda x, t: np.array([[0, 0, 0], [0, np.nan, 0]]), x, tolerance=1e-6, longest=0.1)
    with pytest.raises(ConvergenceError, match=r"after 3 steps, and not 1e-12; give more steps") as stopped:
        minimize(motion, repulsion, x, tolerance=1e-12, longest=0.01, steps=3)
    assert np.abs(stopped.value.positions - x).max() > 0.01
    back = np.array([[0, 1.0, 0], [0, 0, 0]])  # where it has gone it is told to go back
    with pytest.raises(ConvergenceError, match="no gradient, or not so exact") as stopped:
        minimize(
            motion,
            lambda y, t: back if np.allclose(y, x, rtol=0, atol=1e-12) else -3 * back,
            x,
            tolerance=1e-12,
            longest=0.1,
        )
    np.testing.assert_allclose(stopped.value.positions, x, atol=1e-12)
    for wrong in ({"tolerance": 0.0, "longest": 0.1}, {"tolerance": 1e-6, "longest": np.nan}):
        with pytest.raises(InputError, match="give a positive number"):
            minimize(motion, repulsion, x, **wrong)
    with pytest.raises(InputError, match="force"):
        minimize(motion, lambda x, t: np.zeros(3), x, tolerance=1e-6, longest=0.1)
