"""Extrapolated RATTLE: order of the columns, errors as tolerated, control of the steps, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import cases
from stepper_attempts import attempts, counted, end_of, system_of_test
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, GlobalError, named, observed_order
from stepper_systems import gravity, growing_rod, rotor, skate, spherical_pendulum, system_of

from kcons import run
from kcons.comparison import compare, test_systems
from kcons.constraints import Distance, FixedAtoms
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import (
    Extrapolation,
    Geodesic,
    Rattle,
    State,
)
from kcons.steppers.extrapolation import _Table
from tests.contracts import test_reference_orders as references


class Columns:
    """Equal steps with a fixed number of columns."""

    def __init__(self, columns: int, base=None) -> None:
        self.columns, self.scheme, self.order = columns, Extrapolation(base=base or Rattle()), 2 * columns

    def check(self, system) -> None: ...

    def step(self, system, state, dt) -> State:
        state = system.with_forces(state)
        table = _Table(self.scheme, system, state, dt, 1.0)
        for n in range(1, self.columns + 1):
            table.add(n)
        return table.landed(None)


# -- order and errors ---------------------------------------------------------------------------


@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS, *FRICTION], ids=named)
@pytest.mark.parametrize(("columns", "steps"), [(2, [12, 16]), (3, [8, 10])])
def test_each_column_adds_two_orders(columns, steps, problem: GlobalError) -> None:
    assert observed_order(Columns(columns), problem, steps) == pytest.approx(2 * columns, abs=0.35)


def test_eight_orders_and_another_base() -> None:
    assert observed_order(Columns(4), HOLONOMIC[0], [5, 6, 7]) == pytest.approx(8, abs=0.6)
    assert observed_order(Columns(3, Geodesic()), HOLONOMIC[0], [7, 8, 10]) == pytest.approx(6, abs=0.5)


@pytest.mark.parametrize(
    ("name", "most"), [("dumbbells", 300.0), ("triple-pendulum", 60.0), ("sphere-pendulum-top", 30.0)]
)
def test_errors_are_proportional_to_the_tolerance(name, most) -> None:
    test_system = test_systems.build(name)
    exact = test_system.reference().positions
    system, times = system_of_test(test_system)
    tolerances, errors, calls = np.array([1e-5, 1e-7, 1e-9, 1e-11]), [], []
    for tolerance in tolerances:
        times.clear()
        end = end_of(
            Extrapolation(tolerance), system, State(test_system.positions, test_system.velocities), test_system.horizon
        )
        errors.append(np.sqrt(np.mean(np.sum((end.positions - exact) ** 2, axis=1))))
        calls.append(len(times))
    assert np.all(errors <= most * tolerances)
    assert np.polyfit(np.log(tolerances), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.25)
    assert calls == sorted(calls) and calls[-1] < 6 * calls[0]


#: Whose forces or rows take long.
SLOW = (
    references.SLOW
    | {"A06_water_free3", "A03_planar_pendulum_179deg", "A03_planar_pendulum_150deg"}
    | {n for n in cases.NAMES if n.startswith("A10") and "dumbbell" not in n}
)


@pytest.mark.parametrize("name", [n for n in cases.NAMES if n not in SLOW])
def test_reference_cases_to_many_digits(name) -> None:
    case, system, state, tolerance = cases.load(name), references.system(name), references.start(name), 1e-12
    held = system.motion.constraint_set
    for known, sensitivity in zip(case.solution, references.sensitivities(name), strict=True):
        for end in Extrapolation(tolerance).states(system, state, known.time):
            x, v = end.positions, end.velocities
            assert np.all(np.abs(held.value(x, end.time)) <= 4 * held.tolerance(x, end.time))
            slip = held.jacobian(x, end.time) @ v.ravel() - held.velocity_target(x, end.time)
            assert np.abs(slip).max(initial=0.0) <= 1e-13 * max(1.0, np.abs(v).max())
        state = end
        off = max(np.abs(state.positions - known.positions).max(), np.abs(state.velocities - known.velocities).max())
        assert off <= tolerance * 4 * sensitivity + 30 * known.tolerance


def at_error(error: float, errors, evaluations) -> float:
    """Evaluations for it, between points that have been measured."""
    order = np.argsort(errors)
    logs = np.log(np.array(errors)[order]), np.log(np.array(evaluations)[order])
    assert logs[0][0] < np.log(error) < logs[0][-1]
    return float(np.exp(np.interp(np.log(error), *logs)))


@pytest.mark.parametrize("name", ["dumbbells", "triple-pendulum"])
def test_fewer_evaluations_than_dop853(name) -> None:
    """At errors from 1e-6 to 1e-9."""
    tolerances = 10.0 ** -np.arange(6, 11)
    test_system = replace(test_systems.build(name), tolerances=tuple(tolerances))
    theirs = compare(test_system, ["dop853"], budget=60.0, rounds=0)
    exact = test_system.reference().positions
    system, times = system_of_test(test_system)
    errors, calls = [], []
    for tolerance in [1e-5, *tolerances, 1e-11, 1e-12]:
        times.clear()
        start = State(test_system.positions, test_system.velocities)
        end = end_of(Extrapolation(tolerance), system, start, test_system.horizon)
        errors.append(np.sqrt(np.mean(np.sum((end.positions - exact) ** 2, axis=1))))
        calls.append(len(times) / test_system.horizon)
    for power in range(6, 10):
        mine, other = at_error(10.0**-power, errors, calls), at_error(10.0**-power, theirs.error, theirs.evaluations)
        assert mine < other


@pytest.mark.parametrize("make", [spherical_pendulum, growing_rod, skate])
def test_what_is_held_holds_at_loose_tolerances(make) -> None:
    system, state = make()
    held = system.motion.constraint_set
    for s in Extrapolation(1e-2).states(system, state, 1.5):
        assert np.abs(held.value(s.positions, s.time)).max(initial=0.0) <= 1e-14
        slip = held.jacobian(s.positions, s.time) @ s.velocities.ravel() - held.velocity_target(s.positions, s.time)
        assert np.abs(slip).max(initial=0.0) <= 1e-14


@pytest.mark.parametrize("tolerance", [1e-13, 1e-14])
def test_rounding_is_no_reason_for_small_steps(tolerance) -> None:
    for name in ("triple-pendulum", "sphere-pendulum-top"):
        test_system = test_systems.build(name)
        system, times = system_of_test(test_system)
        states = list(
            Extrapolation(tolerance).states(
                system, State(test_system.positions, test_system.velocities), test_system.horizon
            )
        )
        assert len(states) < 60 and len(times) < 2000
        off = states[-1].positions - test_system.reference().positions
        assert np.abs(off).max() < 3e-11


# -- steps --------------------------------------------------------------------------------------


def test_no_step_where_there_is_no_time() -> None:
    system, state = spherical_pendulum()
    system, times = counted(system)
    assert list(Extrapolation().states(system, state, 0.0)) == [] and not times


@pytest.mark.parametrize("make", [spherical_pendulum, growing_rod])
def test_back_in_time(make) -> None:
    system, state = make()
    scheme = Extrapolation(1e-11)
    there = end_of(scheme, system, state, 1.5)
    *way, back = scheme.states(system, there, 0.0)
    assert back.time == 0.0 and np.all(np.diff([there.time, *(s.time for s in way), 0.0]) < 0)
    assert back.step == there.step + len(way) + 1
    assert np.abs(back.positions - state.positions).max() < 1e-9
    assert np.abs(back.velocities - state.velocities).max() < 1e-9


def test_a_rejected_step_is_followed_by_a_shorter_one_and_no_longer_one_after_that(monkeypatch) -> None:
    made = attempts(monkeypatch)
    system, state = rotor(
        1.3, force=lambda x, t: np.array([[1.0], [-1.0]]) * [0.3, 0.5, 0.1] * np.exp(-50 * (t - 2) ** 2)
    )
    states = list(Extrapolation(1e-9).states(system, state, 4.0, first_step=1.0))
    rejected = [k for k, (_, _, fits) in enumerate(made) if not fits]
    assert len(rejected) >= 2 and len(made) == len(states) + len(rejected) < 80
    for k in rejected:
        assert abs(made[k + 1][1]) < abs(made[k][1])
        if made[k + 1][2]:
            assert abs(made[k + 2][1]) <= abs(made[k + 1][1]) * (1 + 1e-12)


def test_sizes_and_orders_adapt(monkeypatch) -> None:
    """A passage of 0.1 in a flight of 20: short steps there, long ones elsewhere."""
    system, state = rotor(
        0.4, force=lambda x, t: np.array([[1.0], [-1.0]]) * [0.0, 0.2, 0.1] / (1 + 400 * (t - 10) ** 2)
    )
    states = list(Extrapolation(1e-9).states(system, state, 20.0))
    times = np.array([0.0, *(s.time for s in states)])
    sizes = np.diff(times)
    near = np.abs(times[1:] - 10) < 0.2
    assert sizes[near].max() < 0.2 < sizes[~near].max()


def test_hopeless_attempts_end_early() -> None:
    """One line short of the aim, when the ones that are left cannot be enough."""
    free = system_of([FixedAtoms([0])], np.zeros((2, 3)), [1, 1], lambda x, t: np.sin(20 * x + 1))
    system, times = counted(free)
    state = system.initial_state(np.zeros((2, 3)))
    scheme = Extrapolation(1e-12)
    aim = 8
    table = _Table(scheme, system, system.with_forces(state), 5.0, 1.0)
    times.clear()
    assert not table.fill(aim)
    assert len(times) == aim * (aim - 1) // 2


def test_a_first_step_that_is_far_too_long_or_short() -> None:
    system, state = spherical_pendulum()
    system, times = counted(system)
    known = end_of(Extrapolation(1e-12), system, state, 3.0)
    for first in (1e-6, 1e3):
        times.clear()
        states = list(Extrapolation(1e-9).states(system, state, 3.0, first_step=first))
        assert np.abs(states[-1].positions - known.positions).max() < 1e-8
        assert len(times) < 600


def test_scales_are_those_of_the_motion() -> None:
    """The same pendulum in other units is stepped the same; fixed atoms count nothing."""
    counts = []
    for length, time in ((1.0, 1.0), (1e-3, 1e4), (1e6, 1e-2)):
        positions = np.array([[0.0, 0.0, 0.0], [np.sin(1.2), 0.0, -np.cos(1.2)]]) * length
        for more in (0, 50):
            x = np.concatenate([positions, 3.0 * length * np.arange(1, more + 1)[:, None] * np.ones(3)])
            masses = np.ones(2 + more)
            system = system_of(
                [FixedAtoms([0, *range(2, 2 + more)]), Distance([0, 1], length)],
                x,
                masses,
                gravity(masses, (0, 0, -length / time**2)),
            )
            states = Extrapolation(1e-8, length=length).states(system, system.initial_state(x), 5.0 * time)
            counts.append(sum(1 for _ in states))
    assert len(set(counts)) == 1


# -- what may be held and acting ----------------------------------------------------------------


def test_nothing_held_nothing_acting_nothing_moving() -> None:
    x = np.array([[0.0, 0, 0], [1.0, 2, 3]])
    free = system_of([], x, [1, 2])
    (rest,) = Extrapolation().states(free, free.initial_state(x), 3.0)
    assert np.array_equal(rest.positions, x) and rest.time == 3.0 and rest.step == 1
    v = np.array([[0.3, 0, 0], [0, -0.1, 0]])
    end = end_of(Extrapolation(1e-12), free, free.initial_state(x, v), 3.0)
    assert np.abs(end.positions - (x + 3 * v)).max() < 1e-13
    fixed = system_of([FixedAtoms([0, 1])], x, [1, 2], gravity([1, 2]))
    end = end_of(Extrapolation(), fixed, fixed.initial_state(x), 3.0)
    assert np.array_equal(end.positions, x) and not end.velocities.any()
    falling = system_of([], x, [1, 2], gravity([1, 2]))
    end = end_of(Extrapolation(1e-12), falling, falling.initial_state(x), 2.0)
    assert np.abs(end.positions - (x - [0, 0, 2.0])).max() < 1e-13


def test_forces_of_a_state_are_its_own() -> None:
    room = np.empty((2, 3))

    def force(x, v, t):
        room[:] = -0.4 * v + [0.1 * t, 0, 0]
        return room

    system, state = rotor(1.3, force=force, velocity_dependent=True)
    for s in Extrapolation(1e-6).states(system, state, 1.0):
        assert not np.shares_memory(s.forces, room)
        kept = s.forces.copy()
        assert np.array_equal(kept, force(s.positions, s.velocities, s.time)) and np.array_equal(kept, s.forces)


def test_one_evaluation_at_the_end_of_a_step_serves_all_lines_of_the_next(monkeypatch) -> None:
    system, state = spherical_pendulum()
    system, times = counted(system)
    lines: list[int] = []
    add = _Table.add
    monkeypatch.setattr(_Table, "add", lambda table, n: lines.append(n) or add(table, n))
    for base in (Rattle(), StepByStep()):
        times.clear()
        lines.clear()
        steps = sum(1 for _ in Extrapolation(1e-8, base=base).states(system, state, 1.0))
        assert len(times) == 1 + sum(lines) + steps
        assert times.count(0.0) == 1


class StepByStep(Rattle):
    """Without compiled steps."""

    def step(self, system, state, dt):
        return super().step(system, state, dt)


def test_the_start_is_not_changed() -> None:
    system, state = spherical_pendulum()
    state = system.with_forces(state)
    before = [a.copy() for a in (state.positions, state.velocities, state.forces)]
    states = list(Extrapolation(1e-8).states(system, state, 2.0))
    assert all(
        np.array_equal(a, b) for a, b in zip((state.positions, state.velocities, state.forces), before, strict=True)
    )
    kept = [(s.positions.copy(), s.velocities.copy()) for s in states]
    list(Extrapolation(1e-8).states(system, states[-1], 4.0))
    assert all(
        np.array_equal(s.positions, x) and np.array_equal(s.velocities, v)
        for s, (x, v) in zip(states, kept, strict=True)
    )


def test_far_from_the_origin() -> None:
    def force(x, t):
        return np.array([[0.3], [-0.3]]) * [np.sin(t), 0.2, 0.1]

    def turned(s: State) -> np.ndarray:
        d = s.positions[0] - s.positions[1]
        return d if s.remainder is None else d + (s.remainder[0] - s.remainder[1])

    ends = []
    for offset in (0.0, 1e6):
        system, state = rotor(1.3, force=force, offset=offset)
        assert (state.remainder is not None) == (offset > 0)
        states = list(Extrapolation(1e-12).states(system, state, 4.0))
        assert all((s.remainder is not None) == (offset > 0) for s in states)
        ends.append(np.concatenate([turned(states[-1]), *states[-1].velocities]))
    assert np.abs(ends[1] - ends[0]).max() < 2e-11
    # On its way there.
    system, state = rotor(1.3, force=force)
    away = State(state.positions, state.velocities + np.array([40.0, 0, 0]))
    states = list(Extrapolation(1e-12, speed=1.0).states(system, away, 4.0))
    assert states[0].remainder is None and states[-1].remainder is not None
    assert np.abs(turned(states[-1]) - ends[0][:3]).max() < 1e-10


# -- what is refused, and where steps end --------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "item"),
    [
        *(({"tolerance": bad}, "tolerance") for bad in (0.0, -1e-3, 9e-15, np.nan, np.inf)),
        *(({item: bad}, item) for item in ("length", "speed") for bad in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_bad_numbers(options, item) -> None:
    with pytest.raises(InputError, match=f"{item} is .*; give a") as raised:
        Extrapolation(**options)
    assert raised.value.item == item


def test_what_is_refused_before_any_step() -> None:
    """Where `states` is called, not where its first state is asked for; `run` says that it is to be called."""
    system, state = spherical_pendulum()
    for until in (np.nan, np.inf, "1", None):
        with pytest.raises(InputError, match="until is"):
            Extrapolation().states(system, state, until)
    with pytest.raises(InputError, match=r"it chooses its own steps: .* states\("):
        run(system, state, 0.1, 3, stepper=Extrapolation())
    for first in (0.0, -0.1, np.nan):
        with pytest.raises(InputError, match="first_step is"):
            Extrapolation().states(system, state, 1.0, first_step=first)
    with pytest.raises(UnsupportedError, match="Extrapolation knows no thermostats"):
        Extrapolation().states(system, replace(state, thermostat=np.zeros(2)), 1.0)


def test_the_end_is_met_exactly_and_no_step_before_it_is_tiny() -> None:
    system, state = spherical_pendulum()
    assert list(Extrapolation().states(system, state, 0.0)) == []
    for until in (0.1, 1.0 / 3.0, 2.0, -0.7):
        states = list(Extrapolation(1e-8).states(system, state, until))
        assert states[-1].time == until and states[-1].time_remainder == 0.0
        sizes = np.abs(np.diff([0.0, *(s.time for s in states)]))
        assert sizes[-1] > 0.45 * sizes[-2:].max()
