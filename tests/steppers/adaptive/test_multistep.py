"""Steps from the accelerations of earlier ones: their rules, errors as tolerated, evaluations, and what is passed."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from stepper_attempts import counted, end_of, scene_system
from stepper_systems import gravity, growing_rod, rotor, skate, spherical_pendulum, system_of

from kcons.comparison import test_systems
from kcons.constraints import FixedAtoms
from kcons.errors import ConvergenceError, NonFiniteError
from kcons.steppers import Extrapolation, Multistep, State, System
from kcons.steppers.adaptive.multistep import MOST, _rule

# -- rules --------------------------------------------------------------------------------------

#: Times of earlier steps: equal ones, those of a start that doubles, and one after a rejected step.
TIMES = {
    "equal": [Fraction(-j) for j in range(MOST + 1)],
    "doubled": [Fraction(2**-j) - 1 for j in range(MOST + 1)],
    "halved": [Fraction(0), *(Fraction(-2 * j) for j in range(1, MOST + 1))],
}


@pytest.mark.parametrize("times", TIMES.values(), ids=TIMES)
@pytest.mark.parametrize("k", [1, 2, 5, MOST])
def test_polynomials_are_integrated_exactly(times, k) -> None:
    nodes = tuple(float(t) for t in times[: k + 1])
    rule = _rule(nodes, k)
    for degree in range(k + 1):
        past = np.array([float(t**degree) for t in times[: k + 1]])
        speed, way = 1.0 / (degree + 1), 1.0 / ((degree + 1) * (degree + 2))
        predicted, off = rule.sums @ past, 1.0 - (rule.sums @ past)[2]
        size = np.abs(rule.sums).sum() * np.abs(past).max() * 4e-16
        if degree < k:
            np.testing.assert_allclose(predicted[:3], [speed, way, 1.0], rtol=0, atol=1e-15 + size)
        # With the acceleration at the end the degree is one higher.
        corrected = predicted[:2] + rule.correction * off
        np.testing.assert_allclose(corrected, [speed, way], rtol=0, atol=1e-15 + size)


@pytest.mark.parametrize("times", TIMES.values(), ids=TIMES)
def test_the_estimate_is_what_one_acceleration_less_would_give(times) -> None:
    k = 4
    past = np.exp(np.array([float(t) for t in times[: k + 1]]))
    rules = {j: _rule(tuple(float(t) for t in times[: j + 1]), j) for j in (k - 2, k - 1, k, k + 1)}

    def corrected(j: int, points: int) -> np.ndarray:
        """By a polynomial through the end and so many past points."""
        nodes = [1.0, *(float(t) for t in times[:points])]
        c = np.polynomial.Polynomial.fit(nodes, np.exp(nodes), points).convert().coef
        n = np.arange(len(c))
        return np.array([np.sum(c / (n + 1)), np.sum(c / ((n + 1) * (n + 2)))])

    off = np.exp(1.0) - (rules[k].sums @ past)[2:]
    for row, j in enumerate((k, k - 1, k - 2, k + 1)):
        wanted = np.abs(corrected(j, j) - corrected(j, j - 1))
        np.testing.assert_allclose(rules[k].estimates[row] * abs(off[row]), wanted, rtol=1e-6)


# -- errors and evaluations ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "most", "share"),
    [("dumbbells", 300.0, 0.6), ("triple-pendulum", 60.0, 1.05), ("sphere-pendulum-top", 15.0, 0.8)],
)
def test_errors_are_proportional_to_the_tolerance(name, most, share) -> None:
    """And at most that share of the evaluations of `Extrapolation` at its error."""
    test_system = test_systems.build(name)
    exact = test_system.reference().positions
    system, times = scene_system(test_system)
    start = State(test_system.positions, test_system.velocities)

    def measured(scheme) -> tuple[float, int]:
        times.clear()
        end = end_of(scheme, system, start, test_system.horizon)
        return float(np.sqrt(np.mean(np.sum((end.positions - exact) ** 2, axis=1)))), len(times)

    tolerances = np.array([1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
    errors, calls = zip(*(measured(Multistep(tolerance)) for tolerance in tolerances), strict=True)
    assert np.all(np.array(errors) <= most * tolerances)
    assert np.polyfit(np.log(tolerances), np.log(errors), 1)[0] == pytest.approx(1.0, abs=0.2)
    assert list(calls) == sorted(calls)
    error, theirs = measured(Extrapolation(1e-9))
    mine = np.interp(np.log(error), np.log(errors[::-1]), np.log(calls[::-1]))
    assert np.exp(mine) < share * theirs


def test_one_evaluation_an_attempt_and_one_at_the_start() -> None:
    system, state = spherical_pendulum()
    system, times = counted(system)
    states = list(Multistep(1e-8).states(system, state, 3.0))
    rejected = len(times) - 1 - len(states)
    assert times.count(0.0) == 1 and 0 <= rejected <= 4
    assert all(s.forces is None for s in states)
    # Those of the start are taken, if it has them.
    times.clear()
    again = list(Multistep(1e-8).states(system, replace(state, forces=gravity([1, 1])(state.positions, 0.0)), 3.0))
    assert 0.0 not in times and np.array_equal(again[-1].positions, states[-1].positions)


def test_orders_are_raised_to_the_most_that_help(monkeypatch) -> None:
    from kcons.steppers.adaptive import multistep

    orders: list[int] = []
    rule = multistep._rule
    monkeypatch.setattr(multistep, "_rule", lambda nodes, k: orders.append(k) or rule(nodes, k))
    system, state = spherical_pendulum()
    list(Multistep(1e-4).states(system, state, 8.0))
    loose = orders.copy()
    orders.clear()
    list(Multistep(1e-11).states(system, state, 8.0))
    assert loose[0] == orders[0] == 1 and max(np.diff(orders)) == 1
    assert np.median(loose) <= 6 < np.median(orders)


@pytest.mark.parametrize("make", [spherical_pendulum, growing_rod, skate])
def test_what_is_held_holds_at_loose_tolerances(make) -> None:
    system, state = make()
    held = system.motion.constraint_set
    for s in Multistep(1e-3).states(system, state, 1.5):
        assert np.abs(held.value(s.positions, s.time)).max(initial=0.0) <= 1e-14
        slip = held.jacobian(s.positions, s.time) @ s.velocities.ravel() - held.velocity_target(s.positions, s.time)
        assert np.abs(slip).max(initial=0.0) <= 1e-14


@pytest.mark.parametrize("make", [spherical_pendulum, growing_rod, skate])
def test_there_and_back_in_time(make) -> None:
    system, state = make()
    states = list(Multistep(1e-11).states(system, state, 1.5))
    there = states[-1]
    assert there.time == 1.5 and there.time_remainder == 0.0
    assert [s.step for s in states] == list(range(1, len(states) + 1))
    known = end_of(Extrapolation(1e-12), system, state, 1.5)
    assert np.abs(there.positions - known.positions).max() < 1e-9
    back = end_of(Multistep(1e-11), system, there, 0.0)
    assert back.time == 0.0
    assert np.abs(back.positions - state.positions).max() < 1e-9
    assert np.abs(back.velocities - state.velocities).max() < 1e-9


# -- what may act -------------------------------------------------------------------------------


def test_velocities_and_friction() -> None:
    """A charge in a field on a rod, and what slows down."""

    def force(x, v, t):
        return np.cross(v, [0.2, 0.0, 1.5]) + np.array([0.1 * t, 0, 0])

    for options in ({}, {"friction": 0.5}):
        system, state = rotor(1.3, force=force, velocity_dependent=True, **options)
        found, known = (end_of(scheme, system, state, 2.0) for scheme in (Multistep(1e-10), Extrapolation(1e-12)))
        assert np.abs(found.positions - known.positions).max() < 1e-8
        assert np.abs(found.velocities - known.velocities).max() < 1e-8


def test_nothing_held_nothing_acting_nothing_moving() -> None:
    x = np.array([[0.0, 0, 0], [1.0, 2, 3]])
    free = system_of([], x, [1, 2])
    (rest,) = Multistep().states(free, free.initial_state(x), 3.0)
    assert np.array_equal(rest.positions, x) and rest.time == 3.0
    fixed = system_of([FixedAtoms([0, 1])], x, [1, 2], gravity([1, 2]))
    assert np.array_equal(end_of(Multistep(), fixed, fixed.initial_state(x), 3.0).positions, x)
    falling = system_of([FixedAtoms([0])], x, [1, 2], gravity([1, 2]))
    states = list(Multistep(1e-12).states(falling, falling.initial_state(x), 2.0))
    assert np.abs(states[-1].positions - (x - [[0, 0, 0], [0, 0, 2.0]])).max() < 1e-13
    assert len(states) < 50  # fixed atoms count nothing, and a polynomial is met exactly


def test_the_start_is_not_changed() -> None:
    system, state = spherical_pendulum()
    before = [a.copy() for a in (state.positions, state.velocities)]
    kept = [(s, s.positions.copy(), s.velocities.copy()) for s in Multistep(1e-8).states(system, state, 2.0)]
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])
    assert all(np.array_equal(s.positions, x) and np.array_equal(s.velocities, v) for s, x, v in kept)


def test_far_from_the_origin() -> None:
    def force(x, t):
        return np.array([[0.3], [-0.3]]) * [np.sin(t), 0.2, 0.1]

    ends = []
    for offset in (0.0, 1e6):
        system, state = rotor(1.3, force=force, offset=offset)
        s = end_of(Multistep(1e-12), system, state, 4.0)
        assert (s.remainder is not None) == (offset > 0)
        d = s.positions[0] - s.positions[1]
        ends.append(
            np.concatenate([d if s.remainder is None else d + (s.remainder[0] - s.remainder[1]), *s.velocities])
        )
    assert np.abs(ends[1] - ends[0]).max() < 2e-10


# -- what is passed, and what is not ------------------------------------------------------------


@pytest.mark.parametrize("jumps", [lambda x, t: t > 0.5123, lambda x, t: x[1, 1] > 0.3], ids=["time", "place"])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_forces_that_jump_are_passed(jumps, tolerance) -> None:
    """No order there: the past is forgotten."""
    system, state = spherical_pendulum()
    weight = gravity([1, 1])
    jumping, times = counted(System(system.motion, lambda x, t: weight(x, t) * (-2.0 if jumps(x, t) else 1.0)))
    end = end_of(Multistep(tolerance), jumping, state, 1.0)
    assert len(times) < 400
    finer = end_of(Extrapolation(1e-12), jumping, state, 1.0)
    assert np.abs(end.positions - finer.positions).max() < 100 * tolerance + 1e-10


def test_short_steps_where_they_are_needed() -> None:
    """A passage of 0.1 in a flight of 20."""
    system, state = rotor(
        0.4, force=lambda x, t: np.array([[1.0], [-1.0]]) * [0.0, 0.2, 0.1] / (1 + 400 * (t - 10) ** 2)
    )
    states = list(Multistep(1e-9).states(system, state, 20.0))
    times = np.array([0.0, *(s.time for s in states)])
    sizes, near = np.diff(times), np.abs(times[1:] - 10) < 0.1
    assert sizes[near].max() < 0.02 < 0.2 < sizes[~near].max()
    assert np.abs(states[-1].positions - end_of(Extrapolation(1e-12), system, state, 20.0).positions).max() < 1e-7


def test_forces_that_end() -> None:
    system, state = spherical_pendulum()
    weight = gravity([1, 1])
    broken = System(system.motion, lambda x, t: weight(x, t) * (np.nan if t > 0.5 else 1.0))
    seen = [state]
    with pytest.raises(NonFiniteError, match="the force function there") as raised:
        seen.extend(Multistep(1e-9).states(broken, state, 1.0))
    assert raised.value.step == seen[-1].step + 1 and 0.5 - 1e-13 < seen[-1].time <= 0.5
    on = end_of(Multistep(1e-9), system, seen[-1], 1.0)
    assert np.abs(on.positions - end_of(Extrapolation(1e-12), system, state, 1.0).positions).max() < 1e-6


def test_forces_without_an_error_that_shrinks() -> None:
    system, state = spherical_pendulum()
    rng = np.random.default_rng(3)
    noisy = System(system.motion, lambda x, t: 1e12 * rng.standard_normal(x.shape))
    with pytest.raises(ConvergenceError, match="jump or are noisy: make them smooth") as raised:
        list(Multistep(1e-12, speed=1.0).states(noisy, state, 1.0))
    assert raised.value.step == 1 and raised.value.residual > raised.value.tolerance == 1e-12
