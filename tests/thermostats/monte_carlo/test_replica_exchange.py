"""Exchange between temperatures: the rule, what changes places, an exact ladder, bad input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from monte_carlo_systems import trap, trap_potential, trimer
from thermostat_systems import system

from kcons.constraints import Distance
from kcons.errors import InputError
from kcons.steppers import State, run
from kcons.thermostats import Counts, HamiltonianMonteCarlo, exchange
from kcons.thermostats.langevin import noise_generator
from kcons.thermostats.monte_carlo import EXCHANGE, POTENTIAL

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


def test_bad_input():
    _, states = ladder(1)
    bare = State(states[0].positions, states[0].velocities)
    two = State(np.zeros((2, 3)), np.zeros((2, 3)), thermostat=states[0].thermostat)
    for given, temperatures, number, words in (
        (states, LADDER[:2], 0, "3 states and 2 temperatures"),
        (states[:1], LADDER[:1], 0, "1 states"),
        (states, [0.3, 0.4, 0.0], 0, "thermal_energies is 0.0"),
        ([bare, *states[1:]], LADDER, 0, "state 0 does not know its potential energy"),
        ([states[0], two, states[2]], LADDER, 0, "state 1 has another number of atoms"),
        (states, LADDER, -1, "number is -1"),
        (states, LADDER, 2**64, "number is 18446744073709551616"),
    ):
        with pytest.raises(InputError, match=words):
            exchange(given, temperatures, 1, number)


@pytest.mark.parametrize("other", ["masses", "constraints"])
def test_states_of_other_systems(other):
    held, states = ladder(1)
    masses = held.masses * (2 if other == "masses" else 1)
    rods = Distance([[0, 1], [1, 2]]) if other == "masses" else Distance([[0, 1]], 1.3)
    x = states[1].positions
    apart = system([rods], x, masses, trap, trap_potential)
    changed = run(apart, apart.initial_state(x, project=True), 0.3, 1, stepper=HamiltonianMonteCarlo(0.45, 3, 1))
    for given in ([states[0], changed, states[2]], [changed, states[1], states[2]]):
        with pytest.raises(InputError, match=f"state 1 .*other {other} than state 0"):
            exchange(given, LADDER, 1, 0)
    # Another System of the same masses and constraints is as good.
    same, start = trimer(trap, trap_potential)
    again = run(same, start, 0.3, 1, stepper=HamiltonianMonteCarlo(0.45, 3, 1, keep=0.2))
    after, _ = exchange([states[0], again, states[2]], LADDER, 1, 0)
    assert np.isfinite(run(held, after[0], 0.3, 1, stepper=HamiltonianMonteCarlo(0.3, 3, 0, keep=0.2)).positions).all()
