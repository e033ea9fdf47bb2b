"""Halves of an isokinetic step in one call: the steps made call by call, and these where a half cannot be done."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kcons.constraint_set import ConstraintSet
from kcons.constraints import Distance, FixedAtoms, MovingTarget
from kcons.errors import ConvergenceError, NonFiniteError
from kcons.motion import Motion
from kcons.steppers import State, System, run
from kcons.thermostats import Isokinetic
from kcons.thermostats.isokinetic_stages import DONE, ENGINE, FORCE, KICK, MANY, POSITION, IsokineticStages
from kcons.thermostats.kick import before_drift

SHAPE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0], [0.2, -0.5, 0.8]])
MASSES = np.array([16.0, 1.0, 2.0, 3.0])
ROWS = {
    "dumbbells": [[0, 1]],
    "bent": [[0, 1], [0, 2]],
    "triangles": [[0, 1], [0, 2], [1, 2]],
    "tetrahedra": [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]],
}
ORDERS = pytest.mark.parametrize("order", [2, 4, 6])
EVERY = pytest.mark.parametrize("name", ROWS)


def springs(x, t):
    """Each atom in a harmonic well of its own strength, and an attraction of neighbouring molecules."""
    return -np.linspace(0.1, 0.3, len(x))[:, None] * x - 0.05 * (x - np.roll(x, 3, axis=0))


def far_springs(x, t):
    return springs(x - 1e6, t)


def molecules(name="dumbbells", n=11, *, ions=0, at=0.0, force=springs, **options) -> tuple[System, State]:
    """Molecules that turn, and free atoms after them; 11 fill one group of lanes and part of a second."""
    rng = np.random.default_rng(3)
    size = 1 + max(map(max, ROWS[name]))
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    x = (np.einsum("ak,nkj->naj", SHAPE[:size], turn) + 3.0 * np.arange(n)[:, None, None] / n).reshape(-1, 3)
    x = np.concatenate([x, rng.normal(size=(ions, 3))]) + at
    masses = np.concatenate([np.tile(MASSES[:size], n), np.full(ions, 23.0)])
    pairs = (size * np.arange(n)[:, None, None] + np.array(ROWS[name])).reshape(-1, 2)
    system = System(Motion(ConstraintSet([Distance(pairs)], x, masses, **options), x), force)
    return system, system.initial_state(x, 0.3 * rng.normal(size=x.shape), project=True)


def thermostats(system: System, **options) -> tuple[Isokinetic, Isokinetic]:
    """One that uses compiled halves of `system`, and one that does not."""
    pair = Isokinetic(momentum="free", **options), Isokinetic(momentum="free", **options)
    assert pair[0]._share(system).stages is not None
    pair[1]._share(system).stages = None
    return pair


def distance(a: State, b: State) -> float:
    return max(float(np.abs(a.positions - b.positions).max()), float(np.abs(a.velocities - b.velocities).max()))


@ORDERS
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"ions": 5},
        {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True},
        {"at": 1e6, "force": lambda x, t: springs(x - 1e6, t)},
    ],
    ids=["plain", "ions", "periodic", "far"],
)
@EVERY
def test_steps_are_those_made_call_by_call(name, options, order) -> None:
    system, state = molecules(name, **options)
    halves, calls = thermostats(system, order=order)
    state = halves.start(system, state)
    close = 1e-9 if "at" in options else 2e-14
    for dt in (0.05, -0.02, 0.03):
        following, expected = halves.step(system, state, dt), calls.step(system, state, dt)
        assert distance(following, expected) <= close
        assert distance(following, state) > 1e-3
        np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=close)
        np.testing.assert_allclose(following.thermostat, expected.thermostat, rtol=1e-12 + close, atol=close)
        state = following


@ORDERS
def test_a_part_of_the_atoms(order) -> None:
    """The others, held ones too, are only pushed."""
    system, state = molecules("triangles", ions=5)
    halves, calls = thermostats(system, order=order, atoms=np.arange(15), kinetic_energy=2.0)
    state = halves.start(system, state)
    for _ in range(3):
        following, expected = halves.step(system, state, 0.05), calls.step(system, state, 0.05)
        assert distance(following, expected) <= 2e-14
        state = following
    inside = 0.5 * system.masses[:15] @ np.einsum("ij,ij->i", state.velocities[:15], state.velocities[:15])
    assert inside == pytest.approx(2.0, rel=1e-14)


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
    np.testing.assert_allclose(u, level, rtol=0, atol=1e-15)
    push = motion.project_velocities(x, f * system.weights)
    np.testing.assert_allclose(pace, push, rtol=0, atol=1e-15)
    np.testing.assert_allclose(pace, motion.project_forces(x, f) * system.inverse_masses, rtol=0, atol=1e-14)
    assert square == pytest.approx((f * push).sum(), rel=1e-13)
    assert factor == pytest.approx((twice / (system.masses @ (level**2).sum(axis=1))) ** 0.5, rel=1e-14)
    assert 2 * system.kinetic_energy(after) == pytest.approx(twice, rel=1e-15)
    rates = motion.constraint_set.jacobian(x) @ np.stack([after.ravel(), pace.ravel(), u.ravel()], axis=1)
    assert np.abs(rates).max() <= 1e-14
    # Along the exact solution: alpha = v.f/2K at the middle, times t.
    middle = stages.after(x, v.copy(), f, twice, t / 2, stages.tables())[1]
    assert log_growth + np.log(factor) == pytest.approx(t * (middle * f).sum() / twice, rel=1e-4)


def test_kinetic_energy_stays() -> None:
    system, state = molecules("triangles", ions=3)
    thermostat = thermostats(system, kinetic_energy=2.0)[0]
    worst = 0.0
    for _ in range(300):
        state = run(system, state, 0.02, 10, stepper=thermostat)
        worst = max(worst, abs(system.kinetic_energy(state.velocities) / 2.0 - 1))
    assert worst <= 1e-14
    held = system.motion.constraint_set
    assert np.abs(held.value(state.positions)).max() <= 1e-14
    assert np.abs(held.jacobian(state.positions) @ state.velocities.ravel()).max() <= 1e-14


def test_what_came_in_stays_as_it_was() -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def force(x, t):
        seen.append((x, x.copy()))
        return springs(x, t)

    system, state = molecules(force=force)
    thermostat = thermostats(system)[0]
    state = thermostat.start(system, state)
    arrays = (state.positions, state.velocities, state.forces, state.thermostat)
    before = [a.copy() for a in arrays]
    for array in arrays:
        array.flags.writeable = False
    for order in (2, 4):
        Isokinetic(order=order).step(system, state, 0.05)
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))
    assert len(seen) == 1 + 1 + 6
    assert all(np.array_equal(a, b) for a, b in seen)


@ORDERS
@EVERY
def test_any_layout_of_the_arrays(name, order) -> None:
    """Kernels read raw memory."""
    system, state = molecules(name)
    thermostat = thermostats(system, order=order)[0]
    state = thermostat.start(system, state)
    expected = thermostat.step(system, state, 0.05)
    for item in ("positions", "velocities", "forces"):
        turned = replace(state, **{item: np.asfortranarray(getattr(state, item))})
        assert distance(thermostat.step(system, turned, 0.05), expected) <= 1e-15


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
        status, x, u, _ = stages.before(state.positions, state.velocities, f, 1.0, 4.0, 0.05, h, stages.tables())
        assert status == expected
        if status == ENGINE:
            np.testing.assert_allclose(x, state.positions + h * u, rtol=0, atol=4e-15)
    thermostat = thermostats(system)[0]
    with pytest.raises(ConvergenceError, match=r"step 1: time step too large \(dt = 30\)"):
        thermostat.step(system, state, 30.0)


def test_the_engine_lands_where_many_iterations_are_needed(monkeypatch) -> None:
    """As a flight that the kernel gives up; the step is the same."""
    system, state = molecules("triangles")
    compiled, calls = thermostats(system)
    state = compiled.start(system, state)
    expected = calls.step(system, state, 0.05)
    stages = compiled._share(system).stages
    after = stages.after

    def given_up(x, u, f, square, twice, t, h, tables):
        kicked = np.empty_like(u)
        weights, masses, *_ = tables
        log_growth, done = before_drift(u, f, weights, masses, square, twice, t, MANY, kicked)
        assert done
        return ENGINE, x + h * kicked, kicked, log_growth

    monkeypatch.setattr(stages, "before", given_up)
    assert distance(compiled.step(system, state, 0.05), expected) <= 1e-13
    monkeypatch.setattr(stages, "after", lambda *given: (ENGINE, *after(*given)[1:]))
    assert distance(compiled.step(system, state, 0.05), expected) <= 1e-13


def test_forces_too_strong_for_a_kick_without_projection() -> None:
    """Along the bonds, where nothing of them may be left."""
    system, state = molecules("triangles")

    def strong(x, t):
        d = x[1::3] - x[0::3]
        push = np.zeros_like(x)
        push[0::3], push[1::3] = -1e9 * d, 1e9 * d
        return springs(x, t) + push

    system.force = strong
    compiled, calls = thermostats(system)
    state = compiled.start(system, state)
    stages = compiled._share(system).stages
    given = (state.thermostat[2], state.thermostat[0], 0.01, 0.02)
    assert stages.before(state.positions, state.velocities, state.forces, *given, stages.tables())[0] == KICK
    after, expected = compiled.step(system, state, 0.02), calls.step(system, state, 0.02)
    assert distance(after, expected) <= 1e-6


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


@ORDERS
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_force_that_is_not_finite(order, bad) -> None:
    system, state = molecules("triangles", ions=2)
    thermostat = thermostats(system, order=order)[0]
    state = run(system, state, 0.01, 4, stepper=thermostat)
    before = state.positions.copy(), state.velocities.copy()

    def force(x, t):
        f = springs(x, t)
        f[7, 1] = bad
        return f

    system.force = force
    with pytest.raises(NonFiniteError, match="non-finite force at step 5 on atom 7") as caught:
        thermostat.step(system, state, 0.01)
    assert caught.value.step == 5
    assert np.array_equal(state.positions, before[0]) and np.array_equal(state.velocities, before[1])


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
    assert stages([bond], force=None) is None
    assert stages([]) is None
    assert stages([bond, FixedAtoms([2])]) is None
    assert stages([Distance([[0, 1]], MovingTarget(lambda t: 1 + 0.1 * t, lambda t: 0.1, lambda t: 0.0))]) is None
    assert stages([bond], np.concatenate([pair, pair + 20.0, pair + 40.0])) is None  # most atoms are free


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
