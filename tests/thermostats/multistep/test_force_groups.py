"""Forces in groups: sums, differences, counts, and groups that cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from thermostat_systems import quartic, springs

from kcons.errors import InputError, UnsupportedError
from kcons.thermostats import ForceGroups
from kcons.thermostats.multistep.respa import group_names

X = np.random.default_rng(0).normal(size=(4, 3))


def test_the_sum_and_how_often_each_was_asked_for():
    groups = ForceGroups({"fast": springs, "slow": quartic})
    np.testing.assert_array_equal(groups(X, 0.0), springs(X, 0.0) + quartic(X))
    groups.of("fast", X, 0.0)
    assert groups.evaluations == {"fast": 2, "slow": 1}


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
