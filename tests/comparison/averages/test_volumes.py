"""Series of volumes: errors, ratios of two known distributions, and what a barostat costs."""

from __future__ import annotations

import numpy as np
import pytest
from pressure_systems import gas

from kcons.comparison.averages import volumes
from kcons.errors import InputError
from kcons.thermostats import ConstantPressure, Langevin, MonteCarloBarostat, thermal_velocities


def series(seed: int, spread: float = 1.0, memory: float = 0.9, n: int = 4000) -> np.ndarray:
    """A normal process of unit mean whose correlations fall by `memory` from value to value."""
    rng = np.random.default_rng(seed)
    noise, x = rng.standard_normal(n) * np.sqrt(1 - memory**2), np.empty(n)
    x[0] = rng.standard_normal()
    for k in range(1, n):
        x[k] = memory * x[k - 1] + noise[k]
    return 10.0 + spread * x


def test_errors_are_those_of_independent_values():
    found = np.array([volumes.mean_and_error(series(seed)) for seed in range(40)])
    exact = np.sqrt(1.9 / 0.1 / 4000)
    assert found[:, 1].mean() == pytest.approx(exact, rel=0.1)
    assert found[:, 0].std() == pytest.approx(exact, rel=0.35)
    kappa = np.array([volumes.compressed(series(seed, spread=0.5)) for seed in range(10)])
    assert abs(kappa[:, 0].mean() - 0.025) < 4 * kappa[:, 1].mean() / np.sqrt(10)
    mean, error = volumes.mean_and_error(np.arange(31.0))
    assert mean == 15.0 and np.isnan(error)


def test_pooled_means():
    assert volumes.pooled([(1.0, 0.1), (2.0, 0.2)]) == pytest.approx((1.2, 0.2 / np.sqrt(5), np.sqrt(20.0)))
    assert np.isnan(volumes.pooled([(1.0, 0.1)])[2])


def test_slopes_of_known_distributions():
    """Volumes of an ideal gas, and enthalpies that are so distributed, in two states each."""
    n, rng = 30, np.random.default_rng(1)

    def state(temperature, pressure):
        v = rng.gamma(n + 1, temperature / pressure, 20_000)
        u = rng.gamma(n, temperature, 20_000)
        return {"temperature": temperature, "pressure": pressure, "volumes": v, "energies": u}

    first = state(2.0, 1.0)
    for other, exact in ((state(2.0, 1.3), -0.15), (state(2.2, 1.0), 1 / 2.0 - 1 / 2.2)):
        found, error, told = volumes.slope_between(first, other)
        assert told == pytest.approx(exact)
        assert abs(found - exact) < 3.5 * error < 0.1 * abs(exact)
    for other in (first, state(2.2, 1.3)):
        with pytest.raises(InputError, match="either in temperature or in pressure"):
            volumes.slope_between(first, other)


def test_cost_of_a_barostat(monkeypatch):
    """By a clock that counts trials and steps: a step is 1, a trial 10."""
    system, x = gas(n=4)
    stepper = ConstantPressure(Langevin(1.0, 1.0, 1), MonteCarloBarostat(0.01, every=8))
    clock = {"now": 0.0}

    def counted(owner, name, price):
        true = getattr(owner, name)

        def call(*words, **named):
            clock["now"] += price
            return true(*words, **named)

        monkeypatch.setattr(owner, name, call)

    counted(MonteCarloBarostat, "move", 10.0)
    true_run = volumes.run

    def run(system, state, dt, steps, **more):
        clock["now"] += steps
        return true_run(system, state, dt, steps, **more)

    monkeypatch.setattr(volumes, "run", run)
    monkeypatch.setattr(volumes.time, "process_time", lambda: clock["now"])
    state = system.initial_state(x, thermal_velocities(system, x, 1.0, 1), project=True)
    found = volumes.added_cost(system, state, 0.01, stepper, 4)
    assert found == {"every": 8, "turns": 4, "ratio": pytest.approx(18 / 8), "error": 0.0}
