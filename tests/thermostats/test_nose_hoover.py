"""Nose-Hoover chains: reversible, of order 2, with a conserved energy; degrees of freedom by rank."""

from __future__ import annotations

import math

import numpy as np
import pytest
from thermostat_systems import METHANE, TEN, loaded, started, system, waves

from kcons.constraints import Distance
from kcons.steppers import State, run
from kcons.thermostats import NoseHooverChain, thermal_velocities


@pytest.mark.parametrize(("length", "steps"), [(1, 500), (3, 450), (5, 100)])
def test_a_negative_step_undoes_a_step(length, steps):
    held, state = started()
    thermostat = NoseHooverChain(0.5, 1.0, length=length)
    begun = thermostat.start(held, state)
    there = run(held, begun, 0.02, steps, stepper=thermostat)
    back = run(held, there, -0.02, steps, stepper=thermostat)
    assert np.abs(there.positions - begun.positions).max() > 0.1
    assert np.abs(back.positions - begun.positions).max() <= 1e-10
    assert np.abs(back.velocities - begun.velocities).max() <= 1e-10
    assert np.abs(back.thermostat - begun.thermostat).max() <= 1e-10


def test_a_loaded_chain_of_other_degrees_of_freedom_begins_anew():
    """Fewer rows, or another `momentum`, than the run had; total momentum that is not zero is said again.

    Where none is conserved nothing is said, and no force is asked for.
    """
    x, asked = METHANE, []
    held = system([Distance(TEN)], x, [12.0, 1, 1, 1, 1], lambda x, t: asked.append(0) or waves(x))
    state = State(x, thermal_velocities(held, x, 0.5, 1))
    saved = run(held, state, 0.02, 5, stepper=NoseHooverChain(0.5, 1.0, momentum="free"))
    assert saved.thermostat[-1] == 6
    asked.clear()
    again = NoseHooverChain(0.5, 1.0).start(held, loaded(saved))
    assert np.array_equal(again.thermostat, saved.thermostat) and not asked
    told = NoseHooverChain(0.5, 1.0, momentum="conserved")
    with pytest.warns(UserWarning, match="total momentum is not zero"):
        assert told.start(held, loaded(saved)).thermostat[-1] == 3
    fewer = system([Distance(TEN[:4])], x, [12.0, 1, 1, 1, 1], waves)
    assert np.array_equal(NoseHooverChain(0.5, 1.0).start(fewer, loaded(saved)).thermostat, [0.0] * 6 + [11.0])
    with pytest.warns(UserWarning, match="total momentum is not zero"):
        saved = run(held, state, 0.02, 5, stepper=told)
    with pytest.warns(UserWarning, match="total momentum is not zero"):
        again = NoseHooverChain(0.5, 1.0, momentum="conserved").start(held, loaded(saved))
    assert np.array_equal(again.thermostat, saved.thermostat)


@pytest.mark.parametrize("n", [1, 4])
def test_temperature_oscillates_with_the_period_asked_for(n):
    """Dumbbells without forces under one link: K'' = -2 (2 pi/period)^2 (K - g kT/2) near it, whatever g is."""
    kt, period, dt = 0.5, 2.0, 0.005
    x = np.array([[5.0 * i, y, 0.0] for i in range(n) for y in (0.0, 1.0)])
    held = system([Distance(np.arange(2 * n).reshape(-1, 2))], x, np.ones(2 * n))
    v = thermal_velocities(held, x, kt, 3)
    v *= math.sqrt(1.02 * 0.5 * 5 * n * kt / held.kinetic_energy(v))
    kinetic: list[float] = []
    run(
        held,
        held.initial_state(x, v),
        dt,
        1200,
        stepper=NoseHooverChain(kt, period, length=1, momentum="free"),
        observers=[lambda s: kinetic.append(held.kinetic_energy(s.velocities))],
    )
    off = np.array(kinetic) / (0.5 * 5 * n * kt) - 1
    before = np.flatnonzero(off[1:] * off[:-1] < 0)
    times = dt * (before + off[before] / (off[before] - off[before + 1]))
    assert 2 * np.diff(times).mean() == pytest.approx(period / math.sqrt(2), rel=2e-3)
