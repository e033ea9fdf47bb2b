"""The step for a wanted acceptance: on a known law, on a system, bad input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from monte_carlo_systems import KT, trap, trap_potential, trimer
from thermostat_systems import dumbbells

from kcons.errors import ConvergenceError
from kcons.steppers import Rattle, System, run
from kcons.thermostats import Counts, HamiltonianMonteCarlo, tune
from kcons.thermostats.monte_carlo import SIZE, SUM


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
