"""Geodesic BAOAB: exact friction and noise on the constraints, momentum, moving targets; numbers drawn in kernels."""

from __future__ import annotations

import math
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from thermostat_systems import dumbbells, quartic, quartic_potential, system, waves

from kcons.constraints import Distance, FixedAtoms, MovingTarget, Sphere
from kcons.steppers import State, System, run
from kcons.thermostats import Langevin, thermal_velocities
from kcons.thermostats.noise import fill_normal, noise_generator


def started(n=2, **options):
    held, x = dumbbells(n, **options)
    return held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4))


def test_free_flight_forgets_its_velocity_at_the_rate_asked_for():
    """Without forces and rows a step is the exact Ornstein-Uhlenbeck process: <v(t)> = e^{-gamma t} v(0)."""
    n, kt, gamma, dt = 20_000, 0.7, 0.8, 0.5
    held = system([], np.zeros((n, 3)), np.full(n, 2.0))
    v = np.tile([1.0, -0.5, 0.2], (n, 1))
    state = State(np.zeros((n, 3)), v)
    for k in range(1, 4):
        state = Langevin(kt, gamma, 7).step(held, state, dt)
        keep = math.exp(-gamma * dt * k)
        spread = math.sqrt(kt / 2 * (1 - keep**2))
        np.testing.assert_allclose(state.velocities.mean(axis=0), keep * v[0], atol=4.5 * spread / math.sqrt(n))
        np.testing.assert_allclose(state.velocities.std(axis=0), spread, rtol=4.5 / math.sqrt(2 * n))


def test_moving_targets_are_followed_and_friction_knows_their_speed():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([Distance([[0, 1]], lambda t: 1 + 0.5 * t), Sphere([0], [0, 0, -1.0], 1.0)], x, [1.0, 3.0], waves)
    state = held.initial_state(x, thermal_velocities(held, x, 0.5, 3))
    after = run(held, state, 0.01, 200, stepper=Langevin(0.5, 50.0, 3))
    d = after.positions[1] - after.positions[0]
    assert np.linalg.norm(d) == pytest.approx(2.0, rel=1e-13)
    assert d @ (after.velocities[1] - after.velocities[0]) / 2 == pytest.approx(0.5, rel=1e-12)


def test_heat_is_counted():
    """Total energy less the heat stays, to the order of the scheme."""
    drifts = []
    for dt in (0.02, 0.01):
        held, x = dumbbells(2, force=quartic, potential=quartic_potential)
        x = x - 1.2
        held = System(held.motion, quartic, potential=quartic_potential)
        thermostat = Langevin(0.5, 1.0, 3)
        values = []
        run(
            held,
            State(x, thermal_velocities(held, x, 0.5, 4)),
            dt,
            round(20 / dt),
            stepper=thermostat,
            observers=[lambda s, h=held, t=thermostat, v=values: v.append(t.conserved_energy(h, s))],
        )
        drifts.append(np.std(values))
        assert np.abs(np.diff(values)).max() <= 20 * dt**2
    assert drifts[0] <= 0.05
    assert drifts[1] <= 0.5 * drifts[0]


def test_threads_share_a_bath():
    """Each with a System of its own."""
    bath, interval = Langevin(0.5, 1.0, 3), sys.getswitchinterval()
    begun = [started() for _ in range(3)]
    alone = [run(held, state, 0.01, 200, stepper=bath) for held, state in begun]
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as threads:
            together = list(threads.map(lambda made: run(*made, 0.01, 200, stepper=bath), begun))
    finally:
        sys.setswitchinterval(interval)
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one.positions, other.positions)


@pytest.mark.parametrize("substeps", [1, 3])
def test_each_substep_meets_targets_at_its_own_time(substeps):
    """Without forces, friction and noise a step is as many steps of RATTLE, with a rod that grows and shrinks."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    length = MovingTarget(lambda t: 1 + 0.3 * math.sin(4 * t), lambda t: 1.2 * math.cos(4 * t))
    held = system([FixedAtoms([0]), Distance([0, 1], length)], x, np.ones(2))
    state = held.initial_state(x, [[0, 0, 0], [1.2, 0.9, 0.0]])
    dt = 0.12
    end = run(held, state, dt, 5, stepper=Langevin(0.5, 0.0, 3, substeps=substeps))
    known = run(held, state, dt / (2 * substeps), 5 * 2 * substeps)
    np.testing.assert_allclose(end.positions, known.positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(end.velocities, known.velocities, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", [0, 7, 2**63, 2**64 - 1])
@pytest.mark.parametrize(("number", "part"), [(1, 0), (10**9, 3), (0, 2**63)])
def test_numbers_are_those_of_numpy_to_the_last_bit(seed, number, part) -> None:
    """So many that all layers of the ziggurat and its tail are met."""
    found = np.empty(20_001)
    fill_normal(np.uint64(seed), np.uint64(number), np.uint64(part), found)
    np.testing.assert_array_equal(found, noise_generator((seed, 0), number, part).standard_normal(20_001))
    assert np.abs(found).max() > 3.66  # beyond the last layer
