"""Langevin dynamics with several time steps: against the plain scheme, order, nesting, restarts, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from thermostat_systems import dumbbells, molecules, quartic, springs, system, waves

from kcons.constraints import Distance, FixedAtoms, MovingTarget
from kcons.steppers import System, run
from kcons.thermostats import ForceGroups, Langevin, LangevinRespa

TWO = {"slow": 1, "fast": 4}


def gentle(x, t):
    return 0.3 * waves(x)


def stiff(x, t):
    return -np.linspace(2.0, 4.0, len(x))[:, None] * x


def grouped(motion, **groups):
    return System(motion, ForceGroups(groups))


def test_one_group_is_geodesic_langevin_to_the_last_bit():
    held, state = molecules("bent", 3, ions=1)
    one = run(held, state, 0.05, 15, stepper=Langevin(0.5, 1.0, 3))
    two = run(held, state, 0.05, 15, stepper=LangevinRespa(0.5, 1.0, 3))
    for name in ("positions", "velocities", "forces", "thermostat"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_slow_forces_of_zero_change_nothing():
    """But for the rounding of velocities, which plain steps project once more often."""
    held, state = molecules("bent", 3, ions=1)
    split = grouped(held.motion, fast=springs, slow=lambda x, t: 0 * x)
    one = run(held, state, 0.02, 40, stepper=Langevin(0.5, 0.0, 3))
    two = run(split, state, 0.08, 10, stepper=LangevinRespa(0.5, 0.0, 3, steps=TWO))
    np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(one.velocities, two.velocities, rtol=0, atol=1e-13)
    assert split.force.evaluations == {"fast": 41, "slow": 11}


@pytest.mark.parametrize("steps", [TWO, {"slow": 1, "medium": 2, "fast": 6}])
def test_it_is_of_order_two(steps):
    held, x = dumbbells(2)
    groups = {"fast": stiff, "slow": gentle} | ({"medium": lambda x, t: 0.1 * quartic(x)} if len(steps) == 3 else {})
    split = grouped(held.motion, **groups)
    state = held.initial_state(x, 0.3 * np.random.default_rng(1).normal(size=x.shape), project=True)
    stepper = LangevinRespa(0.5, 0.0, 3, steps=steps)
    known = run(split, state, 1 / 512, 512, stepper=Langevin(0.5, 0.0, 3))
    errors = [
        np.abs(run(split, state, 1 / n, n, stepper=stepper).positions - known.positions).max() for n in (8, 16, 32)
    ]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert slopes == pytest.approx([2, 2], abs=0.25)


def test_slow_kicks_in_the_middle_are_of_order_two_and_made_once():
    held, x = dumbbells(2)
    split = grouped(held.motion, fast=stiff, slow=gentle)
    state = held.initial_state(x, 0.3 * np.random.default_rng(1).normal(size=x.shape), project=True)
    stepper = LangevinRespa(0.5, 0.0, 3, steps=TWO, slow_kicks="middle")
    known = run(split, state, 1 / 512, 512, stepper=Langevin(0.5, 0.0, 3))
    ends = [run(split, state, 1 / n, n, stepper=stepper) for n in (8, 16, 32)]
    errors = [np.abs(end.positions - known.positions).max() for end in ends]
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([2, 2], abs=0.25)
    split.force.evaluations.update(fast=0, slow=0)
    assert run(split, state, 0.1, 3, stepper=stepper).forces is None
    assert split.force.evaluations == {"fast": 3 * 5, "slow": 3}


def test_each_exchange_of_a_step_has_noise_of_its_own():
    """Drawn for the seed, the step and its place in it, also where several steps are made at once."""
    held = system([], np.eye(3)[:2], [1.0, 3.0])
    split = grouped(held.motion, fast=lambda x, t: 0 * x, slow=lambda x, t: 0 * x)
    thermostat, v = LangevinRespa(0.5, 1.0, 3, steps=TWO), np.ones((2, 3))
    end = thermostat.march(split, split.initial_state(np.eye(3)[:2], v), 0.1, 3)
    keep, spread = math.exp(-0.1 / 4), math.sqrt(-math.expm1(-2 * 0.1 / 4) * 0.5)
    for number in (1, 2, 3):
        for part in range(4):
            v = keep * v + spread * thermostat.drawn(number, v.shape, part) * split.root_weights
    np.testing.assert_allclose(end.velocities, v, rtol=1e-13)


def test_targets_that_move_are_met_in_each_inner_step():
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    length = MovingTarget(lambda t: 1 + 0.3 * math.sin(4 * t), lambda t: 1.2 * math.cos(4 * t))
    rows = [FixedAtoms([0]), Distance([0, 1], length)]
    held, _ = dumbbells(1)
    motion = type(held.motion)(type(held.motion.constraint_set)(rows, x, np.ones(2)), x)
    split = grouped(motion, fast=lambda x, t: 0 * x, slow=lambda x, t: 0 * x + 0.0)
    state = split.initial_state(x, [[0, 0, 0], [1.2, 0.9, 0.0]])
    end = run(split, state, 0.24, 5, stepper=LangevinRespa(0.5, 0.0, 3, steps=TWO, substeps=1))
    known = run(split, state, 0.03, 40)
    np.testing.assert_allclose(end.positions, known.positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(end.velocities, known.velocities, rtol=0, atol=1e-12)
