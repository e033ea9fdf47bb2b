"""Hamiltonian Monte Carlo of constrained atoms: averages without any error of the time step."""

from __future__ import annotations

import math
from typing import Any, NoReturn, cast

import numpy as np
from ase import Atoms, units

from kcons.ase.thermostat_dynamics import ThermostattedDynamics
from kcons.constraints.arguments import positive, seed_from
from kcons.constraints.target import FloatArray
from kcons.errors import UnsupportedError
from kcons.steppers import State, Stepper
from kcons.thermostats import Counts, HamiltonianMonteCarlo, Tuned, tune
from kcons.thermostats.monte_carlo.hamiltonian_monte_carlo import POTENTIAL


class ConstrainedMonteCarlo(ThermostattedDynamics):
    """Hamiltonian Monte Carlo on the constraints, whatever they are.

    Each step of this object is a proposal: `steps` time steps of a reversible stepper from new velocities, accepted or
    rejected by the change of energy, with each time step taken back to see that it can be. Averages over the steps have
    no error of the time step. See `kcons.thermostats.HamiltonianMonteCarlo`. The time is that of all trajectories,
    rejected ones too.

    After a rejection the atoms are where they were before, with opposite momenta; a log or trajectory then asks the
    calculator for their energy again.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator whose forces are the gradient of its energy.
    timestep : float
        In ASE's unit of time; `tune` finds one.
    temperature_K : float
    steps : int or (int, int)
        Time steps of a proposal; with two numbers drawn between them.
    stepper : Stepper, optional
        A reversible and symplectic one: `Rattle` by default; for many atoms `BlanesMoan4`.
    keep : float
        The part of the velocities that a proposal keeps, from 0 to less than 1.
    rng : int or numpy.random.Generator, optional
        A seed, or a generator from which one is drawn; None takes one from the operating system. It can be read as
        `seed`. A run continued from a trajectory needs another seed; with `restart` the random numbers go on.
    fixcm : bool
        Total momentum stays as it is, and takes degrees of freedom.
    tolerance : float
        Largest difference of a time step taken back.
    **kwargs
        As for `ConstrainedDynamics`; and restart, the path of a file written by `save`.

    Raises
    ------
    InputError
        Temperature not positive, fewer than one step, `keep` out of range, a negative time step.
    UnsupportedError
        A stepper that is not reversible and symplectic; targets that move, rows that hold velocities, friction.
    """

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        temperature_K: float,
        steps: int | tuple[int, int],
        *,
        stepper: Stepper | None = None,
        keep: float = 0.0,
        rng: int | np.random.Generator | None = None,
        fixcm: bool = False,
        tolerance: float = 1e-9,
        **kwargs: Any,
    ) -> None:
        #: Seed of the random numbers.
        self.seed = seed_from(rng)
        self._options = {"stepper": stepper, "keep": keep, "conserve_momentum": fixcm, "tolerance": tolerance}
        self._steps = steps
        super().__init__(atoms, timestep, self._sampler(temperature_K), **kwargs)

    def _sampler(self, temperature_K: float) -> HamiltonianMonteCarlo:
        thermal = units.kB * positive(temperature_K, "temperature_K")
        return HamiltonianMonteCarlo(thermal, self._steps, self.seed, **self._options)

    def set_temperature(self, temperature_K: float) -> None:
        """Use another temperature from now on."""
        self.stepper = self._sampler(temperature_K)

    @property
    def counts(self) -> Counts:
        """What became of the proposals."""
        return Counts.of(self._start(self._systems()))

    def tune(self, wanted: float | None = None, proposals: int = 80) -> Tuned:
        """Find the time step for a wanted share of accepted proposals, and use it from now on.

        The proposals that it takes are no sample, and are not counted; see `kcons.thermostats.tune`.

        Parameters
        ----------
        wanted : float, optional
            Between 0 and 1; by default what costs least for the order of the stepper.
        proposals : int
        """
        system = self._systems()
        state = self._start(system)
        try:
            found = tune(
                system,
                state,
                self.dt,
                cast(HamiltonianMonteCarlo, self.stepper),
                wanted=wanted,
                proposals=proposals,
            )
        except BaseException:
            self.atoms.arrays["positions"][...], self.atoms.arrays["momenta"][...] = state.positions, self._momenta
            raise
        self.dt = found.dt
        self._resume(found.state)
        return found

    def _thermostat_after_change(self, last: State | None) -> FloatArray | None:
        if last is None or last.thermostat is None:
            return None
        held = last.thermostat.copy()
        held[POTENTIAL] = math.nan  # to be asked for again
        return held

    def get_conserved_energy(self) -> NoReturn:
        """Nothing is conserved.

        Raises
        ------
        UnsupportedError
            Always.
        """
        raise UnsupportedError(
            "Monte Carlo conserves no energy; look at counts.mean_square, that of its change over kT"
        )
