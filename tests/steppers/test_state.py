"""States, systems and runs: starts, files, whose forces, far places; what every stepper does, and steps taken back."""

from __future__ import annotations

import io
import pickle
from dataclasses import replace

import numpy as np
import pytest
from stepper_systems import (
    PROJECTED,
    SYMMETRIC,
    assert_same,
    gravity,
    growing_rod,
    rotor,
    skate,
    spherical_pendulum,
    system_of,
)

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance, FixedAtoms, MovingTarget, Plane, Sphere
from kcons.errors import ConvergenceError, InputError, NonFiniteError, ReversibilityError, UnsupportedError
from kcons.steppers import BlanesMoan4, BlanesMoan6, Geodesic, Rattle, ReversibilityCheck, State, System, run
from kcons.thermostats import HamiltonianMonteCarlo, Isokinetic, IsokineticSpheres, Langevin, NoseHooverChain

REVERSIBLE = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)


def test_start_off_the_constraints():
    """What is within rounding is taken as given, also in single precision."""
    system, state = rotor()
    again = system.initial_state(state.positions, state.velocities)
    assert np.array_equal(again.positions, state.positions) and np.array_equal(again.velocities, state.velocities)
    assert system.initial_state(state.positions.astype(np.float32), project=True).positions.dtype == np.float64
    off = state.positions * 1.2
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.24; pass project=True"):
        system.initial_state(off)
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.24; pass project=True"):
        run(system, State(off, state.velocities), 0.01, 1)
    projected = system.initial_state(off, project=True)
    assert np.linalg.norm(projected.positions[0] - projected.positions[1]) == pytest.approx(1.2, rel=1e-14)
    assert np.abs(system.masses @ (projected.positions - off)).max() <= 1e-14


@pytest.mark.parametrize("stepper", [Rattle(), Langevin(0.5, 1.0, rng=1)])
def test_states_are_changed_by_replace_only(stepper):
    """In place, forces of the places that were would go with new ones; runs go on from them as before, at no cost."""
    system, state = rotor()
    calls = []

    def force(x, t):
        calls.append(t)
        return -0.3 * x

    system = System(system.motion, force)
    free = System(Motion(ConstraintSet([], state.positions, system.masses), state.positions))
    begin = system.initial_state(state.positions, state.velocities)
    end = run(system, begin, 0.01, 4, stepper=stepper)
    arrays = [system.weights, system.inverse_masses]
    for each in (begin, end, stepper.step(system, end, 0.01), free.initial_state(state.positions, state.velocities)):
        arrays += [a for a in vars(each).values() if isinstance(a, np.ndarray)]
    assert len(arrays) >= 2 + 2 + 3 + 3 + 2
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    assert run(system, end, 0.01, 0, stepper=stepper) is end
    before = len(calls)
    after = run(system, end, 0.01, 3, stepper=stepper)
    assert len(calls) == before + 3
    whole = run(system, system.initial_state(state.positions, state.velocities), 0.01, 7, stepper=stepper)
    assert np.array_equal(after.positions, whole.positions) and np.array_equal(after.velocities, whole.velocities)
    with pytest.raises(InputError, match="off row"):
        run(system, replace(after, positions=1.2 * after.positions), 0.01, 1, stepper=stepper)


@pytest.mark.parametrize("time", [1e-300, 1e-16, -1e-16, 0.0, 1e-3])
def test_velocities_of_a_rod_that_grows(time):
    """What an atom can have moved since time 0 says nothing of where it will go; without velocities, the rod's own."""
    rod = Distance([0, 1], MovingTarget(lambda t: 1.2 + 0.5 * t, lambda t: 0.5, lambda t: 0.0))
    positions = np.array([[0.0, 0.0, 0.0], [1.2 + 0.5 * time, 0.0, 0.0]])
    system = system_of([FixedAtoms([0]), rod], positions, [1, 1])
    with pytest.raises(InputError, match="initial velocities violate"):
        system.initial_state(positions, np.array([[0, 0, 0], [0.6, 0, 0]]), time=time)
    assert system.initial_state(positions, np.array([[0, 0, 0], [0.5, 0, 0]]), time=time).time == time
    assert system.initial_state(positions, time=time).velocities[1] == pytest.approx([0.5, 0, 0], abs=1e-15)


# -- saving -----------------------------------------------------------------------------------------


def whole_state() -> State:
    rng = np.random.default_rng(2)
    x, v, f, low = rng.normal(size=(4, 2, 3))
    return State(x, v, 0.1, f, 7, 1e-12 * low, 1e-18, np.array([0.3, 0.1]))


@pytest.fixture(scope="module")
def saved() -> bytes:
    file = io.BytesIO()
    whole_state().save(file)
    return file.getvalue()


@pytest.mark.parametrize("bits", [0x01, 0x7F, 0xFF])
def test_a_damaged_byte_is_noticed(saved: bytes, bits: int) -> None:
    content = bytearray(saved)
    for i in range(len(content)):
        content[i] ^= bits
        with pytest.raises(InputError, match="holds no state"):
            State.load(io.BytesIO(bytes(content)))
        content[i] ^= bits
    assert_same(State.load(io.BytesIO(saved)), whole_state())


# -- time, and whose forces -------------------------------------------------------------------------


def pendulum(g: float) -> tuple[System, State, list[float]]:
    """A pendulum of three atoms in a field of its own, and the field of each evaluation."""
    asked: list[float] = []

    def force(x: np.ndarray, t: float) -> np.ndarray:
        asked.append(g)
        return np.tile([0.0, 0.0, -g], (3, 1))

    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    system = system_of([FixedAtoms([0]), Distance([[0, 1], [1, 2]])], x, np.ones(3), force, potential=lambda x, t: 0.0)
    return system, system.initial_state(x), asked


STEPPERS = [Rattle(), BlanesMoan6(), Geodesic()]


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
@pytest.mark.parametrize("stepper", [*STEPPERS, Langevin(1.0, 1.0, 5), NoseHooverChain(1.0, 5.0)], ids=repr)
def test_forces_of_another_system_are_not_taken(stepper) -> None:
    here, start, asked = pendulum(1.0)
    there = pendulum(7.0)[0]
    end = stepper.step(there, start, 0.05)
    asked.clear()
    taken = stepper.step(here, end, 0.05)
    made = State(end.positions, end.velocities, end.time, None, end.step, end.remainder, end.time_remainder)
    assert set(asked) == {1.0} and np.array_equal(taken.positions, stepper.step(here, made, 0.05).positions)


@REVERSIBLE
@pytest.mark.parametrize("by_hand", [True, False])
def test_forces_are_nothing_to_a_system_without(stepper, by_hand) -> None:
    """Also not once steps go on: those of the state that they began from stayed in the states."""
    (system, state), (other, _), (driven, _) = rotor(), rotor(), rotor(force=lambda x, t: 0 * x + 1.0)
    pushed = replace(driven.with_forces(state), **({"origin": None} if by_hand else {}))
    assert not system.with_forces(pushed).forces.any()
    for _ in range(3):
        pushed, state = stepper.step(system, pushed, 0.01), stepper.step(other, state, 0.01)
        assert np.array_equal(pushed.velocities, state.velocities)


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_forces_are_kept_at_their_positions_only(stepper) -> None:
    system, start, asked = pendulum(1.0)
    end = stepper.step(system, start, 0.05)
    assert np.array_equal(system.with_forces(end).forces, end.forces)
    asked.clear()
    stepper.step(system, end, 0.05)
    once = len(asked)
    asked.clear()
    stepper.step(system, replace(end, velocities=end.velocities / 2), 0.05)
    assert len(asked) == once
    asked.clear()
    same = stepper.step(system, replace(end, positions=end.positions.copy()), 0.05)
    assert len(asked) == once and np.array_equal(same.positions, stepper.step(system, end, 0.05).positions)
    asked.clear()
    turned = replace(end, positions=end.positions[:, [1, 0, 2]], velocities=end.velocities[:, [1, 0, 2]])
    stepper.step(system, turned, 0.05)
    first = len(stepper.kicks) > 0 and stepper.operations(system)[0].verb == "kick"
    assert len(asked) == once + first


@pytest.mark.parametrize("change", [{"time": 5.0}, {"velocities": np.array([[0.0, 0, 0], [0, 1, 0], [0, 1, 0]])}])
def test_forces_are_kept_at_their_time_and_velocities_only(change) -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    moving = "velocities" in change

    def pull(x, *more):
        return np.array(x) * (1 + more[-1] + (more[0] if moving else 0.0))

    rows = [FixedAtoms([0]), Distance([[0, 1], [1, 2]])]
    system = System(Motion(ConstraintSet(rows, x, np.ones(3)), x), pull, velocity_dependent=moving)
    start = system.initial_state(x)
    later = Rattle().step(system, replace(system.with_forces(start), **change), 0.05)
    assert_same(later, Rattle().step(system, replace(start, **change), 0.05))


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
def test_another_system_begins_a_thermostat_anew() -> None:
    here, start, _ = pendulum(1.0)
    there = pendulum(7.0)[0]
    chain = NoseHooverChain(1.0, 5.0)
    warm = run(there, start, 0.05, 20, stepper=chain)
    assert not np.array_equal(warm.thermostat, chain.start(there, start).thermostat)
    assert np.array_equal(chain.start(there, warm).thermostat, warm.thermostat)
    assert np.array_equal(chain.start(here, warm).thermostat, chain.start(here, start).thermostat)


def test_copies_know_whose_forces_they_carry() -> None:
    here, start, asked = pendulum(1.0)
    there = pendulum(7.0)[0]
    end = Rattle().step(here, start, 0.05)
    own = end.copied()
    assert own.positions is not end.positions and own.has_forces_of(here) and not own.has_forces_of(there)
    assert end.read_only().has_forces_of(here) and not end.read_only().has_forces_of(there)
    # Made by hand: of any system, and where they were given only.
    hand = State(end.positions, end.velocities, forces=end.forces)
    assert hand.has_forces_of(here) and hand.has_forces_of(there)
    assert not replace(hand, positions=start.positions).has_forces_of(here)
    # Nothing else can be known of what another process or a file says.
    again = pickle.loads(pickle.dumps(end))
    assert again.origin[0] is None and again.has_forces_of(here) and again.has_forces_of(there)
    assert not replace(again, positions=start.positions).has_forces_of(here)
    assert_same(again, end)
    asked.clear()
    assert_same(Rattle().step(here, own, 0.05), Rattle().step(here, again, 0.05))
    assert len(asked) == 2


# -- far from the origin ----------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
@REVERSIBLE
def test_energy_far_from_the_origin(stepper, offset) -> None:
    system, state = rotor(omega=1.0, offset=offset)
    start = system.total_energy(state)
    end = run(system, state, 0.05, 1000, stepper=stepper)
    assert abs(system.total_energy(end) / start - 1) <= 1e-10
    length = np.linalg.norm(end.positions[0] - end.positions[1])
    assert abs(length - 1.2) <= 1.2 * max(4 * np.spacing(offset), 1e-14)


@pytest.mark.parametrize("stepper", [Rattle(), Geodesic(), BlanesMoan6(), Langevin(1.0, 0.5, 1)], ids=repr)
@pytest.mark.parametrize(
    "rows",
    [[Sphere(0, [1e5 - 2.0, 1e5, 1e5], None), Distance([0, 1])], [FixedAtoms([0])], [Plane([1], [0, 0, 1.0])], []],
    ids=["sphere", "fixed atom", "plane", "none"],
)
def test_what_is_kept_of_places_far_away_is_nothing_to_rows_with_a_place(stepper, rows) -> None:
    """Of a state that comes from another System: steps relative to an atom would look for the surface at the origin."""
    assert rotor(omega=1.0, offset=1e5, far=np.inf)[1].remainder is None  # switched off
    there, state = rotor(omega=1.0, offset=1e5)
    state = run(there, state, 0.05, 3)
    assert state.remainder is not None
    here = system_of(rows, state.positions, there.masses, gravity(there.masses))
    v = here.motion.project_velocities(state.positions, state.velocities)
    found = run(here, replace(state, velocities=v), 0.05, 4, stepper=stepper)
    expected = run(here, State(state.positions, v, state.time, None, state.step), 0.05, 4, stepper=stepper)
    np.testing.assert_array_equal(found.positions, expected.positions)
    np.testing.assert_array_equal(found.velocities, expected.velocities)


# -- what every stepper does; runs ------------------------------------------------------------------


BATHS = [Langevin(1.0, 0.5, 1), Isokinetic(1.0), HamiltonianMonteCarlo(1.0, 2, 3), IsokineticSpheres(1.0, 0.5, 2)]


@pytest.mark.parametrize("stepper", BATHS, ids=lambda stepper: type(stepper).__name__)
def test_copies_leave_behind_what_was_found_for_a_system(stepper) -> None:
    """Whose functions need not be any that pickle knows."""
    system, state = rotor(force=lambda x, t: -x * [1.0, 2.0, 3.0], potential=lambda x, t: float((x**2).sum()))
    state = run(system, state, 0.01, 2, stepper=stepper)
    again = pickle.loads(pickle.dumps(stepper))
    np.testing.assert_array_equal(
        run(system, state, 0.01, 3, stepper=stepper).positions, run(system, state, 0.01, 3, stepper=again).positions
    )


@REVERSIBLE
def test_steps_of_no_number_and_of_zero(stepper) -> None:
    system, state = rotor(force=lambda x, t: -x)
    before = state.copied()
    for dt in (np.nan, np.inf, -np.inf):
        with pytest.raises(InputError, match="time step"):
            stepper.step(system, state, dt)
    for dt in (0.0, -0.0):
        after = stepper.step(system, state, dt)
        assert np.array_equal(after.positions, state.positions) and np.array_equal(after.velocities, state.velocities)
        assert after.time == state.time and after.step == state.step + 1
    assert_same(state, before)


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


# -- the check of reversibility --------------------------------------------------------------------------


class Drifting(Rattle):
    """Claims to be reversible and loses a little speed."""

    def step(self, system: System, state: State, dt: float) -> State:
        after = super().step(system, state, dt)
        return State(after.positions, after.velocities * (1 - 1e-7), after.time, None, after.step)


def test_check_finds_a_stepper_that_is_not_reversible() -> None:
    system, state = rotor()
    state = State(state.positions, state.velocities, step=6)
    before = state.copied()
    with pytest.raises(ReversibilityError, match="step 7 is not reversible: taken back, atom") as caught:
        ReversibilityCheck(Drifting()).step(system, state, 0.1)
    assert caught.value.step == 7 and 1e-8 < caught.value.residual < 1e-6
    assert_same(state, before)
    ReversibilityCheck(Drifting(), tolerance=1e-5).step(system, state, 0.1)

    class OneWay(Rattle):
        def step(self, system: System, state: State, dt: float) -> State:
            if dt < 0:
                raise ConvergenceError("no way back", residual=0.5, row=0, atoms=[0, 1])
            return super().step(system, state, dt)

    with pytest.raises(ReversibilityError, match="step 7 cannot be taken back: no way back") as caught:
        ReversibilityCheck(OneWay()).step(system, state, 0.1)
    assert caught.value.atoms == (0, 1) and caught.value.step == 7


def test_check_refuses_what_is_not_reversible_and_works_far_from_the_origin_and_at_rest() -> None:
    for stepper in PROJECTED:
        with pytest.raises(UnsupportedError, match="use Rattle, Geodesic, a Composition or a RungeKuttaNystrom"):
            ReversibilityCheck(stepper)
    run(*rotor(omega=1.0, offset=1e6), 0.05, 20, stepper=ReversibilityCheck(Geodesic(2)))
    run(*rotor(omega=0.0), 0.05, 3, stepper=ReversibilityCheck(Rattle()))


NO_CLOCK = [{"time": np.nan}, {"time": -np.inf}, {"time": 1j}, {"time": "a"}, {"time_remainder": np.nan}]
NO_CLOCK += [{"step": step} for step in (-3, 2.5, True, None)]


@pytest.mark.parametrize("impossible", NO_CLOCK, ids=str)
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


@pytest.mark.parametrize("stepper", [None, BlanesMoan4()], ids=repr)
def test_observers_see_states_of_the_run_also_of_one_that_stops(stepper):
    system, state = rotor()
    seen: list = []
    run(system, state, 0.01, 10, stepper=stepper, observers=[seen.append], every=4)
    assert [each.step for each in seen] == [0, 4, 8]
    for each in seen[1:]:
        np.testing.assert_array_equal(each.positions, run(system, state, 0.01, each.step, stepper=stepper).positions)
    seen.clear()
    stopping = System(system.motion, lambda x, t: np.zeros_like(x) if t < 0.065 else np.full_like(x, np.nan))
    with pytest.raises(NonFiniteError):
        run(stopping, state, 0.01, 10, observers=[seen.append], every=2)
    assert [each.step for each in seen] == [0, 2, 4, 6]
