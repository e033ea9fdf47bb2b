"""Hamiltonian Monte Carlo: an involution, its energies, averages, restarts; tuned steps; exchange of temperatures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import dumbbells, loaded, started, system, waves, waves_potential

from kcons.constraints import Distance, Formula
from kcons.errors import ConvergenceError
from kcons.steppers import BlanesMoan4, BlanesMoan6a, Geodesic, Rattle, State, Suzuki4, System, run
from kcons.thermostats import Counts, HamiltonianMonteCarlo, exchange, tune
from kcons.thermostats.monte_carlo import CHANGE, EXCHANGE, POTENTIAL, PROPOSAL, SIZE, SUM, ReversedSteps
from kcons.thermostats.noise import noise_generator

KT = 0.6


def no_force(x, t=0.0):
    return np.zeros_like(x)


def no_energy(x, t=0.0):
    return 0.0


def trimer(force=no_force, potential=no_energy, masses=(1.0, 1.0, 1.0)) -> tuple[System, State]:
    """Three masses, two bonds of length 1, a free angle."""
    x = np.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]])
    held = system([Distance([[0, 1], [1, 2]])], x, np.array(masses), force, potential)
    return held, State(x, np.zeros_like(x))


def trap(x, t=0.0):
    """Each mass in a well of its own, the last drawn to one side."""
    f = -np.array([[1.0], [0.5], [2.0]]) * x
    f[2, 0] += 1.5
    return f


def trap_potential(x, t=0.0):
    return float(0.5 * (np.array([1.0, 0.5, 2.0]) * (x * x).sum(axis=1)).sum() - 1.5 * x[2, 0])


def refreshed(held, state, kt, keep, random):
    """As documented, with the projector of the constraint set itself."""
    noise = random.standard_normal(state.velocities.shape) * np.sqrt(kt * (1 - keep**2) / held.masses[:, None])
    v = (keep * state.velocities + noise).ravel()
    rows = held.motion.constraint_set.jacobian(state.positions).toarray()
    w = 1 / np.repeat(held.masses, 3)
    return (v - w * (rows.T @ np.linalg.solve((rows * w) @ rows.T, rows @ v))).reshape(-1, 3)


@pytest.mark.parametrize("keep", [0.0, 0.7])
def test_every_decision_follows_from_the_energies(keep):
    """Each step made again with its own random numbers, a plain run and plain energies."""
    held, state = started()
    held = System(held.motion, lambda x, t: 10 * waves(x), potential=lambda x, t: 10 * waves_potential(x))
    dt, kt = 0.2, 0.5
    sampler = HamiltonianMonteCarlo(kt, (2, 4), 12, keep=keep)
    outcomes = set()
    for number in range(1, 31):
        after = sampler.step(held, state, dt)
        random = noise_generator((12, 0), number, PROPOSAL)
        count = int(random.integers(2, 5))
        threshold = random.random()
        begin = replace(state, velocities=refreshed(held, state, kt, keep, random))
        end = run(held, begin, dt, count, check_every=0)
        change = (held.total_energy(end) - held.total_energy(begin)) / kt
        assert Counts.of(after).change == pytest.approx(change, abs=1e-11)
        accepted = math.log1p(-threshold) < -change
        outcomes.add(accepted)
        expected, v = (end.positions, end.velocities) if accepted else (state.positions, -begin.velocities)
        np.testing.assert_allclose(after.positions, expected, atol=1e-12)
        np.testing.assert_allclose(after.velocities, v, atol=1e-12)
        assert after.time == pytest.approx(state.time + count * dt) and after.step == number
        assert after.thermostat[POTENTIAL] == pytest.approx(held.potential(after.positions, 0.0), abs=1e-12)
        state = after
    assert outcomes == {True, False}
    counts = Counts.of(state)
    assert counts.proposals == 30 and counts.accepted + counts.energy == 30
    assert counts.acceptance == counts.accepted / 30 and counts.mean_square > 0


def cosines(states):
    x = np.array([s.positions for s in states])
    return np.einsum("ni,ni->n", x[:, 0] - x[:, 1], x[:, 2] - x[:, 1])


def test_a_free_angle_has_the_average_of_its_metric():
    """Masses 10, 1, 10, two bonds held: P(c) of the cosine is sqrt(1 - (b c)^2), b = 10/11; 1/3 without the metric."""
    held, state = trimer(masses=(10.0, 1.0, 10.0))
    sampler = HamiltonianMonteCarlo(1.0, (3, 8), 21)
    frames: list = []
    counts = Counts.of(run(held, state, 0.15, 2100, stepper=sampler, observers=[frames.append], check_every=0))
    assert counts.energy > 5 and counts.unsolved > 5
    squares = cosines(frames[1:]) ** 2
    error = squares.reshape(30, -1).mean(axis=1).std(ddof=1) / math.sqrt(30)
    assert error < 0.01
    assert abs(squares.mean() - 0.276334992061) < 3 * error < abs(squares.mean() - 1 / 3)


def test_a_loaded_state_is_judged_by_the_energy_of_its_forces_now():
    """A run was saved with another force field, whose energies and forces mean nothing here."""
    held, state = started()
    sampler = HamiltonianMonteCarlo(0.5, 3, 12)
    saved = run(held, state, 0.02, 2, stepper=sampler)
    other = System(held.motion, lambda x, t: 3 * waves(x), potential=lambda x, t: 3 * waves_potential(x) + 40)
    after = HamiltonianMonteCarlo(0.5, 3, 12).step(other, loaded(saved), 0.02)
    plain = replace(saved, forces=None, thermostat=None, origin=None)
    expected = HamiltonianMonteCarlo(0.5, 3, 12).step(other, plain, 0.02)
    assert np.array_equal(after.positions, expected.positions)
    assert after.thermostat[CHANGE] == expected.thermostat[CHANGE]
    assert Counts.of(after).accepted == 3


def test_what_has_no_solution_or_no_way_back_is_rejected_and_counted():
    """On a torus large steps land on the far side, from where the way back leads elsewhere."""
    x = np.array([[1.4, 0, 0]])
    torus = Formula("(x1**2 + y1**2 + z1**2 + 0.84)**2 - 4*(x1**2 + y1**2)", [0], target=0.0)
    held = system([torus], x, [1.0], no_force, no_energy)
    state = held.initial_state(x)
    sampler = HamiltonianMonteCarlo(1.0, 1, 3)
    for _ in range(60):
        after = sampler.step(held, state, 0.6)
        if Counts.of(after).accepted == Counts.of(state).accepted:
            assert np.array_equal(after.positions, state.positions) and np.isfinite(after.velocities).all()
        state = after
    counts = Counts.of(state)
    assert counts.irreversible > 0 and counts.unsolved > 0 and counts.accepted > 10
    assert counts.proposals == 60
    assert np.abs(held.motion.constraint_set.value(state.positions)).max() < 1e-12


def test_a_proposal_that_explodes_is_rejected():
    held, state = started()
    steep = System(held.motion, lambda x, t: -1e200 * x**5, potential=lambda x, t: float(1e200 * (x**6).sum() / 6))
    end = HamiltonianMonteCarlo(0.5, 5, 8).step(steep, state, 0.1)
    counts = Counts.of(end)
    assert counts.not_finite + counts.unsolved == 1 and np.isnan(counts.change)
    assert np.array_equal(end.positions, state.positions)


def test_positions_put_into_a_state_have_their_own_energy():
    """What the state knew of the energy is that of the positions it had."""
    held, state = started()
    sampler = HamiltonianMonteCarlo(0.5, 3, 1)
    moved = sampler.step(held, state, 0.1)
    back = {"positions": state.positions, "velocities": state.velocities, "forces": None}
    placed = sampler.step(held, replace(moved, **back), 0.1)
    fresh = sampler.step(held, replace(moved, **back, thermostat=None), 0.1)
    assert np.abs(moved.positions - state.positions).max() > 0.01
    assert placed.thermostat[CHANGE] == fresh.thermostat[CHANGE]
    assert Counts.of(placed).proposals == 2
    moved = sampler.step(held, state, 0.1)
    made_by_hand = {"forces": waves(state.positions), "step": 1, "thermostat": moved.thermostat}
    put = State(state.positions, state.velocities, **made_by_hand)
    assert sampler.step(held, put, 0.1).thermostat[CHANGE] == fresh.thermostat[CHANGE]


# -- steps that are taken back -----------------------------------------------------------------------


@pytest.mark.parametrize("stepper", [Rattle(), Geodesic(3), Suzuki4(), BlanesMoan4(), BlanesMoan6a()], ids=repr)
def test_the_way_back_costs_no_force_and_the_step_is_the_stepper_s(stepper):
    held, start = started()
    calls = []
    counted = System(held.motion, lambda x, t: (calls.append(1), held.force(x, t))[1], potential=held.potential)
    state = counted.with_forces(start)
    steps = ReversedSteps(counted, stepper, 1e-9)
    for k in range(1, 4):
        calls.clear()
        state = steps.step(counted, state, 0.1)
        # A stepper that ends with a drift does not know the forces at its end.
        assert len(calls) == stepper.force_evaluations, k
    plain = run(held, start, 0.1, 3, stepper=stepper)
    assert np.array_equal(plain.positions, state.positions) and np.array_equal(plain.velocities, state.velocities)


class Law:
    """A sampler whose dH is normal with deviation dt^p and mean half its square."""

    def __init__(self, order: int, rng: np.random.Generator) -> None:
        self.order, self._rng, self._held = order, rng, np.zeros(SIZE)

    def check(self, system):
        pass

    def step(self, system, state, dt):
        spread = dt**self.order
        change = self._rng.normal(spread**2 / 2, spread) if dt < 2 else math.inf
        self._held[SUM] += min(1.0, math.exp(-max(change, 0.0)))
        return replace(state, thermostat=self._held.copy())


@pytest.mark.parametrize("start", [0.1, 0.5, 2.5])
@pytest.mark.parametrize("order", [2, 4, 6])
def test_a_known_law_is_found(order, start):
    (held, state), rng = trimer(trap, trap_potential), np.random.default_rng(1)
    found = [tune(held, state, start, Law(order, rng)).dt for _ in range(40)]
    shares = [math.erfc(dt**order / math.sqrt(8)) for dt in found]
    assert abs(np.mean(shares) - order / (order + 1)) < 0.09
    assert np.std(shares) < 0.06


def test_a_step_is_found_and_stays():
    held, state = trimer(trap, trap_potential)
    sampler = HamiltonianMonteCarlo(KT, 6, 3)
    found = tune(held, state, 0.02, sampler, wanted=0.8, proposals=100)
    assert Counts.of(found.state).proposals == 0 and found.state.step == 100
    assert 0.1 < found.dt < 1.0 and 0.6 < found.acceptance < 1.0
    after = run(held, found.state, found.dt, 150, stepper=sampler, check_every=0)
    assert abs(Counts.of(after).acceptance - 0.8) < 0.13
    again = tune(held, state, 0.02, sampler, wanted=0.8, proposals=100)
    assert again.dt == found.dt


def test_where_nothing_succeeds():
    held, x = dumbbells(2)
    state = held.initial_state(x)
    worse = iter(range(10**9))
    uphill = System(held.motion, held.force, potential=lambda x, t: 1e6 * next(worse))
    with pytest.raises(ConvergenceError, match="no proposal succeeded"):
        tune(uphill, state, 0.1, HamiltonianMonteCarlo(0.5, 1, 3, stepper=Rattle()), proposals=20)


LADDER = [0.3, 0.45, 0.7]


def ladder(proposals=3):
    held, state = trimer(trap, trap_potential)
    return held, [
        run(held, state, 0.3, proposals, stepper=HamiltonianMonteCarlo(kt, 3, k, keep=0.2))
        for k, kt in enumerate(LADDER)
    ]


def test_the_rule_and_what_changes_places():
    _, states = ladder()
    energies = [float(s.thermostat[POTENTIAL]) for s in states]
    seen = set()
    for number in range(40):
        after, made = exchange(states, LADDER, 5, number)
        pair = number % 2
        u = noise_generator((5, 0), number, EXCHANGE).random(3)[pair]
        power = (1 / LADDER[pair] - 1 / LADDER[pair + 1]) * (energies[pair] - energies[pair + 1])
        assert made == [(math.log1p(-u) < power) if k == pair else None for k in range(2)]
        seen.add(made[pair])
        for k, new in enumerate(after):
            partner = {pair: pair + 1, pair + 1: pair}.get(k, k) if made[pair] else k
            assert np.array_equal(new.positions, states[partner].positions)
            scale = math.sqrt(LADDER[k] / LADDER[partner])
            np.testing.assert_allclose(new.velocities, scale * states[partner].velocities, rtol=1e-14)
            assert new.thermostat[POTENTIAL] == energies[partner]
            assert Counts.of(new) == Counts.of(states[k]) and new.step == states[k].step
    assert seen == {True, False}
    assert energies == [float(s.thermostat[POTENTIAL]) for s in states]
