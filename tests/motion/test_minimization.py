"""Minima of potentials on constraints."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import Angle, Distance, FixedAtoms, MovingTarget, Sphere
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


SPRINGS = (0, 3, 3.6), (1, 4, 3.6), (0, 4, 4.8)


def stretching(x):
    return 0.5 * sum((np.linalg.norm(x[i] - x[j]) - length) ** 2 for i, j, length in SPRINGS)


def springs(x, t):
    f = np.zeros_like(x)
    for i, j, length in SPRINGS:
        d = x[j] - x[i]
        r = np.linalg.norm(d)
        f[i] += (r - length) * d / r
        f[j] -= (r - length) * d / r
    return f


def test_it_is_where_dynamics_with_friction_comes_to_rest():
    """Bonds and angles held, a fixed atom; compared with the equation of motion itself, and with no constraint."""
    x = np.cumsum([[0.0, 0, 0], [1.2, 0.6, 0.1], [1.2, -0.6, 0.3], [1.0, 0.6, -0.5], [1.2, -0.5, 0.2]], axis=0)
    rows = [Distance([[k, k + 1] for k in range(4)]), Angle([[0, 1, 2], [1, 2, 3], [2, 3, 4]]), FixedAtoms([0])]
    motion = Motion(ConstraintSet(rows, x, [12.0, 12, 1, 12, 16]), x)
    found = minimize(motion, springs, x, tolerance=1e-10, longest=0.1)
    acceleration = motion.acceleration(found.positions, np.zeros_like(x), springs(found.positions, 0))
    assert np.abs(acceleration).max() < 1e-9
    assert np.abs(motion.constraint_set.value(found.positions)).max() < 1e-13
    np.testing.assert_array_equal(found.positions[0], x[0])
    # A minimum: every small motion along the constraints costs energy.
    rng = np.random.default_rng(0)
    for _ in range(10):
        v = motion.project_velocities(found.positions, rng.normal(size=x.shape))
        there = motion.project_positions(found.positions + 1e-3 * v, found.positions)
        assert stretching(there) > stretching(found.positions)


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
