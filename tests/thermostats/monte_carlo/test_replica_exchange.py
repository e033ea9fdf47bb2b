"""Exchange between temperatures: the rule, what changes places, an exact ladder, bad input."""

from __future__ import annotations

import math

import numpy as np
from monte_carlo_systems import trap, trap_potential, trimer

from kcons.steppers import run
from kcons.thermostats import Counts, HamiltonianMonteCarlo, exchange
from kcons.thermostats.monte_carlo import EXCHANGE, POTENTIAL
from kcons.thermostats.noise import noise_generator

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


def test_a_run_of_exchanges_keeps_each_temperature():
    """The mean energy in the trap: 9 - 2 momenta kT/2 each, and the same potential energy as without exchanges."""
    held, states = ladder()
    samplers = [HamiltonianMonteCarlo(kt, (2, 4), 10 + k) for k, kt in enumerate(LADDER)]
    kinetic, made = [], []
    for number in range(250):
        states = [s.step(held, x, 0.3) for s, x in zip(samplers, states, strict=True)]
        states, told = exchange(states, LADDER, 9, number)
        made += [t for t in told if t is not None]
        kinetic.append([held.kinetic_energy(s.velocities) for s in states])
    assert 0.3 < np.mean(made) < 0.99
    mean, spread = np.mean(kinetic, axis=0), np.std(kinetic, axis=0) / math.sqrt(250)
    assert (np.abs(mean - 3.5 * np.array(LADDER)) < 3.5 * spread).all()
