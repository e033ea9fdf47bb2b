"""Langevin dynamics with several time steps: against the plain scheme, order, nesting, restarts, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from thermostat_systems import dumbbells, molecules, quartic, springs, waves

from kcons.constraints import Distance, FixedAtoms, MovingTarget
from kcons.steppers import System, run
from kcons.thermostats import ForceGroups, IsokineticSpheres, Langevin, LangevinRespa
from kcons.thermostats.langevin import MASSES, LangevinStep

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


@pytest.mark.parametrize(("steps", "order"), [(TWO, 2), ({"slow": 1, "medium": 2, "fast": 6}, 2), (TWO, 4)])
def test_it_is_of_order_two(steps, order):
    held, x = dumbbells(2)
    groups = {"fast": stiff, "slow": gentle} | ({"medium": lambda x, t: 0.1 * quartic(x)} if len(steps) == 3 else {})
    split = grouped(held.motion, **groups)
    state = held.initial_state(x, 0.3 * np.random.default_rng(1).normal(size=x.shape), project=True)
    stepper = LangevinRespa(0.5, 0.0, 3, steps=steps, order=order)
    known = run(split, state, 1 / 512, 512, stepper=Langevin(0.5, 0.0, 3))
    errors = [
        np.abs(run(split, state, 1 / n, n, stepper=stepper).positions - known.positions).max() for n in (8, 16, 32)
    ]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert slopes == pytest.approx([2, 2], abs=0.25)


def test_an_inner_scheme_of_order_four():
    """Without slow forces the whole is of order 4."""
    held, x = dumbbells(2)
    split = grouped(held.motion, fast=waves, slow=lambda x, t: 0 * x)
    state = held.initial_state(x, 0.3 * np.random.default_rng(1).normal(size=x.shape), project=True)
    stepper = LangevinRespa(0.5, 0.0, 3, steps={"slow": 1, "fast": 2}, order=4)
    known = run(split, state, 1 / 32, 32, stepper=stepper)
    errors = [np.abs(run(split, state, 1 / n, n, stepper=stepper).positions - known.positions).max() for n in (2, 4, 8)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert slopes == pytest.approx([4, 4], abs=0.5)


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


def test_each_exchange_of_a_step_has_noise_of_its_own(monkeypatch):
    """Drawn for the seed, the step and its place in it, also where several steps are made at once."""
    held, state = molecules("bent", 2)
    split = grouped(held.motion, fast=springs, slow=gentle)
    thermostat, seen = LangevinRespa(0.5, 1.0, 3, steps=TWO, conserve_momentum=True), []
    made = LangevinStep.exchange

    def noted(self, row, begun):
        seen.append((self.number, self.numbers[MASSES + 2 * self.v.size :].reshape(self.v.shape).copy()))
        made(self, row, begun)

    monkeypatch.setattr(LangevinStep, "exchange", noted)
    thermostat.march(split, state, 0.1, 3)
    assert [number for number, _ in seen] == [1] * 4 + [2] * 4 + [3] * 4
    spread = math.sqrt(-math.expm1(-2 * 0.1 / 4) * 0.5)
    for k, (number, noise) in enumerate(seen):
        drawn = thermostat.drawn(number, noise.shape, k % 4)
        np.testing.assert_allclose(noise, spread * drawn * split.root_weights, rtol=1e-14)


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


def test_words():
    lines = LangevinRespa(0.5, 1.0, 3, steps=TWO).listing().splitlines()
    assert lines[1].endswith("change velocities by forces: slow")
    assert [line.endswith("forces at the new positions: fast") for line in lines].count(True) == 4
    assert "at constant kinetic energy: slow" in IsokineticSpheres(0.5, 1.0, 3, steps=TWO).listing()
