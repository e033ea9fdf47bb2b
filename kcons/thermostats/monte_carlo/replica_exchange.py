"""Configurations exchanged between neighboring temperatures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kcons.constraints.arguments import Rng, positive, seed_from, whole_number
from kcons.errors import InputError
from kcons.steppers import State
from kcons.thermostats.monte_carlo.hamiltonian_monte_carlo import EXCHANGE, POTENTIAL, SIZE, stream


def exchange(
    states: Sequence[State], thermal_energies: Sequence[float], rng: Rng, number: int
) -> tuple[list[State], list[bool | None]]:
    """Offer neighbors an exchange: with probability min(1, exp((1/kT_i - 1/kT_j) (U_i - U_j))) it is made.

    Configurations change places and velocities are scaled with sqrt(T), which leaves the product of all densities as it
    is. Pairs (0, 1), (2, 3), ... take turns with (1, 2), (3, 4), ... Numbers, clocks and counts stay with their
    temperatures. Each run needs a seed of its own: with the same one all draw the same numbers, and runs that are not
    independent do not have the product of the densities.

    Parameters
    ----------
    states : sequence of State
        One for each temperature, of the same system, after at least one step of `HamiltonianMonteCarlo` each: they know
        their potential energies.
    thermal_energies : sequence of float
        k_B T of each.
    rng : int, numpy.random.Generator or None
    number : int
        Of the round: random numbers are a function of it and of the integer given as `rng`.

    Returns
    -------
    states : list of State
    made : list of bool or None, one less than states
        Whether each pair was exchanged; None where it had no turn.

    Raises
    ------
    InputError
        A state without a potential energy; states of Systems of other masses or constraints.
    """
    if not all(isinstance(given, Sequence | np.ndarray) for given in (states, thermal_energies)):
        raise InputError("give a sequence of states, and of as many temperatures", item="states")
    kt = np.array([positive(value, "thermal_energies") for value in thermal_energies])
    if len(states) < 2 or len(states) != len(kt):
        raise InputError(
            f"{len(states)} states and {len(kt)} temperatures; give one for each, two or more", item="states"
        )
    number = whole_number(number, "number", 0, 2**64 - 1)
    for k, state in enumerate(states):
        if (
            not isinstance(state, State)
            or state.thermostat is None
            or state.thermostat.shape != (SIZE,)
            or math.isnan(potential_of(state))
        ):
            raise InputError(
                f"state {k} does not know its potential energy; make a step of HamiltonianMonteCarlo with it first",
                item="states",
            )
        if state.positions.shape != states[0].positions.shape:
            raise InputError(f"state {k} has another number of atoms than state 0", item="states")
        _refuse_others(states[0], state, k)
    chances = np.log1p(-stream(seed_from(rng), int(number), EXCHANGE).random(len(states)))
    after = list(states)
    told: list[bool | None] = [None] * (len(states) - 1)
    for k in range(int(number) % 2, len(states) - 1, 2):
        a, b = states[k], states[k + 1]
        told[k] = bool(chances[k] < (1 / kt[k] - 1 / kt[k + 1]) * (potential_of(a) - potential_of(b)))
        if told[k]:
            scale = math.sqrt(float(kt[k] / kt[k + 1]))
            after[k], after[k + 1] = _moved(b, a, scale), _moved(a, b, 1 / scale)
    return after, told


def potential_of(state: State) -> float:
    """The potential energy that a state of `HamiltonianMonteCarlo` knows; NaN if it does not."""
    return math.nan if state.thermostat is None else float(state.thermostat[POTENTIAL])


def _refuse_others(first: State, other: State, k: int) -> None:
    """Refuse states of which one is not on the constraints of the other."""
    systems = [s.origin[0]() if s.origin is not None and s.origin[0] is not None else None for s in (first, other)]
    if systems[0] is None or systems[1] is None:
        return
    if not np.array_equal(systems[0].masses, systems[1].masses):
        raise InputError(f"state {k} has other masses than state 0", item="states")
    for system, state in zip(systems, (other, first), strict=True):
        assert system is not None
        try:
            system.initial_state(state.positions, time=state.time)
        except InputError as error:
            raise InputError(f"state {k} is of other constraints than state 0: {error}", item="states") from None


def _moved(there: State, here: State, scale: float) -> State:
    """The configuration of `there`, with velocities scaled, in the run of `here`."""
    assert there.thermostat is not None and here.thermostat is not None
    held = here.thermostat.copy()
    held[POTENTIAL] = there.thermostat[POTENTIAL]
    return replace(
        here,
        positions=there.positions,
        velocities=scale * there.velocities,
        forces=there.forces,
        remainder=there.remainder,
        thermostat=held,
        origin=there.origin,
    )
