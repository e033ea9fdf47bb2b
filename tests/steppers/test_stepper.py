"""What every stepper promises: purity, failure, reversal, invariance; running; the reversibility check."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from stepper_systems import (
    EVERY,
    SYMMETRIC,
    gravity,
    growing_rod,
    rotor,
    spherical_pendulum,
    system_of,
)

from kcons.constraints import Angle, Distance
from kcons.errors import ConvergenceError, InputError, NonFiniteError
from kcons.steppers import (
    Baumgarte,
    ProjectedRungeKutta4,
    ProjectedVerlet,
    State,
    System,
    run,
)
from kcons.thermostats import HamiltonianMonteCarlo, Isokinetic, IsokineticSpheres, Langevin

ALL = pytest.mark.parametrize("stepper", EVERY, ids=repr)
REVERSIBLE = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)

DECLARED = {
    # order, reversible, symplectic, force evaluations
    "Rattle()": (2, True, True, 1),
    "Geodesic(substeps=4)": (2, True, True, 1),
    "Yoshida4()": (4, True, True, 3),
    "Suzuki4()": (4, True, True, 5),
    "KahanLi6()": (6, True, True, 9),
    "BlanesMoan4()": (4, True, True, 6),
    "BlanesMoan6()": (6, True, True, 11),
    "BlanesMoan6a()": (6, True, True, 14),
    "ProjectedVerlet()": (2, False, False, 1),
    "ProjectedVerlet(project=True)": (2, False, False, 1),
    "ProjectedRungeKutta4()": (4, False, False, 4),
    "ProjectedRungeKutta4(project=True)": (4, False, False, 4),
    "Baumgarte(rate=1)": (4, False, False, 4),
}


def copies(state: State) -> list[np.ndarray | None]:
    return [None if a is None else a.copy() for a in (state.positions, state.velocities, state.forces)]


def assert_untouched(state: State, before: list[np.ndarray | None]) -> None:
    for array, copy in zip((state.positions, state.velocities, state.forces), before, strict=True):
        assert (array is None) == (copy is None)
        assert array is None or np.array_equal(array, copy)


def molecule(force=None) -> tuple[System, State]:
    """A bent molecule and a free atom, tied by springs."""
    rng = np.random.default_rng(4)
    x = np.array([[1.0, 0.1, 0.0], [0.0, 0.0, 0.0], [-0.9, 0.3, 0.2], [0.4, 1.5, 0.3]])
    system = system_of([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], x, [1.0, 3.0, 2.0, 1.5], force or springs)
    return system, system.initial_state(x, 0.3 * rng.normal(size=(4, 3)), project=True)


def springs(x: np.ndarray, t: float) -> np.ndarray:
    """Between all pairs; independent of origin, orientation and order of the atoms."""
    d = x[:, None] - x[None]
    return -np.sum(d * (1 - 0.5 / (1 + np.sum(d**2, axis=-1, keepdims=True))), axis=1)


# -- what each states -------------------------------------------------------------------------------


@ALL
def test_declared_properties(stepper) -> None:
    declared = stepper.order, stepper.reversible, stepper.symplectic, stepper.force_evaluations
    assert declared == DECLARED[repr(stepper)]


@ALL
def test_documentation_says_what_it_is_not_for(stepper) -> None:
    documentation = type(stepper).__doc__
    assert "Not " in documentation, "what it may not be used with"
    assert f"order {stepper.order}" in documentation.lower()
    assert "force evaluation" in documentation
    assert "eversible" in documentation and "ymplectic" in documentation


@ALL
def test_force_evaluations_are_as_declared(stepper) -> None:
    calls = []

    def force(x, t):
        calls.append(t)
        return -x

    system, state = rotor(force=force)
    state = run(system, state, 0.05, 1, stepper=stepper)
    calls.clear()
    run(system, state, 0.05, 7, stepper=stepper)
    assert len(calls) == 7 * stepper.force_evaluations


# -- purity and failure -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "stepper",
    [
        Langevin(1.0, 0.5, 1, conserve_momentum=True),
        Isokinetic(1.0),
        HamiltonianMonteCarlo(1.0, 2, 3),
        IsokineticSpheres(1.0, 0.5, 2),
    ],
    ids=lambda stepper: type(stepper).__name__,
)
def test_copies_leave_behind_what_was_found_for_a_system(stepper) -> None:
    """Whose functions need not be any that pickle knows."""
    system, state = rotor(force=lambda x, t: -x * [1.0, 2.0, 3.0], potential=lambda x, t: float((x**2).sum()))
    state = run(system, state, 0.01, 2, stepper=stepper)
    again = pickle.loads(pickle.dumps(stepper))
    np.testing.assert_array_equal(
        run(system, state, 0.01, 3, stepper=stepper).positions, run(system, state, 0.01, 3, stepper=again).positions
    )


@ALL
def test_step_is_pure(stepper) -> None:
    system, state = molecule()
    state = system.with_forces(state)
    before = copies(state)
    first, second = (stepper.step(system, state, 0.05) for _ in range(2))
    assert np.array_equal(first.positions, second.positions)
    assert np.array_equal(first.velocities, second.velocities)
    assert first.time == 0.05 and first.step == 1
    assert_untouched(state, before)


@ALL
def test_a_calculator_may_reuse_its_array(stepper) -> None:
    buffer = np.zeros((4, 3))

    def force(x, t):
        np.copyto(buffer, springs(x, t))
        return buffer

    (one, start), (other, _) = molecule(force), molecule()
    a, b = run(one, start, 0.05, 5, stepper=stepper), run(other, start, 0.05, 5, stepper=stepper)
    assert np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)
    assert a.forces is None or not np.shares_memory(a.forces, buffer)


@ALL
def test_a_calculator_may_keep_what_it_is_given(stepper) -> None:
    kept: list[tuple[np.ndarray, np.ndarray]] = []

    def force(x, t):
        kept.append((x, x.copy()))
        return springs(x, t)

    system, state = molecule(force)
    run(system, state, 0.05, 3, stepper=stepper)
    assert all(np.array_equal(x, copy) for x, copy in kept)


@ALL
@pytest.mark.parametrize("kind", [list, np.float32, np.asfortranarray])
def test_forces_may_be_any_array_of_numbers(stepper, kind) -> None:
    given = np.arange(6.0).reshape(2, 3)
    as_other = given.tolist() if kind is list else kind(given)
    (one, start), (other, _) = rotor(force=lambda x, t: as_other), rotor(force=lambda x, t: given)
    a, b = run(one, start, 0.05, 3, stepper=stepper), run(other, start, 0.05, 3, stepper=stepper)
    assert np.array_equal(a.positions, b.positions)


def breaks_at(k: int, damage):
    """Forces that go wrong within step k of 0.05; the stages of the step before it end at most 0.36 steps later."""

    def force(x, t):
        return damage(springs(x, t)) if t > (k - 0.6) * 0.05 else springs(x, t)

    return force


def spoiled(value):
    def damage(f):
        f[2, 1] = value
        return f

    return damage


@ALL
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_force_names_step_and_atom(stepper, value) -> None:
    system, state = molecule(breaks_at(3, spoiled(value)))
    seen: list[State] = []
    with pytest.raises(NonFiniteError, match="non-finite force at step 3 on atom 2") as caught:
        run(system, state, 0.05, 10, stepper=stepper, observers=[seen.append])
    assert (caught.value.step, caught.value.atom, caught.value.item) == (3, 2, "force")
    last = seen[-1]
    assert last.step == 2
    before = copies(last)
    with pytest.raises(NonFiniteError):
        stepper.step(system, last, 0.05)
    assert_untouched(last, before)
    # From the last good state the run goes on with forces that are right.
    good, start = molecule()
    resumed, whole = run(good, last, 0.05, 2, stepper=stepper), run(good, start, 0.05, 4, stepper=stepper)
    assert np.array_equal(resumed.positions, whole.positions)


@ALL
@pytest.mark.parametrize("damage", [lambda f: f[:3], lambda f: f.ravel(), lambda f: f[:, :2], lambda f: 0.0])
def test_wrong_force_shape_names_the_step(stepper, damage) -> None:
    system, state = molecule(breaks_at(3, damage))
    seen: list[State] = []
    with pytest.raises(InputError, match=r"shape .* at step 3; it must return \(4, 3\)"):
        run(system, state, 0.05, 10, stepper=stepper, observers=[seen.append])
    assert seen[-1].step == 2 and np.isfinite(seen[-1].positions).all()


@ALL
@pytest.mark.parametrize("value", ["text", [[1, 2], [3]], None], ids=["text", "ragged", "none"])
def test_forces_that_are_no_numbers(stepper, value) -> None:
    system, state = rotor(force=lambda x, t: value)
    with pytest.raises(InputError, match="force function"):
        stepper.step(system, state, 0.05)


@ALL
def test_an_error_of_the_force_function_passes_through(stepper) -> None:
    def damage(f):
        raise ZeroDivisionError("in the calculator")

    system, state = molecule(breaks_at(2, damage))
    state = run(system, state, 0.05, 1, stepper=stepper)
    before = copies(state)
    with pytest.raises(ZeroDivisionError, match="in the calculator"):
        stepper.step(system, state, 0.05)
    assert_untouched(state, before)


@ALL
def test_overflow_is_named_and_not_returned(stepper) -> None:
    system = system_of([], np.zeros((2, 3)), [1, 1], lambda x, t: np.full((2, 3), 1e300))
    with pytest.raises(NonFiniteError, match=r"non-finite (position|velocity) at step 1 on atom 0"):
        stepper.step(system, system.initial_state(np.zeros((2, 3))), 1e10)


@REVERSIBLE
def test_too_large_a_step_raises_and_changes_nothing(stepper) -> None:
    system, state = rotor(omega=1.0)
    state = State(state.positions, state.velocities, step=41)
    before = copies(state)
    with pytest.raises(ConvergenceError, match=r"step 42: time step too large \(dt = 100\)") as caught:
        stepper.step(system, state, 100.0)
    assert caught.value.step == 42 and caught.value.atoms == (0, 1)
    assert_untouched(state, before)


# -- time steps -------------------------------------------------------------------------------------


@ALL
@pytest.mark.parametrize("dt", [np.nan, np.inf, -np.inf])
def test_bad_time_step(stepper, dt) -> None:
    system, state = molecule()
    before = copies(state)
    with pytest.raises(InputError, match="time step"):
        stepper.step(system, state, dt)
    assert_untouched(state, before)


@ALL
@pytest.mark.parametrize("dt", [0.0, -0.0])
def test_zero_step_changes_nothing(stepper, dt) -> None:
    system, state = molecule()
    after = stepper.step(system, state, dt)
    assert np.array_equal(after.positions, state.positions)
    assert np.array_equal(after.velocities, state.velocities)
    assert after.time == state.time and after.step == state.step + 1


@REVERSIBLE
@pytest.mark.parametrize("make", [molecule, rotor, spherical_pendulum, growing_rod], ids=lambda f: f.__name__)
def test_negative_step_takes_a_step_back(stepper, make) -> None:
    system, start = make()
    back = stepper.step(system, stepper.step(system, start, 0.05), -0.05)
    assert np.abs(back.positions - start.positions).max() <= 4e-15
    assert np.abs(back.velocities - start.velocities).max() <= 1e-14
    assert back.time == start.time


@REVERSIBLE
def test_step_size_may_change_on_the_way(stepper) -> None:
    """Forward by steps of any length, and back by the same in reverse."""
    system, start = molecule()
    steps = [0.01, 0.02, 0.005, -0.01, 0.03]
    state = start
    for dt in [*steps, *(-h for h in reversed(steps))]:
        state = stepper.step(system, state, dt)
        assert np.abs(system.motion.constraint_set.value(state.positions)).max() <= 1e-14
    assert np.abs(state.positions - start.positions).max() <= 4e-15
    assert state.time == pytest.approx(0, abs=1e-16)


@REVERSIBLE
def test_opposite_velocities_lead_back(stepper) -> None:
    system, start = spherical_pendulum()
    end = run(system, start, 0.05, 200, stepper=stepper)
    back = run(system, end.reversed(), 0.05, 200, stepper=stepper)
    assert np.abs(back.positions - start.positions).max() <= 1e-12
    assert np.abs(back.velocities + start.velocities).max() <= 1e-12


# -- invariance -------------------------------------------------------------------------------------


@ALL
def test_order_of_atoms_does_not_matter(stepper) -> None:
    system, start = molecule()
    new = np.array([2, 0, 3, 1])  # atom new[i] of the old order is atom i of the new one
    place = np.argsort(new)
    x = start.positions[new]
    rows = [Angle([place[[0, 1, 2]]]), Distance([place[[1, 2]], place[[0, 1]]])]
    other = system_of(rows, x, system.masses[new], springs)
    a = run(system, start, 0.02, 100, stepper=stepper)
    b = run(other, other.initial_state(x, start.velocities[new]), 0.02, 100, stepper=stepper)
    assert np.abs(a.positions[new] - b.positions).max() <= 1e-12
    assert np.abs(a.velocities[new] - b.velocities).max() <= 1e-12


@ALL
def test_orientation_and_place_do_not_matter(stepper) -> None:
    system, start = molecule()
    turn, _ = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    there = start.positions @ turn.T + [3.0, -2.0, 5.0]
    other, _ = molecule()
    a = run(system, start, 0.02, 100, stepper=stepper)
    b = run(other, other.initial_state(there, start.velocities @ turn.T), 0.02, 100, stepper=stepper)
    assert np.abs(a.positions @ turn.T + [3.0, -2.0, 5.0] - b.positions).max() <= 1e-12
    assert np.abs(a.velocities @ turn.T - b.velocities).max() <= 1e-12


@ALL
def test_moving_frame_does_not_matter(stepper) -> None:
    system, start = molecule()
    drift = np.array([0.3, -0.2, 0.1])
    moving = system.initial_state(start.positions, start.velocities + drift)
    a, b = run(system, start, 0.02, 100, stepper=stepper), run(system, moving, 0.02, 100, stepper=stepper)
    assert np.abs(a.positions + 2.0 * drift - b.positions).max() <= 1e-12


# -- run --------------------------------------------------------------------------------------------


# -- the reversibility check ------------------------------------------------------------------------


def test_reprs_build_the_stepper_again() -> None:
    names = {c.__name__: c for c in (*map(type, EVERY), Baumgarte, ProjectedVerlet, ProjectedRungeKutta4)}
    for stepper in EVERY:
        assert repr(eval(repr(stepper), names)) == repr(stepper)


def test_gravity_alone_is_exact() -> None:
    """Every symmetric scheme of order 2 or more integrates a parabola without error."""
    x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0]])
    system = system_of([], x, [1.0, 2.0], gravity([1.0, 2.0]))
    start = system.initial_state(x, [[1.0, 0.0, 2.0], [0.0, 1.0, 0.0]])
    for stepper in EVERY:
        end = run(system, start, 0.25, 8, stepper=stepper)
        assert np.abs(end.positions - (x + 2.0 * start.velocities + [0, 0, -2.0])).max() <= 1e-14, stepper
