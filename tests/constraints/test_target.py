"""Targets: numbers, functions of time, and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons import constraints as held
from kcons.constraints import Dihedral, Distance
from kcons.constraints.target import MovingTarget
from kcons.errors import InputError


@pytest.mark.parametrize("given", [{}, {"rate": np.cos}, {"rate": np.cos, "acceleration": lambda t: -np.sin(t)}])
def test_derivatives_given_or_differenced(given):
    target = MovingTarget(np.sin, **given)
    for time in (0.0, 0.7, 3.0, 1e3, 1e6, 1e9):  # late times are rounded, and steps of differences made for it
        assert target.rate_at(time, 2) == pytest.approx([np.cos(time)] * 2, abs=1e-13)
        assert target.acceleration_at(time, 2) == pytest.approx([-np.sin(time)] * 2, abs=1e-11)


HUGE = {
    "Distance": lambda t: Distance([0, 1], t),
    "center": lambda t: held.Sphere(0, [t, 1.0, 1.0], None),
    "major radius": lambda t: held.Torus(0, [1.0, 1.0, 1.0], [0, 0, 1.0], abs(t), 1.0),
    "point": lambda t: held.Line(0, [t, 0, 0], [0, 0, 1.0]),
    "coefficients": lambda t: held.LinearCombination([0, 1], [[t, 0, 0], [-t, 0, 0]]),
    "LinearRelation": lambda t: held.LinearRelation(0, [1, 2], [0.5, 0.5], [[t, 0, 0]]),
    "FixedAtoms": lambda t: held.FixedAtoms([0], [[t, 0, 0]]),
    "parameter": lambda t: held.Formula("x1 - a", 0, {"a": t}),
    "velocity": lambda t: held.VelocityFormula("vx1", 0, target=t),
}


@pytest.mark.parametrize("large", [1.1e150, 1e155, -1e200, 1e308])
@pytest.mark.parametrize("make", HUGE.values(), ids=HUGE)
def test_numbers_whose_squares_overflow_are_refused(make, large):
    with pytest.raises(InputError, match="of which the square overflows; choose other units"):
        make(large)
    make(0.9e150)


def test_a_moving_target_is_refused_when_it_becomes_too_large():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    target = MovingTarget(lambda t: 1.0 if t < 0.5 else 1e160, lambda t: 0.0, lambda t: 0.0)
    motion = Motion(ConstraintSet(Distance([0, 1], target), x, np.ones(2)), x)
    new, kept = x.copy(), x.copy()
    with pytest.raises(InputError, match=r"target of row 0 at t = 1 is 1e\+160, of which the square overflows"):
        motion.project_positions(new, x, time=1.0, out=new)
    np.testing.assert_array_equal(new, kept)


def test_derivatives_that_contradict_a_moving_target_are_refused():
    """They would move the atoms off it without another sign."""
    x, masses = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.ones(2)
    right = MovingTarget(lambda t: 1 + 0.01 * np.sin(t), lambda t: 0.01 * np.cos(t), lambda t: -0.01 * np.sin(t))
    ConstraintSet(Distance([[0, 1]], right), x, masses)
    kinked = MovingTarget(lambda t: 1 + 0.01 * max(t, 0.026), lambda t: 0.01 * (t > 0.026))
    ConstraintSet(Distance([[0, 1]], kinked), x, masses)
    for rate, acceleration, said in (
        (lambda t: -0.01 * np.cos(t), None, "its rate is -0.00"),
        (lambda t: 0.01 * np.cos(t), lambda t: 0.01 * np.cos(t), "its acceleration is 0.0"),
    ):
        target = MovingTarget(right.value, rate, acceleration)
        with pytest.raises(InputError, match=said):
            ConstraintSet(Distance([[0, 1]], target), x, masses)


def test_a_target_that_jumps_by_its_period_does_not_move_faster_there():
    x = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, -1.0, 0.0]])

    def turning(t):
        return (0.5 * t**2 + t + 2 * np.pi) % (2 * np.pi) - np.pi

    for target in (turning, MovingTarget(turning, lambda t: t + 1)):
        item = Dihedral([[0, 1, 2, 3], [3, 2, 1, 0]], target).select([0])
        held = ConstraintSet(item, x, np.ones(4))
        assert held.velocity_target(x) == pytest.approx([1.0], rel=1e-11)
        assert held.acceleration_target(x, 0 * x) == pytest.approx([1.0], rel=1e-9)


def test_a_target_too_fast_for_its_differences_is_refused():
    x, masses = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.ones(2)

    def fast(t):
        return 1 + 0.01 * np.sin(300 * t)

    for target in (fast, MovingTarget(fast, lambda t: 3 * np.cos(300 * t))):
        with pytest.raises(InputError, match=r"changes within less than the step of its differences, 0\.02; give"):
            ConstraintSet(Distance([[0, 1]], target), x, masses)
    held = ConstraintSet(Distance([[0, 1]], MovingTarget(fast, time_step=1e-4)), x, masses)
    assert held.velocity_target(x) == pytest.approx([3.0], rel=1e-9)
    for kink in (0.0, 0.1, 0.3):
        ConstraintSet(Distance([[0, 1]], lambda t, kink=kink: 1 + 0.01 * max(t - kink, 0.0)), x, masses)
