"""Forces in groups: sums, differences, counts, and groups that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from thermostat_systems import quartic, springs, system

from kcons.errors import InputError, UnsupportedError
from kcons.steppers import System, run
from kcons.thermostats import ForceGroups, LangevinRespa
from kcons.thermostats.multistep.force_groups import group_names

X = np.arange(12.0).reshape(4, 3)


def test_the_sum_and_how_often_each_was_asked_for():
    groups = ForceGroups({"fast": springs, "slow": quartic})
    np.testing.assert_array_equal(groups(X, 0.0), springs(X, 0.0) + quartic(X))
    groups.of("fast", X, 0.0)
    assert groups.evaluations == {"fast": 2, "slow": 1}


def test_a_difference_is_what_the_expensive_forces_are_more():
    groups = ForceGroups.difference(springs, quartic, fast="cheap", slow="rest")
    np.testing.assert_allclose(groups(X, 0.0), quartic(X), rtol=1e-13)
    np.testing.assert_array_equal(groups.of("rest", X, 0.0), quartic(X) - springs(X, 0.0))


def test_a_difference_does_not_trust_an_array_that_is_used_again():
    shared = np.empty_like(X)

    def one(x, t):
        shared[...] = x
        return shared

    def two(x, t):
        shared[...] = 3 * x
        return shared

    np.testing.assert_array_equal(ForceGroups.difference(one, two).of("slow", X, 0.0), 2 * X)


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


def test_forces_of_different_systems():
    with pytest.raises(InputError, match="both called 'a'"):
        ForceGroups.difference(springs, quartic, fast="a", slow="a")
    with pytest.raises(InputError, match="the same function"):
        ForceGroups.difference(springs, springs)
    with pytest.raises(InputError, match="different systems"):
        ForceGroups.difference(lambda x, t: x[:2], springs)(X, 0.0)
    with pytest.raises(InputError, match="group 'slow' gives forces of shape"):
        ForceGroups({"fast": springs, "slow": lambda x, t: x[:2]})(X, 0.0)


def test_groups_have_steps_and_steps_have_groups():
    groups = ForceGroups({"fast": springs, "slow": quartic})
    group_names(groups, ("slow", "fast"))
    group_names(None, ("",))
    with pytest.raises(InputError, match="no group 'medium' of forces; there are fast, slow"):
        group_names(groups, ("slow", "medium", "fast"))
    with pytest.raises(InputError, match="group 'fast' of the forces has no number of steps"):
        group_names(groups, ("slow",))
    with pytest.raises(UnsupportedError, match="no groups of forces"):
        group_names(springs, ("slow",))


def test_a_run_is_refused_before_its_first_step():
    held = system([], X, np.ones(4), springs)
    start = held.initial_state(X)
    with pytest.raises(UnsupportedError, match="no groups of forces"):
        run(held, start, 0.1, 1, stepper=LangevinRespa(1.0, 1.0, 3, steps={"slow": 1, "fast": 2}))
    other = System(held.motion, ForceGroups({"fast": springs, "slow": lambda x, t: x[:2]}))
    with pytest.raises(InputError, match="shape"):
        run(other, start, 0.1, 1, stepper=LangevinRespa(1.0, 1.0, 3, steps={"slow": 1, "fast": 2}))
