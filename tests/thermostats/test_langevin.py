"""Geodesic BAOAB: moving targets, noise of each exchange, numbers drawn in kernels, forces in groups."""

from __future__ import annotations

import math
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from thermostat_systems import TWO, dumbbells, grouped, started, system, waves

from kcons.constraints import Distance, FixedAtoms, MovingTarget, Sphere
from kcons.steppers import run
from kcons.thermostats import ForceGroups, Langevin, LangevinRespa, thermal_velocities
from kcons.thermostats.noise import fill_normal, noise_generator


def test_moving_targets_are_followed_and_friction_knows_their_speed():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([Distance([[0, 1]], lambda t: 1 + 0.5 * t), Sphere([0], [0, 0, -1.0], 1.0)], x, [1.0, 3.0], waves)
    state = held.initial_state(x, thermal_velocities(held, x, 0.5, 3))
    after = run(held, state, 0.01, 200, stepper=Langevin(0.5, 50.0, 3))
    d = after.positions[1] - after.positions[0]
    assert np.linalg.norm(d) == pytest.approx(2.0, rel=1e-13)
    assert d @ (after.velocities[1] - after.velocities[0]) / 2 == pytest.approx(0.5, rel=1e-12)


def test_threads_share_a_bath():
    """Each with a System of its own."""
    bath, interval = Langevin(0.5, 1.0, 3), sys.getswitchinterval()
    begun = [started() for _ in range(3)]
    alone = [run(held, state, 0.01, 200, stepper=bath) for held, state in begun]
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as threads:
            together = list(threads.map(lambda made: run(*made, 0.01, 200, stepper=bath), begun))
    finally:
        sys.setswitchinterval(interval)
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one.positions, other.positions)


@pytest.mark.parametrize("substeps", [1, 3])
def test_each_substep_meets_targets_at_its_own_time(substeps):
    """Without forces, friction and noise a step is as many steps of RATTLE, with a rod that grows and shrinks."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    length = MovingTarget(lambda t: 1 + 0.3 * math.sin(4 * t), lambda t: 1.2 * math.cos(4 * t))
    held = system([FixedAtoms([0]), Distance([0, 1], length)], x, np.ones(2))
    state = held.initial_state(x, [[0, 0, 0], [1.2, 0.9, 0.0]])
    dt = 0.12
    end = run(held, state, dt, 5, stepper=Langevin(0.5, 0.0, 3, substeps=substeps))
    known = run(held, state, dt / (2 * substeps), 5 * 2 * substeps)
    np.testing.assert_allclose(end.positions, known.positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(end.velocities, known.velocities, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", [0, 7, 2**63, 2**64 - 1])
@pytest.mark.parametrize(("number", "part"), [(1, 0), (10**9, 3), (0, 2**63)])
def test_numbers_are_those_of_numpy_to_the_last_bit(seed, number, part) -> None:
    """So many that all layers of the ziggurat and its tail are met."""
    found = np.empty(20_001)
    fill_normal(np.uint64(seed), np.uint64(number), np.uint64(part), found)
    np.testing.assert_array_equal(found, noise_generator((seed, 0), number, part).standard_normal(20_001))
    assert np.abs(found).max() > 3.66  # beyond the last layer


# -- several time steps ----------------------------------------------------------------------------


X = np.random.default_rng(0).normal(size=(4, 3))


def test_a_difference_does_not_trust_an_array_that_is_used_again():
    shared = np.empty_like(X)

    def one(x, t):
        shared[...] = x
        return shared

    def two(x, t):
        shared[...] = 2 * x
        return shared

    np.testing.assert_array_equal(ForceGroups.difference(one, two).of("slow", X, 0.0), X)


def test_slow_kicks_in_the_middle_are_made_once():
    held, x = dumbbells(2)
    split = grouped(held.motion, fast=lambda x, t: -3.0 * x, slow=waves)
    state = held.initial_state(x, 0.3 * np.random.default_rng(1).normal(size=x.shape), project=True)
    stepper = LangevinRespa(0.5, 0.0, 3, steps=TWO, slow_kicks="middle")
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
