"""The time step for a wanted share of accepted proposals, found before a run and kept in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, TypeAlias

import numpy as np

from kcons.constraints.arguments import Positive, checked, positive, share, whole_number
from kcons.errors import ConvergenceError
from kcons.steppers import State, System
from kcons.thermostats.freedom import carried
from kcons.thermostats.monte_carlo.hamiltonian_monte_carlo import (
    POTENTIAL,
    SIZE,
    SUM,
    HamiltonianMonteCarlo,
)

#: Of dual averaging: how strongly proposals move the step, how many count as made already, how fast old ones are
#: forgotten.
PULL, BEFORE, FORGET = 0.2, 10, 0.75

Proposals: TypeAlias = Annotated[int, partial(whole_number, least=20)]


class DualAveraging:
    """A time step that moves until as many proposals are accepted as wanted (Hoffman and Gelman, Algorithm 5)."""

    @checked
    def __init__(self, dt: Positive, wanted: Annotated[float, positive, share]) -> None:
        self.wanted = wanted
        self._center = self._log = math.log(dt)
        self._sum = self._mean = 0.0
        self._told: list[float] = []
        self.made = 0

    @property
    def dt(self) -> float:
        """For the next proposal."""
        return math.exp(self._log)

    @property
    def result(self) -> float:
        """The mean, later proposals counting more."""
        return math.exp(self._mean) if self.made else self.dt

    @property
    def acceptance(self) -> float:
        """Mean probability of the second half of the proposals."""
        second = self._told[(self.made + 1) // 2 :]
        return sum(second) / len(second)

    def refuse_failure(self, shown: Callable[[float], str] = "{:.3g}".format) -> None:
        """Raise `ConvergenceError` where none of the second half of the proposals succeeded; `shown` tells a time."""
        if not self.acceptance > 0:
            raise ConvergenceError(
                f"no proposal succeeded with time steps down to {shown(self.dt)}; is the start sound?"
            )

    def learn(self, probability: float) -> None:
        """A proposal with `dt` had this probability of being accepted."""
        self.made += 1
        self._told.append(probability)
        self._sum += self.wanted - probability
        self._log = self._center - math.sqrt(self.made) / PULL * self._sum / (self.made + BEFORE)
        share = self.made**-FORGET
        self._mean += share * (self._log - self._mean)


@dataclass(frozen=True)
class Tuned:
    """What `tune` found.

    Attributes
    ----------
    dt : float
        The time step.
    acceptance : float
        Mean probability of the second half of the proposals, whose steps differed still.
    state : State
        To go on from, with counts that begin anew.
    """

    dt: float
    acceptance: float
    state: State


def best_acceptance(order: int) -> float:
    """The share of accepted proposals that costs least, p/(p + 1) for order p.

    For many degrees of freedom dH is normal, its deviation s is proportional to dt^p and its mean s^2/2, and
    erfc(s/sqrt(8)) of the proposals are accepted. dt erfc(s/sqrt(8)) is largest for 0.651 at order 2, 0.796 at order 4
    and 0.856 at order 6.
    """
    return order / (order + 1)


@checked
def tune(
    system: System,
    state: State,
    dt: float,
    sampler: HamiltonianMonteCarlo,
    *,
    wanted: float | None = None,
    proposals: Proposals = 80,
) -> Tuned:
    """Find the time step for a share of accepted proposals, by proposals with steps that differ.

    They bring the state towards equilibrium too, but are no sample: a step that looks at what it did has no stationary
    density. Run with the step that was found, which stays.

    Parameters
    ----------
    system : System
    state : State
    dt : float
        To begin with.
    sampler : HamiltonianMonteCarlo
        Its number of steps stays, so that trajectories become longer or shorter with the step.
    wanted : float, optional
        Between 0 and 1; by default what costs least for the order of the stepper, see `best_acceptance`.
    proposals : int

    Raises
    ------
    InputError
        A step that is not positive, a share not between 0 and 1, fewer than 20 proposals.
    ConvergenceError
        No proposal of the second half could be made, however small the step became.
    KconsError
        As `HamiltonianMonteCarlo.step`.
    """
    search = DualAveraging(dt, best_acceptance(sampler.order) if wanted is None else wanted)
    sampler.check(system)
    known = state.thermostat if carried(state, SIZE, "HamiltonianMonteCarlo") else None
    held = np.zeros(SIZE) if known is None else known
    for _ in range(proposals):
        before = held[SUM]
        state = sampler.step(system, state, search.dt)
        held = np.asarray(state.thermostat)
        search.learn(float(held[SUM] - before))
    search.refuse_failure(system.shown_time)
    potential, held = held[POTENTIAL], np.zeros(SIZE)
    held[POTENTIAL] = potential
    return Tuned(search.result, search.acceptance, replace(state, thermostat=held))
