"""The interpreter: times, places far away, forces that are kept, programs of any operations, errors with their step."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from stepper_systems import system_of

from kcons.constraints import Distance, Sphere
from kcons.errors import ConvergenceError, ImageError, NonFiniteError
from kcons.steppers import Geodesic, Rattle, Splitting, State, Suzuki4, System, run
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Evaluate, Kick, Project, drifts_of
from kcons.steppers.program import Program
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain
from tests.steppers.stages.test_packed_system import GROUPS, STEPPERS, molecules, springs
from tests.steppers.test_splitting import assert_same, one_by_one


def far(at: float) -> tuple[System, State]:
    x = np.array([[0.0, 0.0, 0.0], [1.0 / 3.0, 0.2, 0.1], [2.0, 0.7, 0.3]]) + at
    system = system_of([Distance([[1, 2]])], x, np.ones(3))
    return system, system.initial_state(x, np.zeros_like(x))


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("at", [0.0, 1e7])
def test_a_step_of_no_operations_ends_where_it_began(at, packed) -> None:
    system, state = far(at)
    if not packed:
        system.packed = None
    assert (state.remainder is not None) == (at > 0)
    steps = Interpreter(system, state, 0.1, Program([]))
    if state.remainder is not None:
        # Relative to the anchor, with all digits.
        assert np.array_equal(steps.x[system.anchor], state.remainder[system.anchor])
        assert abs(np.linalg.norm(steps.x[1] - steps.x[2]) - system.motion.constraint_set.target(0.0)[0]) <= 1e-15
    assert np.array_equal(steps.whole(steps.x), state.positions)
    end = steps.through()
    assert np.array_equal(end.positions, state.positions)
    assert (end.remainder is None) == (state.remainder is None)
    if state.remainder is not None:
        np.testing.assert_allclose(end.remainder, state.remainder, rtol=0, atol=1e-16)
    assert system.last is end and end.step == 1 and end.time == 0.1 and steps.made == 1


@pytest.mark.parametrize("packed", [True, False])
def test_times_within_a_step_are_exact(packed) -> None:
    system, state = far(0.0)
    if not packed:
        system.packed = None
    seen: list[float] = []
    system.force = lambda x, t: seen.append(t) or np.zeros_like(x)
    state = State(state.positions, state.velocities, 1e8, time_remainder=3e-9)
    begin = system.with_forces(state)
    seen.clear()
    first, second = drifts_of((0.5, 0.5))
    steps = Interpreter(system, begin, 1e-7, Program([first, Evaluate(), second, Evaluate()]), 2)
    end = steps.through()
    half = state.later(1e-7)
    then = State(state.positions, state.velocities, half[0], time_remainder=half[1])
    middle, last = (s.time + (0.5e-7 + s.time_remainder) for s in (state, then))
    assert seen == [middle, half[0], last, then.later(1e-7)[0]] and seen[0] > 1e8
    assert (end.time, end.time_remainder) == then.later(1e-7)


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_a_cell_that_the_force_function_changes(stepper) -> None:
    """One by one and all at once, compiled and by the engine, with atoms of a molecule in different cells."""
    cell = np.diag([19.0, 18.0, 17.0])
    ends = []
    for together, packed in ((True, True), (False, True), (False, False)):
        system, state = molecules(*GROUPS, "triangles", cell=cell, pbc=True, scatter=True)
        force = system.force

        def press(x, t, force=force, motion=system.motion):
            motion.set_cell((1.0 - 1e-3 * t) * cell)
            return force(x, t)

        system.force = press
        if not packed:
            system.packed = None
        if together:
            ends.append(stepper.march(system, state, 0.02, 6, check_every=0))
        else:
            ends.append(one_by_one(stepper, system, state, 0.02, 6))
    assert_same(*ends[:2])
    np.testing.assert_allclose(ends[2].positions, ends[0].positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[2].velocities, ends[0].velocities, rtol=0, atol=1e-11)


def test_a_march_ends_where_remainders_begin() -> None:
    system, state = molecules(*GROUPS, force=None)
    start = system.with_forces(State(state.positions, state.velocities + 40.0))
    stepper = Rattle()
    steps = stepper.begun(system, start, 0.02, 400)
    end = steps.through()
    assert 0 < steps.made < 400 and end.step == steps.made and end.remainder is not None
    assert_same(end, one_by_one(stepper, system, start, 0.02, steps.made))
    assert one_by_one(stepper, system, start, 0.02, steps.made - 1).remainder is None


def test_drifts_first_with_forces_that_depend_on_velocities() -> None:
    """Two steps of half the length, whichever comes first where they do not."""

    def force(x, v, t):
        return springs(x, t) - 0.1 * v

    plain, state = molecules(*GROUPS)
    system = System(plain.motion, force, velocity_dependent=True)
    halves = run(system, state, 0.01, 8)
    for splitting in (Splitting((1.0,), (0.5, 0.5)), Splitting((0.25, 0.5, 0.25), (0.5, 0.5))):
        end = run(system, state, 0.02, 4, stepper=splitting)
        np.testing.assert_allclose(end.positions, halves.positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(end.velocities, halves.velocities, rtol=0, atol=1e-13)
        assert np.array_equal(end.forces, system.forces(end.positions, end.velocities, end.time, 0))


@pytest.mark.parametrize("piecewise", [False, True])
def test_forces_are_kept_where_no_drift_comes_after_them(piecewise) -> None:
    system, state = molecules(*GROUPS, piecewise=piecewise)
    for splitting, kept in ((Rattle(), True), (Splitting((1.0,), (0.5, 0.5)), False)):
        end = splitting.march(system, state, 0.02, 3)
        assert (end.forces is not None) == kept
        assert not kept or np.array_equal(end.forces, springs(end.positions, 0.0))


@pytest.mark.parametrize("piecewise", [False, True])
def test_kicks_in_succession_and_before_other_operations(piecewise) -> None:
    """Each is taken once, whatever comes after it."""
    system, state = molecules(*GROUPS, piecewise=piecewise)
    start = system.with_forces(state)
    (drift,) = drifts_of((1.0,))
    listed = [Kick(0.25), Kick(0.25), drift, Evaluate(), Kick(0.2), Evaluate(), Kick(0.3), Project()]
    for steps in (1, 4):
        end = Interpreter(system, start, 0.02, Program(listed), steps).through()
        expected = one_by_one(Rattle(), system, start, 0.02, steps)
        np.testing.assert_allclose(end.positions, expected.positions, rtol=0, atol=1e-14)
        np.testing.assert_allclose(end.velocities, expected.velocities, rtol=0, atol=1e-13)
    last = Interpreter(system, start, 0.02, Program([Project(), Kick(0.5)])).through()
    push = 0.01 * start.forces * system.inverse_masses
    np.testing.assert_allclose(last.velocities, state.velocities + push, rtol=0, atol=1e-15)


def test_methods_of_verbs_and_errors_get_the_number_of_the_step() -> None:
    done: list[tuple[str, float]] = []

    class Noted(Interpreter):
        def damp(self, row, begun):
            done.append((row.name, row.length))
            if self.number == 3:
                raise ImageError("half the cell apart")

    system, state = molecules(*GROUPS)
    program = Program([Kick(0.25), Evaluate()], python=("evaluate",))
    program.rows.insert(0, program.rows[0]._replace(name="damp", verb=0, length=0.7, kick=0.0))
    program.ends.insert(0, 0.0)
    program.shown.insert(0, False)
    program.flies.insert(0, False)
    with pytest.raises(ImageError) as caught:
        Noted(system, state, 0.1, program, 5).through()
    assert caught.value.step == 3 and done == [("damp", 0.7)] * 3


@pytest.mark.parametrize("compiled", [True, False])
def test_a_force_that_is_not_finite_is_named(compiled) -> None:
    def force(x, t):
        f = springs(x, t)
        if t > 0.01:
            f[3, 1] = np.nan
        return f

    system, state = molecules(*GROUPS, force=force)
    slowed = System(system.motion, force, friction=0.2)
    if not compiled:
        slowed.packed = None
    with pytest.raises(NonFiniteError, match="non-finite force at step 1 on atom 3"):
        run(slowed, state, 0.02, 3)


@pytest.mark.parametrize("stepper", [Suzuki4(), Langevin(0.1, 0.3, 5)], ids=["Suzuki4", "Langevin"])
def test_a_step_that_fails_in_a_march_leaves_the_start_and_names_row_and_step(stepper) -> None:
    def force(x, t):
        return 1e7 * (x - x.mean(axis=0)) if 0.085 < t < 0.095 else np.zeros_like(x)

    errors = []
    for piecewise in (False, True):
        system, state = molecules("chain", force=force, piecewise=piecewise)
        kept = state.copied()
        with pytest.raises(ConvergenceError, match="time step too large") as caught:
            stepper.march(system, state, 0.01, 30)
        assert np.array_equal(state.positions, kept.positions) and np.array_equal(state.velocities, kept.velocities)
        with pytest.raises(ConvergenceError) as alone:
            one_by_one(stepper, system, state, 0.01, 30)
        assert caught.value.step == alone.value.step > 8 and caught.value.row == alone.value.row is not None
        errors.append((caught.value.step, caught.value.row))
    assert errors[0] == errors[1]


def test_programs_are_of_use_in_other_processes() -> None:
    """They hold addresses of functions, which are found anew."""
    x = np.array([[1.0, 0.0, 0.0]])
    system = system_of([Sphere(0, [0, 0, 0], 1.0)], x, [2.0], lambda x, t: -0.3 * x[:, ::-1])
    state = system.initial_state(x, [[0.0, 0.3, 0.1]])
    for stepper in (Geodesic(3), Geodesic(3, great_circles=False), Langevin(0.1, 0.3, 5)):
        end = stepper.march(system, state, 0.1, 5)
        other = pickle.loads(pickle.dumps(stepper))
        assert_same(other.march(system, state, 0.1, 5), end)


BATHS = [NoseHooverChain(0.1, 2.0, momentum="free"), Isokinetic(0.1, momentum="free"), Langevin(0.1, 0.3, 5)]


@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4(), *BATHS], ids=lambda each: type(each).__name__)
def test_steps_that_go_on_are_those_that_begin_anew(stepper) -> None:
    """From the state that the last one ended in all is ready, as long as nothing has changed since."""
    system, state = molecules(*GROUPS, "triangles")
    again, one = copy.deepcopy(stepper), state
    begun = []
    stepper = copy.deepcopy(stepper)
    first = stepper.begun
    stepper.begun = lambda *given: begun.append(1) or first(*given)
    other = state
    for _ in range(4):
        one = stepper.step(system, one, 0.02)
        other_system = molecules(*GROUPS, "triangles")[0]
        other = again.step(other_system, replace(other, origin=None), 0.02)
        assert_same(one, other)
        assert one.thermostat is None or np.array_equal(one.thermostat, other.thermostat)
    assert len(begun) == 1
    # Another time step, a state that was changed, a force that fails on the way: all begin anew.
    assert stepper.step(system, one, 0.01).time == pytest.approx(one.time + 0.01)
    moved = replace(one, velocities=2 * one.velocities)
    assert not np.array_equal(stepper.step(system, moved, 0.01).velocities, stepper.step(system, one, 0.01).velocities)
    force, last = system.force, stepper.step(system, one, 0.02)
    system.force = lambda x, t: np.full_like(x, np.nan)
    with pytest.raises(NonFiniteError):
        stepper.step(system, last, 0.02)
    system.force = force
    assert_same(stepper.step(system, last, 0.02), stepper.step(system, last, 0.02))


@pytest.mark.parametrize("make", [lambda: Langevin(0.1, 0.3, 5), lambda: NoseHooverChain(0.1, 2.0, momentum="free")])
def test_a_temperature_that_is_changed_between_steps_counts_at_once(make) -> None:
    system, state = molecules(*GROUPS)
    one, other = make(), make()
    state = one.step(system, state, 0.02)
    kept = state.copied()
    one.thermal_energy = other.thermal_energy = 0.3
    after, expected = one.step(system, state, 0.02), other.step(system, replace(kept, origin=None), 0.02)
    assert_same(after, expected)
    assert np.array_equal(after.thermostat, expected.thermostat)


@pytest.mark.parametrize("make", [lambda: NoseHooverChain(0.1, 2.0), lambda: Isokinetic(0.1)])
def test_bodies_that_feel_nothing_are_noticed_also_where_steps_go_on(make) -> None:
    """After 20,000 steps, however many are made at once."""
    system, state = molecules(*GROUPS, force=lambda x, t: -0.1 * x * [1.0, 1.7, 0.6])
    thermostat = make()
    state = thermostat.step(system, replace(state, step=19_990), 0.001)
    with pytest.warns(UserWarning, match="feel"):
        end = thermostat.march(system, state, 0.001, 40)
    assert end.step == 20_031


def test_copies_of_a_system_begin_anew() -> None:
    system, state = molecules(*GROUPS)
    state = Rattle().step(system, state, 0.02)
    for other, there in (copy.deepcopy((system, state)), pickle.loads(pickle.dumps((plain(system), state)))):
        assert other.going is None
        assert_same(Rattle().step(other, there, 0.02), Rattle().step(system, state, 0.02))


def plain(system: System) -> System:
    """Without a force function that is local to a test."""
    other = copy.copy(system)
    other.force = springs
    return other
