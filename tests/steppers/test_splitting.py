"""Steps that nobody looks at: the same as one by one, to the last bit, and the same errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError
from kcons.steppers import Rattle, ReversibilityCheck, State, Suzuki4, run
from tests.steppers.stages.test_packed_system import GROUPS, STEPPERS, SYSTEMS, molecules, springs, triangles

ARRAYS = ("positions", "velocities", "forces", "remainder")


def one_by_one(stepper, system, state, dt, steps) -> State:
    for _ in range(steps):
        state = stepper.step(system, state, dt)
    return state


def assert_same(one: State, two: State) -> None:
    for name in ARRAYS:
        a, b = getattr(one, name), getattr(two, name)
        assert (a is None) == (b is None)
        assert a is None or np.array_equal(a, b), name
    assert (one.time, one.time_remainder, one.step) == (two.time, two.time_remainder, two.step)


def counted(system):
    """Number of the step and whether it was copied, of all forces that come in from now on."""
    calls = []
    step = type(system).accepted
    system.accepted = lambda raw, number, copy: calls.append((number, copy)) or step(system, raw, number, copy)
    return calls


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_same_to_the_last_bit(stepper, name) -> None:
    names, options = SYSTEMS[name]
    system, state = molecules(*names, **options)
    for dt, steps in ((0.02, 7), (-0.01, 2), (0.1 / 3, 11)):
        expected = one_by_one(stepper, system, state, dt, steps)
        found = stepper.march(system, state, dt, steps)
        assert_same(found, expected)
        assert found.step == state.step + steps
        state = found


@pytest.mark.parametrize("name", ["hydrogens", "periodic", "far"])
def test_a_march_by_the_engine_is_the_same_to_the_last_bit(name) -> None:
    names, options = SYSTEMS[name]
    for stepper in (Rattle(), Suzuki4()):
        system, state = molecules(*names, **options, piecewise=True)
        expected = one_by_one(stepper, system, state, 0.02, 5)
        assert_same(stepper.march(system, state, 0.02, 5), expected)


def test_forces_that_know_the_time() -> None:
    seen: list[float] = []

    def force(x, t):
        seen.append(t)
        return springs(x, t) * (1.0 + 0.5 * np.sin(7.0 * t))

    for stepper in STEPPERS:
        system, state = molecules(*GROUPS, force=force)
        state = State(state.positions, state.velocities, time=0.3)
        seen.clear()
        expected = one_by_one(stepper, system, state, 0.02, 5)
        times = seen.copy()
        seen.clear()
        assert_same(stepper.march(system, state, 0.02, 5), expected)
        assert seen == times


def test_who_looks_sees_what_steps_would_have_shown() -> None:
    system, state = molecules(*GROUPS)
    seen: list[State] = []
    end = run(system, state, 0.02, 11, observers=[seen.append], every=3)
    assert [s.step for s in seen] == [0, 3, 6, 9] and end.step == 11
    for one in [*seen, end]:
        if one.step:
            assert_same(one, one_by_one(Rattle(), system, state, 0.02, one.step))
    kept = [s.positions.copy() for s in seen], [s.velocities.copy() for s in seen]
    run(system, seen[-1], 0.02, 20)
    assert all(np.array_equal(s.positions, x) for s, x in zip(seen, kept[0], strict=True))
    assert all(np.array_equal(s.velocities, v) for s, v in zip(seen, kept[1], strict=True))


def test_positions_that_a_force_has_seen_are_never_written_to() -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def force(x, t):
        seen.append((x, x.copy()))
        return springs(x, t)

    for stepper in (Rattle(), Suzuki4()):
        system, state = molecules(*GROUPS, force=force)
        stepper.march(system, state, 0.02, 9)
        assert all(np.array_equal(x, copy) for x, copy in seen)
        seen.clear()


def test_a_force_function_may_return_the_same_array_each_time() -> None:
    room = np.empty((0, 3))

    def force(x, t):
        nonlocal room
        if room.shape != x.shape:
            room = np.empty_like(x)
        room[:] = springs(x, t)
        return room

    for stepper in STEPPERS:
        (system, state), (other, _) = molecules(*GROUPS, force=force), molecules(*GROUPS)
        found = stepper.march(system, state, 0.02, 6)
        assert_same(found, stepper.march(other, state, 0.02, 6))
        assert found.forces is None or not np.shares_memory(found.forces, room)


@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4()], ids=repr)
def test_steps_that_the_kernels_leave_to_the_engine(stepper) -> None:
    """Steps so long that Newton's method takes many iterations, among shorter ones."""
    system, state = triangles(force=None)
    calls: list[int] = []
    project = system.motion.project_positions
    system.motion.project_positions = lambda *a, **k: calls.append(1) or project(*a, **k)
    found = None
    for dt in np.geomspace(0.3, 5.0, 30):
        calls.clear()
        try:
            expected = one_by_one(stepper, system, state, float(dt), 4)
        except KconsError as error:
            with pytest.raises(type(error)) as raised:
                stepper.march(system, state, float(dt), 4)
            assert raised.value.step == error.step and str(raised.value) == str(error)
            continue
        if calls:
            found = dt
        assert_same(stepper.march(system, state, float(dt), 4), expected)
    assert found is not None


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize(
    ("wrong", "kind", "message"),
    [
        (np.nan, NonFiniteError, "non-finite force at step 4 on atom 2"),
        (np.inf, NonFiniteError, "non-finite force at step 4 on atom 2"),
        (None, InputError, r"returned shape \(3,\) at step 4"),
    ],
)
def test_errors_name_the_step(stepper, wrong, kind, message) -> None:
    def force(x, t):
        f = springs(x, t)
        # The last of its times at which forces are asked for lies in the fourth step for all steppers.
        if t > 3.05 * 0.02:
            if wrong is None:
                return np.zeros(3)
            f[2, 1] = wrong
        return f

    system, state = molecules(*GROUPS, force=force)
    before = state.positions.copy(), state.velocities.copy()
    with pytest.raises(kind, match=message) as raised:
        stepper.march(system, state, 0.02, 9)
    with pytest.raises(kind) as expected:
        one_by_one(stepper, system, state, 0.02, 9)
    assert str(raised.value) == str(expected.value)
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])


def test_a_step_without_solution_far_into_a_run() -> None:
    """A push in one step that leads too far in the next."""

    def force(x, t):
        return 1e5 * (x - x.mean(axis=0)) if 0.085 < t < 0.095 else np.zeros_like(x)

    system, state = molecules("chain", force=force)
    with pytest.raises(KconsError) as expected:
        one_by_one(Rattle(), system, state, 0.01, 30)
    seen: list[State] = []
    with pytest.raises(type(expected.value)) as raised:
        run(system, state, 0.01, 30, observers=[seen.append], every=4)
    assert raised.value.step == expected.value.step > 8
    assert isinstance(raised.value, ConvergenceError) and raised.value.row == expected.value.row
    assert [s.step for s in seen] == list(range(0, raised.value.step, 4))


def test_a_run_into_the_distance() -> None:
    """Positions that become so large on the way that their remainder is kept."""
    system, state = molecules(*GROUPS, force=None)
    state = State(state.positions, state.velocities + 40.0)
    for stepper in (Rattle(), Suzuki4()):
        end = stepper.march(system, state, 0.02, 400)
        assert state.remainder is None and end.remainder is not None
        assert_same(end, one_by_one(stepper, system, state, 0.02, 400))


def test_steps_of_a_subclass_are_made_by_it() -> None:
    class Halved(Rattle):
        def step(self, system, state, dt):
            return super().step(system, state, 0.5 * dt)

    system, state = molecules(*GROUPS)
    assert_same(run(system, state, 0.02, 6, stepper=Halved()), run(system, state, 0.01, 6))


def test_steppers_without_march_and_steps_of_zero() -> None:
    system, state = molecules(*GROUPS)
    checked = run(system, state, 0.02, 5, stepper=ReversibilityCheck(Rattle()))
    assert_same(checked, run(system, state, 0.02, 5))
    still = run(system, state, 0.0, 5)
    assert np.array_equal(still.positions, state.positions) and still.step == 5
    assert run(system, state, 0.02, 0) is state
    with pytest.raises(InputError, match="dt is nan"):
        run(system, state, float("nan"), 3)


def test_the_engine_is_asked_for_nothing_and_forces_are_not_copied() -> None:
    system, state = molecules(*GROUPS)
    state = system.with_forces(state)
    asked: list[str] = []
    for call in ("project_positions", "project_velocities"):
        setattr(system.motion, call, lambda *a, call=call, **k: asked.append(call))
    made = counted(system)
    after = Rattle().march(system, state, 0.02, 8, check_every=0)
    assert not asked and not made
    force = system.force
    system.force = lambda x, time: force(x, time).tolist()
    listed = Rattle().march(system, state, 0.02, 8, check_every=0)
    assert made == [(number, False) for number in range(1, 9)]
    assert_same(listed, after)


def test_forces_of_other_kinds_are_taken_as_they_come() -> None:
    system, state = molecules(*GROUPS)
    force = system.force
    expected = Rattle().march(system, system.with_forces(state), 0.02, 5)
    for kind in (np.asfortranarray, lambda f: np.repeat(f, 2, axis=1)[:, ::2], lambda f: f.astype(np.longdouble)):
        system.force = lambda x, time, kind=kind: kind(force(x, time))
        assert_same(Rattle().march(system, system.with_forces(state), 0.02, 5), expected)
    system.force = lambda x, time: force(x, time)[:-1]
    with pytest.raises(InputError, match="shape"):
        Rattle().march(system, state, 0.02, 5)


@pytest.mark.parametrize("kind", [np.float32, np.asfortranarray, lambda a: a[::-1].copy()[::-1]])
@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4()], ids=repr)
def test_starts_of_other_kinds_of_arrays(stepper, kind) -> None:
    system, state = molecules(*GROUPS)
    x, v = kind(state.positions), kind(state.velocities)
    plain = system.with_forces(State(np.array(x, dtype=float, order="C"), np.array(v, dtype=float, order="C")))
    strange = State(x, v, forces=kind(np.array(plain.forces)))
    plain = replace(plain, forces=np.array(strange.forces, dtype=float, order="C"))
    for march in (stepper.march, lambda *run: one_by_one(stepper, *run)):
        assert_same(march(system, strange, 0.02, 5), march(system, plain, 0.02, 5))


@pytest.mark.parametrize("where", [0, 1], ids=["given", "held"])
def test_a_cell_that_the_force_function_changes_is_seen(where) -> None:
    cell = np.diag([9.0, 8.0, 7.0])
    # Molecules whose atoms are in different cells.
    apart = np.random.default_rng(0).integers(-1, 2, size=(len(triangles()[1].positions), 3)) * np.diag(cell)

    system, state = triangles(cell=cell, pbc=True)
    force, calls = system.force, []

    def press(x, time):
        calls.append(time)
        if len(calls) == 4:
            system.motion.sources[where].with_cell(1.001 * cell)
        return force(x, time)

    system.force = press
    found = Rattle().march(system, State(state.positions + apart, state.velocities), 0.02, 9)
    held = system.motion.constraint_set
    assert np.abs(held.value(found.positions, 0.0)).max() <= 1e-13
    held.with_cell(cell)
    assert np.abs(held.value(found.positions, 0.0)).max() > 1e-3
