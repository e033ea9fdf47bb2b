"""Forces in groups, a step with several time steps as a list of operations, and Langevin dynamics made of them."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from thermostat_systems import dumbbells, quartic, springs, system, waves

from kcons.errors import InputError, UnsupportedError
from kcons.steppers import System, run
from kcons.steppers.operations import Evaluate, Exchange, Fly, Kick, Project, Turn
from kcons.thermostats import ForceGroups, LangevinRespa
from kcons.thermostats.force_groups import group_names, levels_of, nested

X = np.random.default_rng(0).normal(size=(4, 3))


def test_the_sum_and_how_often_each_was_asked_for():
    groups = ForceGroups({"fast": springs, "slow": quartic})
    np.testing.assert_array_equal(groups(X, 0.0), springs(X, 0.0) + quartic(X))
    groups.of("fast", X, 0.0)
    assert groups.evaluations == {"fast": 2, "slow": 1}


def test_forces_of_other_atoms_are_named_by_their_group():
    groups = ForceGroups({"fast": springs, "slow": lambda x, t: x[:1]})
    for asked in (groups, lambda x, t: groups.of("slow", x, t)):
        with pytest.raises(
            InputError, match=r"group 'slow' gives forces of shape \(1, 3\).*give a function of these atoms"
        ):
            asked(X, 0.0)


def test_a_difference_is_what_the_expensive_forces_are_more():
    groups = ForceGroups.difference(springs, quartic)
    np.testing.assert_allclose(groups(X, 0.0), quartic(X), rtol=1e-13)
    np.testing.assert_array_equal(groups.of("slow", X, 0.0), quartic(X) - springs(X, 0.0))


def test_a_difference_does_not_trust_an_array_that_is_used_again():
    shared = np.empty_like(X)

    def one(x, t):
        shared[...] = x
        return shared

    def two(x, t):
        shared[...] = 2 * x
        return shared

    np.testing.assert_array_equal(ForceGroups.difference(one, two).of("slow", X, 0.0), X)


def test_a_method_is_one_function_however_often_it_is_looked_up():
    class Field:
        def force(self, x, t):
            return -x

    field = Field()
    with pytest.raises(InputError, match="'fast' and 'slow' overlap"):
        ForceGroups({"fast": field.force, "slow": field.force})
    with pytest.raises(InputError, match="the same function"):
        ForceGroups.difference(field.force, field.force)
    ForceGroups({"fast": field.force, "slow": Field().force})  # of another object


def test_groups_have_steps_and_steps_have_groups():
    groups = ForceGroups({"fast": springs, "slow": quartic})
    group_names(groups, ("slow", "fast"))
    group_names(None, ("",))
    for names in (("slow", "medium", "fast"), ("slow",)):
        with pytest.raises(InputError, match=f"given to {', '.join(names)}; give .* of the forces: fast, slow"):
            group_names(groups, names)
    with pytest.raises(UnsupportedError, match="no groups of forces"):
        group_names(springs, ("slow",))


THREE = levels_of({"fast": 12, "slow": 1, "medium": 4})


@pytest.mark.parametrize("turns", [False, True])
def test_slow_kicks_in_the_middle(turns):
    """Of the same chain of operations: between the same inner steps, with one kick in place of two halves."""
    levels = levels_of({"slow": 1, "fast": 4})
    at_ends, middle = (nested(levels, (1.0,), turns=turns, middle=where) for where in (False, True))
    push = Turn if turns else Kick
    last = len(at_ends) - (0 if turns else 1)
    inner, tail = at_ends[1 : last - 2], at_ends[last:]
    half = len(inner) // 2
    assert middle == (*inner[:half], Evaluate("slow"), push(1.0, "slow"), *inner[half:], *tail)


def test_a_step_is_its_own_mirror_image():
    """But for evaluations, which go before the kicks that use them."""
    kept = [(type(o), o.fraction, getattr(o, "group", "")) for o in nested(THREE, (1.0,), turns=True)]
    kept = [item for item in kept if item[0] in (Turn, Fly, Exchange)]
    for (a, share, group), (b, other, name) in zip(kept, reversed(kept), strict=True):
        assert (a, group) == (b, name) and share == pytest.approx(other, rel=1e-13)


def test_on_spheres_velocities_are_projected_after_each_drift():
    done = nested(THREE, (1.0,), turns=True)
    assert all(isinstance(b, Project) for a, b in pairwise(done) if isinstance(a, Fly))
    assert not any(isinstance(o, Kick) for o in done)


TWO = {"slow": 1, "fast": 4}


def grouped(motion, **groups):
    return System(motion, ForceGroups(groups))


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
