"""Steppers: order by slope, exact maps, reversibility, purity, and what happens when a step fails."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from kcons.constraint_set import ConstraintSet
from kcons.constraints import Angle, Distance, FixedAtoms, KnifeEdge, LinearVelocity, MovingTarget
from kcons.errors import ConvergenceError, InputError, NonFiniteError
from kcons.motion import Motion
from kcons.steppers import Rattle, State, System, run

STEPPERS = [Rattle()]


def system_of(constraints, positions, masses, force=None, time=0.0, **options) -> System:
    held = ConstraintSet(constraints, positions, masses, time=time)
    return System(Motion(held, positions, time=time), force, **options)


def gravity(masses, g=(0.0, 0.0, -1.0)) -> Callable:
    field = np.outer(masses, g)
    return lambda x, t: field


def spherical_pendulum() -> tuple[System, State]:
    """Mass 1 on a rod of length 1 about a fixed atom, gravity 1 (reference case A02_spherical_pendulum_generic)."""
    theta = 1.2
    positions = np.array([[0.0, 0.0, 0.0], [np.sin(theta), 0.0, -np.cos(theta)]])
    masses = np.array([1.0, 1.0])
    system = system_of(
        [FixedAtoms([0]), Distance([0, 1], 1.0)],
        positions,
        masses,
        gravity(masses),
        potential=lambda x, t: float(x[1, 2]),
    )
    return system, system.initial_state(positions, [[0, 0, 0], [0, 0.8, 0]])


def planar_pendulum(angle: float) -> tuple[System, State]:
    positions = np.array([[0.0, 0.0, 0.0], [np.sin(angle), 0.0, -np.cos(angle)]])
    system = system_of(
        [FixedAtoms([0]), Distance([0, 1])], positions, [1, 1], gravity([1, 1]), potential=lambda x, t: float(x[1, 2])
    )
    return system, system.initial_state(positions)


def rotor(omega=1.0, force=None, offset=0.0, **options) -> tuple[System, State]:
    """Two unlike masses at distance 1.2, turning in the xy plane about their centre."""
    masses = np.array([1.0, 2.5])
    arms = 1.2 * np.array([2.5, -1.0]) / 3.5
    positions = np.zeros((2, 3)) + offset
    positions[:, 0] += arms
    velocities = np.zeros((2, 3))
    velocities[:, 1] = omega * arms
    system = system_of([Distance([0, 1], 1.2)], positions, masses, force, **options)
    return system, system.initial_state(positions, velocities)


def angle_of(state: State) -> float:
    d = state.positions[0] - state.positions[1]
    return float(np.arctan2(d[1], d[0]))


def slope(dts, errors) -> float:
    return float(np.polyfit(np.log(dts), np.log(errors), 1)[0])


# -- order ------------------------------------------------------------------------------------------


def error_spherical_pendulum(stepper, dt):
    # 25-digit reference at t = 1 (minimal coordinates, 45-digit arithmetic).
    x1 = np.array([0.4497250024354154, 0.6418565722780616, -0.6211018940624181])
    v1 = np.array([-0.9582024352419465, 0.2904057756042812, -0.3937014830599042])
    system, state = spherical_pendulum()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    return np.abs(np.concatenate([end.positions[1] - x1, end.velocities[1] - v1])).max()


def error_free_rotor(stepper, dt):
    system, state = rotor(omega=1.3)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 2.6)


def error_growing_rod(stepper, dt):
    # Mass on a rod whose length grows as 1 + t/2 about a fixed point: angular momentum is conserved.
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    length = MovingTarget(lambda t: 1 + 0.5 * t, lambda t: 0.5, lambda t: 0.0)
    system = system_of([FixedAtoms([0]), Distance([0, 1], length)], positions, [1, 1])
    state = system.initial_state(positions, [[0, 0, 0], [0.5, 0.9, 0]])
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    phi = 0.9 / 0.5 * (1 - 1 / 2.0)
    exact = 2.0 * np.array([np.cos(phi), np.sin(phi), 0.0])
    assert np.linalg.norm(end.positions[1]) == pytest.approx(2.0, rel=1e-14)
    return np.abs(end.positions[1] - exact).max()


def error_rotor_with_friction(stepper, dt):
    system, state = rotor(omega=1.3, force=lambda x, v, t: -0.4 * np.array([[1.0], [2.5]]) * v, velocity_dependent=True)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 1.3 / 0.4 * (1 - np.exp(-0.8)))


def skate() -> tuple[System, State]:
    """A skate (two equal masses, blade under their centre) on a slope: a closed cycloid-like motion."""
    positions = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    rows = [Distance([0, 1]), KnifeEdge([0], [1], [0, 0, 1], contact=0.5)]
    system = system_of(
        rows, positions, [1, 1], gravity([1, 1], (0.7, 0, 0)), potential=lambda x, t: -0.7 * x[:, 0].sum()
    )
    omega, u0 = 1.1, 0.4
    velocities = np.array([[u0, -0.5 * omega, 0.0], [u0, 0.5 * omega, 0.0]])
    return system, system.initial_state(positions, velocities)


def error_skate(stepper, dt):
    system, state = skate()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    w, u0, g, t = 1.1, 0.4, 0.7, 1.0
    x = u0 / w * np.sin(w * t) + g / (2 * w**2) * np.sin(w * t) ** 2
    y = u0 / w * (1 - np.cos(w * t)) + g / w**2 * (w * t / 2 - np.sin(2 * w * t) / 4)
    return np.abs(end.positions.mean(axis=0) - [x, y, 0]).max()


def error_driven_atom(stepper, dt):
    system = system_of([LinearVelocity(0, [[1, 0, 0]], target=np.cos)], np.zeros((1, 3)), [2.0])
    end = run(system, system.initial_state(np.zeros((1, 3))), dt, round(2 / dt), stepper=stepper)
    return abs(end.positions[0, 0] - np.sin(2.0))


CASES = [
    error_spherical_pendulum,
    error_free_rotor,
    error_growing_rod,
    error_rotor_with_friction,
    error_skate,
    error_driven_atom,
]


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("global_error", CASES, ids=lambda f: f.__name__.removeprefix("error_"))
def test_observed_order(stepper, global_error):
    dts = 1.0 / 2.0 ** np.arange(4, 8)
    errors = [global_error(stepper, dt) for dt in dts]
    assert slope(dts, errors) == pytest.approx(stepper.order, abs=0.15)


# -- exact statements -------------------------------------------------------------------------------


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


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6])
def test_energy_far_from_the_origin(offset):
    system, state = rotor(omega=1.0, offset=offset)
    start = system.total_energy(state)
    end = run(system, state, 0.01, 1000)
    assert abs(system.total_energy(end) / start - 1) <= 1e-10
    length = np.linalg.norm(end.positions[0] - end.positions[1])
    assert abs(length - 1.2) <= 1.2 * max(4 * np.spacing(offset), 1e-14)


def verlet(x, v, masses, force, dt, steps):
    m = np.asarray(masses)[:, None]
    for _ in range(steps):
        v = v + 0.5 * dt * force(x, 0) / m
        x = x + dt * v
        v = v + 0.5 * dt * force(x, 0) / m
    return x, v


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


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
@pytest.mark.parametrize("make", [spherical_pendulum, rotor, skate], ids=lambda f: f.__name__)
def test_time_reversal(stepper, make):
    system, start = make()
    steps = 50 if make is skate else 500
    end = run(system, start, 0.02, steps, stepper=stepper)
    back = run(system, end.reversed(), 0.02, steps, stepper=stepper)
    assert np.abs(back.positions - start.positions).max() <= 1e-10
    assert np.abs(back.velocities + start.velocities).max() <= 1e-10
    negative = run(system, end, -0.02, steps, stepper=stepper)
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


def test_zero_step_changes_nothing():
    system, state = spherical_pendulum()
    after = Rattle().step(system, state, 0.0)
    assert np.array_equal(after.positions, state.positions)
    assert np.array_equal(after.velocities, state.velocities)
    assert after.time == state.time and after.step == state.step + 1


def test_restart_is_bit_identical():
    system, state = spherical_pendulum()
    whole = run(system, state, 0.01, 200)
    half = run(system, state, 0.01, 100)
    again, _ = spherical_pendulum()
    resumed = run(again, pickle.loads(pickle.dumps(half)), 0.01, 100)
    assert np.array_equal(resumed.positions, whole.positions)
    assert np.array_equal(resumed.velocities, whole.velocities)
    assert (resumed.time, resumed.step) == (whole.time, whole.step)


def test_step_size_may_change_on_the_way():
    system, state = spherical_pendulum()
    for dt in (0.01, 0.02, 0.005, -0.01):
        state = Rattle().step(system, state, dt)
        assert np.abs(system.motion.constraint_set.value(state.positions)).max() <= 1e-14
    assert state.time == pytest.approx(0.025)


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


# -- purity, counting, observers --------------------------------------------------------------------


def test_step_is_pure():
    system, state = spherical_pendulum()
    state = system.with_forces(state)
    copies = [a.copy() for a in (state.positions, state.velocities, state.forces)]
    first = Rattle().step(system, state, 0.1)
    second = Rattle().step(system, state, 0.1)
    assert np.array_equal(first.positions, second.positions)
    for array, copy in zip((state.positions, state.velocities, state.forces), copies, strict=True):
        assert np.array_equal(array, copy)


def test_one_force_evaluation_a_step():
    calls = []

    def force(x, t):
        calls.append(t)
        return -x

    system, state = rotor(force=force)
    run(system, state, 0.1, 7)
    assert len(calls) == 7 * Rattle().force_evaluations + 1


def test_a_calculator_may_reuse_its_array():
    buffer = np.zeros((2, 3))

    def force(x, t):
        np.copyto(buffer, -x)
        return buffer

    system, state = rotor(force=force)
    plain, _ = rotor(force=lambda x, t: -x)
    assert np.array_equal(run(system, state, 0.1, 5).positions, run(plain, state, 0.1, 5).positions)


def test_float32_input_is_cast():
    system, state = rotor()
    rounded = system.initial_state(state.positions.astype(np.float32), project=True)
    assert rounded.positions.dtype == np.float64


def test_observers_see_start_and_every_kth_step():
    system, state = rotor()
    seen: list[int] = []
    run(system, state, 0.01, 10, observers=[lambda s: seen.append(s.step)], every=4)
    assert seen == [0, 4, 8]


# -- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_force_names_step_and_atom(bad):
    def force(x, t):
        f = -x
        if t > 0.25:
            f[1, 2] = bad
        return f

    system, state = rotor(force=force)
    seen: list[State] = []
    with pytest.raises(NonFiniteError, match="non-finite force at step 3 on atom 1") as caught:
        run(system, state, 0.1, 10, observers=[seen.append])
    assert (caught.value.step, caught.value.atom, caught.value.item) == (3, 1, "force")
    assert seen[-1].step == 2 and np.isfinite(seen[-1].positions).all()


def test_overflow_is_named_and_not_returned():
    system = system_of([], np.zeros((2, 3)), [1, 1], lambda x, t: np.full((2, 3), 1e300))
    with pytest.raises(NonFiniteError, match="non-finite position at step 1 on atom 0"):
        Rattle().step(system, system.initial_state(np.zeros((2, 3))), 1e10)


def test_huge_force_along_a_bond_cancels():
    pull = np.array([[1e12, 0, 0], [-1e12, 0, 0]])
    system, state = rotor(omega=0.0, force=lambda x, t: pull)
    end = run(system, state, 1e-3, 10)
    assert np.linalg.norm(end.positions[0] - end.positions[1]) == pytest.approx(1.2, rel=1e-10)


@pytest.mark.parametrize("shape", [(3,), (3, 3), (2, 2)])
def test_wrong_force_shape(shape):
    system, state = rotor(force=lambda x, t: np.zeros(shape))
    with pytest.raises(InputError, match=r"shape .* at step 0; it must return \(2, 3\)"):
        Rattle().step(system, state, 0.1)


@pytest.mark.parametrize("dt", [np.nan, np.inf])
def test_bad_time_step(dt):
    system, state = rotor()
    with pytest.raises(InputError, match="time step"):
        Rattle().step(system, state, dt)


@pytest.mark.parametrize(("steps", "every"), [(-1, 1), (3, 0)])
def test_bad_run_arguments(steps, every):
    system, state = rotor()
    with pytest.raises(InputError, match="steps >= 0"):
        run(system, state, 0.1, steps, every=every)


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_bad_mass_of_a_free_atom(mass):
    with pytest.raises(InputError, match="atom 2 has mass"):
        system_of([Distance([0, 1])], np.eye(3), [1, 1, mass])


def test_massless_fixed_atom_is_allowed():
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    system = system_of([FixedAtoms([0]), Distance([0, 1])], positions, [0.0, 1.0], gravity([0.0, 1.0]))
    end = run(system, system.initial_state(positions, [[0, 0, 0], [0.1, 0, 0]]), 0.01, 10)
    assert np.array_equal(end.positions[0], [0, 0, 0])
    assert np.isfinite(system.kinetic_energy(end.velocities))


def test_start_off_the_constraints():
    system, state = rotor()
    off = state.positions * 1.2
    with pytest.raises(InputError, match=r"off row #0 Distance\(0, 1\) by 0\.24; pass project=True"):
        system.initial_state(off)
    projected = system.initial_state(off, project=True)
    assert np.linalg.norm(projected.positions[0] - projected.positions[1]) == pytest.approx(1.2, rel=1e-14)
    centre = system.masses @ projected.positions / system.masses.sum()
    assert np.abs(centre - system.masses @ off / system.masses.sum()).max() <= 1e-14


def test_start_with_forbidden_velocities():
    system, state = rotor(omega=1.0)
    stretching = state.velocities + np.array([[0.5, 0, 0], [0, 0, 0]])
    with pytest.raises(InputError, match="initial velocities violate"):
        system.initial_state(state.positions, stretching)
    projected = system.initial_state(state.positions, stretching, project=True)
    relative = projected.velocities[0] - projected.velocities[1]
    assert abs(relative[0]) <= 1e-15
    assert system.kinetic_energy(projected.velocities) < system.kinetic_energy(stretching)
    momentum = system.masses @ (projected.velocities - stretching)
    assert np.abs(momentum).max() <= 1e-15


def test_start_within_rounding_is_taken_as_given():
    system, state = rotor()
    again = system.initial_state(state.positions, state.velocities)
    assert np.array_equal(again.positions, state.positions)
    assert np.array_equal(again.velocities, state.velocities)


def test_moving_constraint_starts_with_its_own_speed():
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    rod = Distance([0, 1], MovingTarget(lambda t: 1 + 0.5 * t, lambda t: 0.5, lambda t: 0.0))
    system = system_of([FixedAtoms([0]), rod], positions, [1, 1])
    assert system.initial_state(positions).velocities[1] == pytest.approx([0.5, 0, 0], abs=1e-15)


@pytest.mark.parametrize("item", ["positions", "velocities"])
@pytest.mark.parametrize("values", [np.zeros((3, 3)), [[0, 0, np.nan], [1.2, 0, 0]], "x"], ids=["shape", "nan", "text"])
def test_bad_initial_arrays(item, values):
    system, state = rotor()
    arrays = {"positions": state.positions, "velocities": state.velocities, item: values}
    with pytest.raises(InputError, match=item):
        system.initial_state(arrays["positions"], arrays["velocities"])


def test_energy_needs_a_potential():
    system, state = rotor(force=lambda x, t: -x)
    with pytest.raises(InputError, match="potential"):
        system.total_energy(state)


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
