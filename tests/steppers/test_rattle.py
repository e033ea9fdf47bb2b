"""RATTLE: order, exact maps, velocity rows, friction."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, GlobalError, named, observed_order
from stepper_systems import angle_of, planar_pendulum, rotor, skate, spherical_pendulum, system_of, verlet

from kcons.constraints import Angle, Distance
from kcons.errors import ConvergenceError
from kcons.steppers import Rattle, State, run


@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS, *FRICTION], ids=named)
def test_observed_order(problem: GlobalError) -> None:
    # Projections with velocity rows take ten milliseconds.
    steps = [8, 16, 32] if problem in VELOCITY_ROWS else [16, 32, 64, 128]
    assert observed_order(Rattle(), problem, steps) == pytest.approx(2, abs=0.15)


@pytest.mark.parametrize("omega_dt", [0.1, 0.5, 0.9, 0.99])
def test_free_rotor_turns_by_asin(omega_dt):
    system, state = rotor(omega=1.0)
    total = 0.0
    for _ in range(50):
        following = Rattle().step(system, state, omega_dt)
        total += (angle_of(following) - angle_of(state)) % (2 * np.pi)
        state = following
    assert abs(total - 50 * np.arcsin(omega_dt)) <= 1e-11


@pytest.mark.parametrize("omega_dt", [1.001, 1.2, 1.5])
def test_too_large_step_raises_and_changes_nothing(omega_dt):
    system, state = rotor(omega=1.0)
    state = State(state.positions, state.velocities, state.time, state.forces, step=41)
    before = (state.positions.copy(), state.velocities.copy())
    with pytest.raises(ConvergenceError, match="step 42: time step too large") as caught:
        Rattle().step(system, state, omega_dt)
    assert caught.value.step == 42
    assert caught.value.atoms == (0, 1)
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])


def test_state_off_the_constraints_is_named_as_the_cause():
    system, _ = rotor()
    crossed = State(np.array([[0.0, 9.0, 0.0], [0.0, -9.0, 0.0]]), np.array([[90.0, 0, 0], [-90.0, 0, 0]]))
    with pytest.raises(ConvergenceError, match=r"already off row #0 Distance\(0, 1\) by 16\.8"):
        Rattle().step(system, crossed, 1.0)


@pytest.mark.parametrize("atoms", [1, 3])
def test_without_constraints_it_is_velocity_verlet(atoms):
    rng = np.random.default_rng(3)
    x, v, masses = rng.normal(size=(atoms, 3)), rng.normal(size=(atoms, 3)), rng.uniform(1, 2, atoms)
    system = system_of([], x, masses, lambda x, t: -x)
    end = run(system, system.initial_state(x, v), 0.02, 1000)
    x1, v1 = verlet(x, v, masses, lambda x, t: -x, 0.02, 1000)
    scale = np.abs(x1).max()
    assert np.abs(end.positions - x1).max() <= 1e-14 * scale * 10
    assert np.abs(end.velocities - v1).max() <= 1e-14 * scale * 10


def test_constraints_on_some_atoms_leave_the_others_alone():
    rng = np.random.default_rng(5)
    x, v, masses = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.uniform(1, 2, 9)
    spring = lambda x, t: -x  # noqa: E731
    system = system_of([Distance([2, 7])], x, masses, spring)
    end = run(system, system.initial_state(x, v, project=True), 0.02, 50)
    x1, _ = verlet(x, v, masses, spring, 0.02, 50)
    others = np.delete(np.arange(9), [2, 7])
    assert np.abs(end.positions - x1)[others].max() <= 1e-14
    assert np.abs(end.positions - x1)[[2, 7]].max() > 1e-3


@pytest.mark.parametrize("make", [spherical_pendulum, rotor, skate], ids=lambda f: f.__name__)
def test_time_reversal(make):
    system, start = make()
    steps = 20 if make is skate else 500
    end = run(system, start, 0.02, steps)
    back = run(system, end.reversed(), 0.02, steps)
    assert np.abs(back.positions - start.positions).max() <= 1e-10
    assert np.abs(back.velocities + start.velocities).max() <= 1e-10
    negative = run(system, end, -0.02, steps)
    assert np.abs(negative.positions - start.positions).max() <= 1e-10
    assert negative.time == pytest.approx(start.time, abs=1e-12)


def test_one_step_back_is_exact():
    for make in (spherical_pendulum, rotor, skate):
        system, start = make()
        back = Rattle().step(system, Rattle().step(system, start, 0.05), -0.05)
        assert np.abs(back.positions - start.positions).max() <= 1e-14
        assert np.abs(back.velocities - start.velocities).max() <= 1e-14


def test_friction_is_reversible_too():
    system, start = rotor(force=lambda x, v, t: -0.4 * v, velocity_dependent=True)
    back = run(system, run(system, start, 0.05, 40), -0.05, 40)
    assert np.abs(back.positions - start.positions).max() <= 1e-12


def test_energy_has_no_slope():
    system, state = planar_pendulum(2.0)
    energies: list[float] = []
    run(system, state, 0.02, 4000, observers=[lambda s: energies.append(system.total_energy(s))])
    # Averages over each half under a smooth window: the oscillation cancels, a drift of 1e-6 would not.
    halves = np.array(energies[:4000]).reshape(2, 2000)
    window = np.sin(np.pi * (np.arange(2000) + 0.5) / 2000) ** 4
    means = halves @ window / window.sum()
    assert abs(means[1] - means[0]) / 40.0 <= 2e-8
    assert np.ptp(energies) > 1e-6


def test_skate_keeps_energy_and_never_slips():
    system, state = skate()
    start = system.total_energy(state)
    drift: list[float] = []
    slip: list[float] = []

    def watch(s: State) -> None:
        drift.append(system.total_energy(s) - start)
        held = system.motion.constraint_set
        slip.append(float(np.abs(held.jacobian(s.positions) @ s.velocities.ravel()).max()))

    run(system, state, 0.04, 100, observers=[watch])
    assert np.abs(drift).max() <= 1e-3
    assert np.max(slip) <= 1e-13


def test_huge_force_along_a_bond_cancels():
    pull = np.array([[1e12, 0, 0], [-1e12, 0, 0]])
    system, state = rotor(omega=0.0, force=lambda x, t: pull)
    end = run(system, state, 1e-3, 10)
    assert np.linalg.norm(end.positions[0] - end.positions[1]) == pytest.approx(1.2, rel=1e-10)


def test_unsettled_friction_is_reported():
    system, state = rotor(force=lambda x, v, t: -1e3 * v, velocity_dependent=True)
    with pytest.raises(ConvergenceError, match="time step too large") as caught:
        Rattle().step(system, state, 1.0)
    assert caught.value.step == 1


def test_bent_molecule_keeps_its_angle():
    positions = np.array([[1.0, 0.1, 0.0], [0.0, 0.0, 0.0], [-0.9, 0.3, 0.2]])
    rows = [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])]
    system = system_of(rows, positions, [1.0, 12.0, 16.0], lambda x, t: np.outer([1, -2, 1], [0.1, 0.2, 0.3]))
    end = run(system, system.initial_state(positions), 0.05, 200)
    assert np.abs(system.motion.constraint_set.value(end.positions)).max() <= 1e-13


def test_one_force_evaluation_a_step():
    calls = []

    def force(x, t):
        calls.append(t)
        return -x

    system, state = rotor(force=force)
    run(system, state, 0.1, 7)
    assert len(calls) == 7 * Rattle().force_evaluations + 1
