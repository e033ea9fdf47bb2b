"""Forces in groups: sums, differences, counts, groups that cannot be, and forces that travel with the state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import quartic, springs, system

from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.thermostats import ForceGroups
from kcons.thermostats.multistep.respa import GroupedForces, group_names

X = np.random.default_rng(0).normal(size=(4, 3))
NAMES = ("slow", "fast")


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
    with pytest.raises(InputError, match="no group 'medium' of forces; there are fast, slow"):
        group_names(groups, ("slow", "medium", "fast"))
    with pytest.raises(InputError, match="group 'fast' of the forces has no number of steps"):
        group_names(groups, ("slow",))
    with pytest.raises(UnsupportedError, match="no groups of forces"):
        group_names(springs, ("slow",))


def made(**more):
    groups = ForceGroups({"fast": springs, "slow": quartic, **more})
    return System(system([], X, np.ones(4)).motion, groups), groups


def test_what_a_state_carries_is_not_evaluated_anew():
    held, groups = made()
    found, variables = GroupedForces.of(held, State(X, 0 * X), NAMES, 2, "X")
    assert variables is None and groups.evaluations == {"fast": 1, "slow": 1}
    np.testing.assert_array_equal(found.total(), quartic(X) + springs(X, 0))
    state = State(X, 0 * X, forces=found.total(), thermostat=found.closed(np.array([1.0, 2.0])))
    again, variables = GroupedForces.of(held, state, NAMES, 2, "X")
    assert groups.evaluations == {"fast": 1, "slow": 1}
    assert variables.tolist() == [1.0, 2.0]
    for name in NAMES:
        np.testing.assert_array_equal(again.now[name], found.now[name])
    # Where somebody moved the atoms, a state has no forces.
    GroupedForces.of(held, replace(state, forces=None), NAMES, 2, "X")
    assert groups.evaluations == {"fast": 2, "slow": 2}


def test_forces_of_another_place_are_evaluated_anew():
    """A state put together of new positions, their forces, and what another state carried."""
    held, groups = made()
    found, _ = GroupedForces.of(held, State(X, 0 * X), NAMES, 1, "X")
    there = 1.1 * X
    put = State(there, 0 * X, forces=groups(there, 0.0), thermostat=found.closed(np.zeros(1)))
    again, _ = GroupedForces.of(held, put, NAMES, 1, "X")
    np.testing.assert_array_equal(again.now["slow"], quartic(there))
    np.testing.assert_array_equal(again.now["fast"], springs(there, 0))
    halfway, _ = GroupedForces.of(held, replace(put, thermostat=np.zeros(1)), NAMES, 1, "X", middle=True)
    assert halfway.now.keys() == {"fast"}


def test_forces_of_groups_that_were_renamed():
    """By another order of the names they would change places."""
    held, _ = made()
    found, _ = GroupedForces.of(held, State(X, 0 * X), NAMES, 2, "X")
    state = State(X, 0 * X, forces=found.total(), thermostat=found.closed(np.array([1.0, 2.0])))
    renamed = System(held.motion, ForceGroups({"a slow": quartic, "fast": springs}))
    with pytest.raises(InputError, match="groups of other names than a slow, fast"):
        GroupedForces.of(renamed, state, ("a slow", "fast"), 2, "X")


def test_one_group_is_the_forces_of_the_state():
    held = System(made()[0].motion, springs)
    found, variables = GroupedForces.of(held, State(X, 0 * X, forces=2 * X), ("",), 1, "X")
    np.testing.assert_array_equal(found.total(), 2 * X)
    assert found.closed(np.array([3.0])).tolist() == [3.0] and variables is None
    named = System(held.motion, ForceGroups({"a": springs}))
    np.testing.assert_array_equal(GroupedForces.of(named, State(X, 0 * X), ("a",), 1, "X")[0].total(), springs(X, 0))


def test_forces_belong_to_their_names_in_whichever_order():
    """Another run may give the same groups other numbers of steps."""
    held, _ = made()
    found, _ = GroupedForces.of(held, State(X, 0 * X), NAMES, 1, "X")
    state = State(X, 0 * X, forces=found.total(), thermostat=found.closed(np.zeros(1)))
    again, _ = GroupedForces.of(held, state, NAMES[::-1], 1, "X")
    for name in NAMES:
        np.testing.assert_array_equal(again.now[name], found.now[name])
