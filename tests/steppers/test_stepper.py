"""What every stepper does: purity, errors, time steps, invariance; runs and what is recorded; steps taken back."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from stepper_systems import PROJECTED, SYMMETRIC, growing_rod, rotor, skate, spherical_pendulum

from kcons.errors import ConvergenceError, InputError, ReversibilityError, UnsupportedError
from kcons.steppers import BlanesMoan4, Geodesic, Rattle, ReversibilityCheck, State, System, run
from kcons.thermostats import HamiltonianMonteCarlo, Isokinetic, IsokineticSpheres, Langevin

REVERSIBLE = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)


def copies(state: State) -> list[np.ndarray | None]:
    return [None if a is None else a.copy() for a in (state.positions, state.velocities, state.forces)]


def assert_untouched(state: State, before: list[np.ndarray | None]) -> None:
    for array, copy in zip((state.positions, state.velocities, state.forces), before, strict=True):
        assert (array is None) == (copy is None)
        assert array is None or np.array_equal(array, copy)


# -- forces -----------------------------------------------------------------------------------------


@REVERSIBLE
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
        Langevin(1.0, 0.5, 1),
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


# -- time steps -------------------------------------------------------------------------------------


@REVERSIBLE
def test_steps_of_no_number_and_of_zero(stepper) -> None:
    system, state = rotor(force=lambda x, t: -x)
    before = copies(state)
    for dt in (np.nan, np.inf, -np.inf):
        with pytest.raises(InputError, match="time step"):
            stepper.step(system, state, dt)
    for dt in (0.0, -0.0):
        after = stepper.step(system, state, dt)
        assert np.array_equal(after.positions, state.positions) and np.array_equal(after.velocities, state.velocities)
        assert after.time == state.time and after.step == state.step + 1
    assert_untouched(state, before)


@REVERSIBLE
@pytest.mark.parametrize("make", [rotor, spherical_pendulum, growing_rod, skate], ids=lambda f: f.__name__)
def test_steps_are_taken_back(stepper, make) -> None:
    """One, and steps of any length by the same in reverse."""
    system, start = make()
    for steps, allowed in (([0.05], 4e-15), ([0.01, 0.02, 0.005, -0.01, 0.03], 6e-15)):
        state = start
        for dt in [*steps, *(-h for h in reversed(steps))]:
            state = stepper.step(system, state, dt)
            held = system.motion.constraint_set
            assert np.abs(held.value(state.positions, state.time)[held.holonomic]).max() <= 1e-14
        assert np.abs(state.positions - start.positions).max() <= allowed
        assert np.abs(state.velocities - start.velocities).max() <= 2e-14
        assert state.time == pytest.approx(0, abs=1e-16)


# -- invariance -------------------------------------------------------------------------------------


def test_reprs_build_the_stepper_again() -> None:
    names = {c.__name__: c for c in map(type, SYMMETRIC)}
    for stepper in SYMMETRIC:
        assert repr(eval(repr(stepper), names)) == repr(stepper)


# -- the check of reversibility --------------------------------------------------------------------------


class Drifting(Rattle):
    """Claims to be reversible and loses a little speed."""

    def step(self, system: System, state: State, dt: float) -> State:
        after = super().step(system, state, dt)
        return State(after.positions, after.velocities * (1 - 1e-7), after.time, None, after.step)


def test_check_finds_a_stepper_that_is_not_reversible() -> None:
    system, state = rotor()
    state = State(state.positions, state.velocities, step=6)
    before = copies(state)
    with pytest.raises(ReversibilityError, match="step 7 is not reversible: taken back, atom") as caught:
        ReversibilityCheck(Drifting()).step(system, state, 0.1)
    assert caught.value.step == 7 and 1e-8 < caught.value.residual < 1e-6
    assert_untouched(state, before)
    ReversibilityCheck(Drifting(), tolerance=1e-5).step(system, state, 0.1)


def test_check_reports_a_step_that_cannot_be_taken_back() -> None:
    class OneWay(Rattle):
        def step(self, system: System, state: State, dt: float) -> State:
            if dt < 0:
                raise ConvergenceError("no way back", residual=0.5, row=0, atoms=[0, 1])
            return super().step(system, state, dt)

    system, state = rotor()
    with pytest.raises(ReversibilityError, match="step 1 cannot be taken back: no way back") as caught:
        ReversibilityCheck(OneWay()).step(system, state, 0.1)
    assert caught.value.atoms == (0, 1) and caught.value.step == 1


def test_check_refuses_schemes_that_are_not_reversible() -> None:
    for stepper in PROJECTED:
        with pytest.raises(UnsupportedError, match="use Rattle, Geodesic, a Composition or a RungeKuttaNystrom"):
            ReversibilityCheck(stepper)


def test_check_works_far_from_the_origin_and_at_rest() -> None:
    system, state = rotor(omega=1.0, offset=1e6)
    run(system, state, 0.05, 20, stepper=ReversibilityCheck(Geodesic(2)))
    system, state = rotor(omega=0.0)
    run(system, state, 0.05, 3, stepper=ReversibilityCheck(Rattle()))


IMPOSSIBLE = [{"time": np.nan}, {"time": -np.inf}, {"time": 1j}, {"time": "a"}, {"time_remainder": np.nan}]
IMPOSSIBLE += [{"step": step} for step in (-3, 2.5, True, None)]


@pytest.mark.parametrize("impossible", IMPOSSIBLE, ids=str)
@pytest.mark.parametrize("stepper", [None, BlanesMoan4(), Langevin(1.0, 1.0, rng=1)], ids=str)
def test_states_made_by_hand_with_impossible_numbers(stepper, impossible) -> None:
    """In a run, which shows them to nobody, and in a step by itself."""
    system, state = rotor()
    wrong, seen = State(state.positions, state.velocities, **impossible), []
    (item,) = impossible
    with pytest.raises(InputError, match=f"^{item} is .*; give a") as caught:
        run(system, wrong, 0.1, 2, stepper=stepper, observers=[seen.append])
    assert caught.value.item == item and not seen
    with pytest.raises(InputError, match=f"^{item} is"):
        run(system, wrong, 0.1, 0, stepper=stepper)
    with pytest.raises(InputError, match=f"^{item} is"):
        (stepper or Rattle()).step(system, wrong, 0.1)


# -- trajectories -----------------------------------------------------------------------------------


@pytest.mark.parametrize("stepper", [None, BlanesMoan4()], ids=repr)
def test_frames_are_states_of_the_run(stepper):
    system, state = rotor()
    seen: list = []
    found = run(system, state, 0.01, 10, stepper=stepper, observers=[seen.append], every=2, record=4)
    assert [frame.step for frame in found.frames] == [0, 4, 8]
    np.testing.assert_array_equal(found.times, [seen[k].time for k in (0, 2, 4)])
    np.testing.assert_array_equal(found.positions, [seen[k].positions for k in (0, 2, 4)])
    np.testing.assert_array_equal(found.velocities, [seen[k].velocities for k in (0, 2, 4)])
    assert found.positions.shape == (3, *state.positions.shape)
    alone = run(system, state, 0.01, 10, stepper=stepper)
    assert found.last.step == 10
    np.testing.assert_array_equal(found.last.positions, alone.positions)
    for frame in found.frames[1:]:
        np.testing.assert_array_equal(frame.positions, run(system, state, 0.01, frame.step, stepper=stepper).positions)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_frames_of_a_run_that_stops_are_kept(error):
    system, state = rotor()

    def forces(x, t):
        if t > 0.065:
            raise error
        return np.zeros_like(x)

    with pytest.raises(error) as raised:
        run(System(system.motion, forces), state, 0.01, 10, record=2)
    assert [frame.step for frame in raised.value.trajectory.frames] == [0, 2, 4, 6]
    with pytest.raises(ZeroDivisionError) as raised:
        run(system, state, 0.01, 3, observers=[lambda s: 1 / 0], record=1)
    assert raised.value.trajectory.frames == []
