"""The isokinetic thermostat: parts of a system, what runs go on from, extremes, and bad input named."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
from thermostat_systems import dumbbells, swirling, system, water_and_more, waves

from kcons.constraints import Plane, Sphere
from kcons.errors import NonFiniteError
from kcons.steppers import State, run
from kcons.thermostats import Isokinetic, thermal_velocities


def test_a_run_goes_on_from_positions_and_velocities_alone():
    held, x = dumbbells(2)
    thermostat = Isokinetic(0.5)
    half = run(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)), 0.02, 25, stepper=thermostat)
    bare = State(half.positions, half.velocities, half.time, step=25)
    assert np.array_equal(
        run(held, half, 0.02, 25, stepper=thermostat).positions,
        run(held, bare, 0.02, 25, stepper=thermostat).positions,
    )


def test_forces_that_were_dropped_are_found_again():
    held, x = dumbbells(2)
    thermostat = Isokinetic(0.5, order=4)
    state = run(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)), 0.02, 5, stepper=thermostat)
    stale = replace(state, forces=None, thermostat=state.thermostat * [1, 1, 17.0, 1])
    a, b = (thermostat.step(held, s, 0.02) for s in (state, stale))
    assert np.array_equal(a.positions, b.positions) and np.array_equal(a.velocities, b.velocities)


def test_velocities_off_the_constraints_are_projected_and_scaled():
    held, x = dumbbells(2)
    v = np.random.default_rng(0).standard_normal(x.shape)
    begun = Isokinetic(0.5).start(held, State(x, v))
    tangent = held.motion.project_velocities(x, v)
    ratio = begun.velocities / tangent
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-12)
    assert 2 * held.kinetic_energy(begun.velocities) == pytest.approx((12 - 2 - 1) * 0.5, rel=1e-14)


def test_one_degree_of_freedom():
    """g = 1 has no temperature, but a kinetic energy; g = 2 has beta = 1/2K."""
    x = np.array([[1.0, 0, 0]])
    one = [Plane([0], [0, 0, 1.0]), Sphere([0], [0, 0, 0], 1.0)]
    state = State(x, np.array([[0.0, 0.7, 0.0]]))
    ring = system(one, x, [1.0], waves)
    after = run(ring, state, 0.01, 100, stepper=Isokinetic())
    assert ring.kinetic_energy(after.velocities) == pytest.approx(ring.kinetic_energy(state.velocities), rel=1e-14)
    two = system(one[1:], x, [1.0], waves)
    assert 2 * two.kinetic_energy(Isokinetic(0.4).start(two, state).velocities) == pytest.approx(0.4, rel=1e-14)


def test_forces_whose_squares_overflow():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    v = np.array([[0.3, -0.2, 0.1], [0.1, -0.4, 0.3]])
    held = system([], x, [1.0, 1.0], lambda x, t: np.full_like(x, 1e200))
    after = Isokinetic(momentum="free").step(held, State(x, v), 0.01)
    np.testing.assert_allclose(after.velocities, math.sqrt(2 * held.kinetic_energy(v) / 6), rtol=1e-14)
    light = system([], x, [1e-200, 1.0], lambda x, t: np.full_like(x, 1e200))
    with pytest.raises(NonFiniteError, match="non-finite velocity at step 1"):
        Isokinetic(momentum="free").step(light, State(x, v), 0.01)


def test_momentum_stays_zero():
    rows, x, masses = water_and_more()
    held = system(rows, x, masses, swirling)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        state = State(x, thermal_velocities(held, x, 0.5, 1, zero_momentum=True))
        after = run(held, state, 0.01, 2000, stepper=Isokinetic(0.5))
    assert np.abs(held.masses @ after.velocities).max() <= 1e-11
