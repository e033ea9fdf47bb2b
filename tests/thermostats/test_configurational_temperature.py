"""The temperature of configurations: estimators against closed forms, and thermostats against each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from thermostat_systems import dumbbells, quartic, quartic_potential, system

from kcons.constraints import Distance, Sphere
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, run
from kcons.thermostats import (
    Estimate,
    Isokinetic,
    Langevin,
    NoseHooverChain,
    configurational_sample,
    configurational_temperature,
    mean,
    thermal_velocities,
)


def test_what_does_not_change_is_no_distance_or_an_infinite_one_away():
    still = mean(np.ones(40))
    assert (still.off(1.0), still.off(2.0), still.off(0.5)) == (0.0, -math.inf, math.inf)


def test_estimates():
    assert Estimate(1.1, 0.05).off(1.0) == pytest.approx(2.0)
    assert Estimate(1.1, 0.03).off(1.0, 0.04) == pytest.approx(2.0)
    rng = np.random.default_rng(0)
    below = rng.uniform(1, 3, 10_000)
    above = 0.7 * below + rng.standard_normal(10_000)
    found = configurational_temperature(above, below)
    assert abs(found.off(0.7)) <= 3.5 and found.error == pytest.approx(0.5 / 100, rel=0.4)


def test_on_a_sphere():
    """U = m g z: |grad U|^2/m = m g^2 (1 - z^2/R^2), and the laplacian is -2 g z/R^2."""
    radius, m, g = 1.3, 2.0, 0.7
    x = radius * np.array([[0.48, 0.6, 0.64]])
    held = system([Sphere([0], [0, 0, 0], radius)], x, [m], lambda x, t: np.array([[0.0, 0.0, -m * g]]))
    state = State(x, np.zeros_like(x))
    rng = np.random.default_rng(0)
    samples = [configurational_sample(held, state, rng) for _ in range(2000)]
    z = x[0, 2]
    assert samples[0][0] == pytest.approx(m * g**2 * (1 - z**2 / radius**2), rel=1e-12)
    found = mean([s[1] for s in samples])
    assert abs(found.off(-2 * g * z / radius**2)) <= 3.5
    # Every direction has the same curvature here, v^2 of a draw at unit energy apart.
    many = configurational_sample(held, state, rng, directions=2000)[1]
    assert many == pytest.approx(-2 * g * z / radius**2, rel=0.1)


def test_free_atoms_see_the_plain_laplacian():
    x = np.array([[0.4, 0.2, -0.4], [-0.7, 0.3, 0.4]])
    m = np.array([1.0, 3.0])
    held = system([], x, m, quartic)
    square, curvature = configurational_sample(held, State(x, x), np.random.default_rng(0), directions=4000)
    assert square == pytest.approx(float((x**6 / m[:, None]).sum()), rel=1e-13)
    assert curvature == pytest.approx(float((3 * x**2 / m[:, None]).sum()), rel=0.08)
    with pytest.raises(InputError, match="directions is 0"):
        configurational_sample(held, State(x, x), np.random.default_rng(0), directions=0)


def test_where_targets_move_there_is_none():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([Distance([[0, 1]], lambda t: 1 + t)], x, [1.0, 1.0], quartic)
    with pytest.raises(UnsupportedError, match="targets rest"):
        configurational_sample(held, held.initial_state(x), np.random.default_rng(0))


# -- statistics -------------------------------------------------------------------------------------


def trapped(thermostat, steps, dt=0.02):
    """Two coupled atoms in x^4/4: U is homogeneous, so that kT = 4<U>/6."""
    x = np.array([[0.3, -0.2, 0.5], [-0.4, 0.6, 0.1]])

    def force(x, t):
        d = x[0] - x[1]
        push = 0.5 * (d @ d) * d
        return -(x**3) - np.array([push, -push])

    def potential(x):
        d = x[0] - x[1]
        return float((x**4).sum() / 4 + (d @ d) ** 2 / 8)

    held = system([], x, [1.0, 1.0], force)
    state = run(held, State(x, thermal_velocities(held, x, 1.0, 1)), dt, 500, stepper=thermostat)
    energies = []
    run(held, state, dt, steps, stepper=thermostat, observers=[lambda s: energies.append(potential(s.positions))])
    return mean(4 * np.array(energies) / 6)


TRAPPED = {
    "g - 1": (Isokinetic(1.0), 1.0),
    "g": (Isokinetic(kinetic_energy=3.0), 1.2),
    "Langevin": (Langevin(1.0, 0.5, rng=1), 1.0),
    "Nose-Hoover": (NoseHooverChain(1.0, 3.0), 1.0),
}
#: Steps with which the standard error is 0.04 or less.
ENOUGH = {"Langevin": 24_000, "Nose-Hoover": 16_000}


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAPPED)
def test_two_atoms_in_a_trap(name):
    """The convention 2K = g kT is 20 % off: at least five standard errors, where 3.5 are allowed."""
    thermostat, expected = TRAPPED[name]
    found = trapped(thermostat, ENOUGH.get(name, 40_000), 0.05)
    assert abs(found.off(expected)) <= 3.5, found
    assert found.error <= 0.04


@pytest.mark.validation
@pytest.mark.parametrize("name", TRAPPED)
def test_two_atoms_in_a_trap_to_one_percent(name):
    """The convention 2K = g kT is 20 % off; here with an error of half a percent."""
    thermostat, expected = TRAPPED[name]
    found = trapped(thermostat, 600_000)
    assert abs(found.off(expected)) <= 3, found
    assert found.error <= 0.01


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore:no atom or body")
def test_dumbbells_in_a_trap_by_the_general_estimator():
    held, x = dumbbells(2, force=quartic, potential=quartic_potential)
    x = x - x.mean(axis=0)
    rng = np.random.default_rng(5)
    for thermostat, expected in (
        (Isokinetic(0.5), 0.5),
        (Isokinetic(kinetic_energy=0.5 * 10 * 0.5), 0.5 * 10 / 9),
        (Langevin(0.5, 0.5, rng=1), 0.5),
    ):
        state = run(held, State(x, thermal_velocities(held, x, 0.5, 1)), 0.02, 2000, stepper=thermostat)
        samples = []
        run(
            held,
            state,
            0.02,
            1_000_000,
            stepper=thermostat,
            observers=[lambda s, seen=samples: seen.append(configurational_sample(held, s, rng))],
            every=10,
        )
        found = configurational_temperature(*np.transpose(samples))
        assert abs(found.off(expected)) <= 3, (found, expected)
        assert found.error <= 0.012 * expected / 0.5
