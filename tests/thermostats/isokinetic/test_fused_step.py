"""Halves of an isokinetic step in one call: the numbers of the engine, what is reported, and who has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import ROWS, distance, molecules, springs, thermostats

from kcons.constraints import Angle, Distance, FixedAtoms, MovingTarget
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, NonFiniteError
from kcons.motion import Motion
from kcons.steppers import State, System
from kcons.thermostats import Isokinetic
from kcons.thermostats.isokinetic.fused_step import DONE, ENGINE, FORCE, KICK, POSITION, IsokineticStages

ORDERS = pytest.mark.parametrize("order", [2, 4, 6])
EVERY = pytest.mark.parametrize("name", ROWS)


@EVERY
def test_both_projections_in_one_call_are_those_of_the_engine(name) -> None:
    system, state = molecules(name, ions=3)
    stages = Isokinetic()._share(system).stages
    motion, x, f = system.motion, state.positions, springs(state.positions, 0.0)
    rng = np.random.default_rng(1)
    v = rng.normal(size=x.shape)
    u = v.copy()
    twice, t = 4.0, 0.01
    status, after, pace, square, factor, log_growth = stages.after(x, u, f, twice, t, stages.tables())
    assert status == DONE
    level = motion.project_velocities(x, v)
    np.testing.assert_allclose(u, level, rtol=0, atol=4e-15)
    push = motion.project_velocities(x, f * system.weights)
    np.testing.assert_allclose(pace, push, rtol=0, atol=4e-15)
    np.testing.assert_allclose(pace, motion.project_forces(x, f) * system.inverse_masses, rtol=0, atol=1e-14)
    assert square == pytest.approx((f * push).sum(), rel=1e-13)
    assert factor == pytest.approx((twice / (system.masses @ (level**2).sum(axis=1))) ** 0.5, rel=1e-14)
    assert 2 * system.kinetic_energy(after) == pytest.approx(twice, rel=1e-15)
    rates = motion.constraint_set.jacobian(x) @ np.stack([after.ravel(), pace.ravel(), u.ravel()], axis=1)
    assert np.abs(rates).max() <= 1e-14
    # Along the exact solution: alpha = v.f/2K at the middle, times t.
    middle = stages.after(x, v.copy(), f, twice, t / 2, stages.tables())[1]
    assert log_growth + np.log(factor) == pytest.approx(t * (middle * f).sum() / twice, rel=1e-4)


# -- where a half cannot be done --------------------------------------------------------------------


def halves(**options) -> tuple[System, IsokineticStages, State]:
    system, state = molecules(**options)
    stages = Isokinetic()._share(system).stages
    assert stages is not None
    return system, stages, state


def test_a_flight_that_does_not_land_is_left_to_the_engine() -> None:
    system, stages, state = halves()
    f = springs(state.positions, 0.0)
    for h, expected in ((0.1, DONE), (9.0, ENGINE)):
        assert stages.before(state.positions, state.velocities, f, 1.0, 4.0, 0.05, h, stages.tables())[0] == expected
    thermostat = thermostats(system)[0]
    with pytest.raises(ConvergenceError, match=r"step 1: time step too large \(dt = 30\)"):
        thermostat.step(system, state, 30.0)


def test_velocities_against_a_strong_force() -> None:
    """Digits would be lost in the closed form; the tangent one takes over."""
    system, stages, state = halves(name="bent", n=2)
    pull = np.array([0.0, 0.0, 1e8])
    f = system.masses[:, None] * pull
    system.force = lambda x, t: system.masses[:, None] * pull
    v = np.tile([0.0, 0.0, -1.0], (len(f), 1))
    twice = float(system.masses.sum())
    assert stages.after(state.positions, v.copy(), f, twice, 0.01, stages.tables())[0] == KICK
    compiled, calls = thermostats(system)
    start = compiled.start(system, State(state.positions, v))
    after, expected = compiled.step(system, start, 0.01), calls.step(system, start, 0.01)
    assert distance(after, expected) <= 1e-13
    assert system.kinetic_energy(after.velocities) == pytest.approx(twice / 2, rel=1e-14)


def test_numbers_that_overflow() -> None:
    system, stages, state = halves(ions=2)
    f, tables = springs(state.positions, 0.0), stages.tables()
    x, u = state.positions.copy(), state.velocities.copy()
    x[-1, 0] = np.inf
    assert stages.after(x, u, f, 4.0, 0.1, tables)[0] == POSITION
    f[-1, 0] = np.nan
    assert stages.after(x, u, f, 4.0, 0.1, tables)[0] == FORCE
    u = np.zeros_like(f)
    u[-1] = 1e200
    assert stages.before(state.positions, u, np.zeros_like(f), 1.0, 1e300, 0.05, 1e200, tables)[0] == POSITION
    thermostat = thermostats(system, kinetic_energy=1e300)[0]
    with pytest.raises(NonFiniteError, match="non-finite position at step 1 on atom 0"):
        thermostat.step(system, state, 1e200)


# -- what is not compiled ---------------------------------------------------------------------------


def test_who_has_none() -> None:
    pair = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])

    def stages(rows, x=pair, force=springs, **options):
        system = System(Motion(ConstraintSet(rows, x, np.ones(len(x)), **options), x), force)
        return Isokinetic()._share(system).stages

    bond = Distance([[0, 1]])
    assert stages([bond]) is not None
    assert stages([]) is not None
    assert stages([bond, FixedAtoms([2])]) is not None
    assert stages([bond], np.concatenate([pair, pair + 20.0, pair + 40.0])) is not None  # most atoms are free
    assert stages([bond], force=None) is None
    assert stages([Distance([[0, 1]], MovingTarget(lambda t: 1 + 0.1 * t, lambda t: 0.1, lambda t: 0.0))]) is None
    assert stages([Angle([[0, 1, 2]])], np.array([[0.0, 0, 0], [1.0, 0, 0], [1.5, 1.0, 0]])) is not None
    many = np.arange(300.0).reshape(100, 3)
    assert stages([Distance(np.arange(100).reshape(-1, 2))], many) is not None
    assert stages([Distance(np.arange(200).reshape(-1, 2))], np.arange(600.0).reshape(200, 3)) is None  # too many rows


def test_a_new_cell_is_used_at_once() -> None:
    system, state = molecules("dumbbells", cell=np.diag([9.0, 9.0, 9.0]), pbc=True)
    x = state.positions.copy()
    x[1::2] += [9.0, 0, 0]  # each bond through the cell's wall
    state = replace(state, positions=x)
    thermostat = thermostats(system)[0]
    thermostat.step(system, state, 0.01)
    system.motion.set_cell(
        np.diag([12.0, 9.0, 9.0]), positions=x - np.tile([[0.0, 0, 0], [9.0, 0, 0]], (len(x) // 2, 1))
    )
    x = x.copy()
    x[1::2] += [3.0, 0, 0]
    state = replace(state, positions=x, forces=None, thermostat=None)
    after = thermostat.step(system, state, 0.01)
    assert np.abs(system.motion.constraint_set.value(after.positions)).max() <= 1e-13


def test_rows_of_mixed_kinds() -> None:
    """Called by address, from kernels that know nothing of them; a step without solution is the engine's."""
    x = np.array([[0.0, 0, 0], [1.5, 0, 0], [2.0, 1.4, 0], [0.3, 0.2, 4.0], [1.0, 1.0, 5.0]])
    rows = [Distance([[0, 1], [1, 2], [3, 4]]), Angle([[0, 1, 2]])]
    system = System(Motion(ConstraintSet(rows, x, [16.0, 1.0, 2.0, 3.0, 4.0]), x), springs)
    state = system.initial_state(x, 0.3 * np.random.default_rng(2).normal(size=x.shape), project=True)
    compiled, calls = thermostats(system)
    one = two = compiled.start(system, state)
    energy = system.kinetic_energy(one.velocities)
    for _ in range(5):
        one, two = compiled.step(system, one, 0.02), calls.step(system, two, 0.02)
    assert distance(one, two) <= 1e-14 < distance(one, state)
    assert system.kinetic_energy(one.velocities) == pytest.approx(energy, rel=1e-14)
    assert np.abs(system.motion.constraint_set.value(one.positions)).max() <= 1e-14
    errors = []
    for each in (compiled, calls):
        with pytest.raises(ConvergenceError, match="step 6") as caught:
            each.step(system, one, 60.0)
        errors.append((caught.value.row, caught.value.atoms))
    assert errors[0] == errors[1]
