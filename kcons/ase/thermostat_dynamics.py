"""Constant temperature with constraints in ASE: isokinetic, Langevin, Nose-Hoover, and velocities to start from."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from typing import Any, cast

import numpy as np
from ase import Atoms, units
from numpy.typing import ArrayLike

from kcons.ase.dynamics import FAR, ConstrainedDynamics, put
from kcons.ase.pressure.atoms_system import AtomsSystem
from kcons.ase.topology import require_atoms
from kcons.constraints import Constraint
from kcons.constraints.arguments import generator_of, positive, seed_from
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, Stepper, System
from kcons.thermostats import HamiltonianMonteCarlo, Isokinetic, Langevin, NoseHooverChain, thermal_velocities
from kcons.thermostats.freedom import Momentum, open_directions
from kcons.thermostats.isokinetic.isokinetic import Convention
from kcons.thermostats.pressure import Barostat, ConstantPressure, require_barostat


class ThermostattedDynamics(ConstrainedDynamics):
    """What the thermostats share: `save` and `restart`, and the temperature by the degrees of freedom they act on.

    Parameters
    ----------
    atoms, timestep
        As for `ConstrainedDynamics`.
    stepper : Isokinetic, Langevin, NoseHooverChain or HamiltonianMonteCarlo
    restart : path, optional
        File written by `save`.
    **kwargs
        As for `ConstrainedDynamics`.
    """

    #: Of the thermostat, beside the temperature.
    _options: dict[str, Any]

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        stepper: Isokinetic | Langevin | NoseHooverChain | HamiltonianMonteCarlo,
        *,
        restart: str | PathLike[str] | None = None,
        barostat: Barostat | None = None,
        **kwargs: Any,
    ) -> None:
        require_atoms(atoms)
        self.barostat = None if barostat is None else require_barostat(barostat)
        if restart is not None:
            if "state" in kwargs:
                raise InputError("give restart or state, not both", item="restart")
            kwargs["state"] = _read(restart, len(atoms))
        super().__init__(atoms, timestep, stepper, **kwargs)

    def _begin(self) -> None:
        """Start the thermostat, so that atoms have the kinetic energy it keeps before the first step is logged."""
        if self.barostat is not None and self._state is not None:
            self.barostat.variables_of(self._state)  # before anything is changed by a state of another one
        if not isinstance(self.stepper, Isokinetic | NoseHooverChain):
            return
        state = self._start(self._systems())
        arrays = self.atoms.arrays
        momenta = arrays["momenta"].copy()
        try:
            begun = self.stepper.start(self._systems(), state)
        finally:  # forces were asked for elsewhere too
            arrays["positions"][...], arrays["momenta"][...] = state.positions, momenta
        if begun.velocities is not state.velocities:
            momenta, v = put(self.atoms, self._weights, state.positions, begun.velocities)
            begun = replace(begun, velocities=v)
        self._momenta, self._state = momenta, begun

    @property
    def _mover(self) -> Stepper:
        return self.stepper if self.barostat is None else ConstantPressure(self.stepper, self.barostat)

    def _made(self, motion: Motion) -> System:
        if self.barostat is None:
            return super()._made(motion)
        if np.any(self._friction):
            raise UnsupportedError("friction takes out heat beside the thermostat; leave it out")
        system = AtomsSystem(motion, self._force, self._energy, self.atoms, stressless=self._only_forces, far=FAR)
        self.barostat.pieces(system, self.atoms.arrays["positions"], self.time)
        return system

    def save(self, file: str | PathLike[str]) -> None:
        """Write the state, all it takes to continue to the last bit with `restart=file` (see `State.save`).

        A trajectory holds positions and momenta only: the isokinetic thermostat continues from it as well, Langevin
        with another seed, a Nose-Hoover chain from rest.
        """
        self.state.save(file)

    def _thermostat_after_change(self, last: State | None) -> FloatArray | None:
        return None if last is None else last.thermostat

    @property
    def thermostat_degrees_of_freedom(self) -> int:
        """g: 3 N less the rank of the rows and less the components of total momentum that are left alone."""
        if isinstance(self.stepper, Isokinetic | NoseHooverChain):
            return int(self._variables()[-1])
        count = self.degrees_of_freedom
        if getattr(self.stepper, "conserve_momentum", False):
            count -= len(open_directions(self._systems().motion, self.atoms.positions, self.time))
        return count

    def _variables(self) -> FloatArray:
        """Those of the thermostat, which begins anew where masses or constraints have changed."""
        self._systems()
        if self._state is None or self._state.thermostat is None:
            self._begin()
        assert self._state is not None and self._state.thermostat is not None
        return self._state.thermostat

    def get_temperature(self) -> float:
        """Kinetic temperature in K by the degrees of freedom that the thermostat acts on."""
        count = self.thermostat_degrees_of_freedom
        return 2 * self.get_kinetic_energy() / (count * units.kB) if count else 0.0

    def get_conserved_energy(self) -> float:
        """The quantity in eV that the exact motion conserves, where targets rest; see the thermostat in the core."""
        stepper = cast(Isokinetic | Langevin | NoseHooverChain | ConstantPressure, self._mover)
        system = self._systems()
        return float(stepper.conserved_energy(system, self._start(system)))


class IsokineticDynamics(ThermostattedDynamics):
    """Constant kinetic energy; configurations are canonical at `temperature_K`.

    See `kcons.thermostats.Isokinetic`. At the start momenta are scaled to the kinetic energy that belongs to the
    temperature, 2K = (g - 1) kT. ASE's own temperature, 2K/(g' k) by the g' that it counts, reads a little less;
    `get_temperature` of this object reads T.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator and with momenta; draw them with `draw_velocities(..., zero_momentum=True)`.
    timestep : float
        In ASE's unit of time.
    temperature_K : float, optional
        None keeps the kinetic energy that the atoms have.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    convention : {'exact', 'notes'}
        2K = (g - 1) kT, or 3 N kT.
    indices : array_like of int or bool, optional
        Thermostat these atoms only. No constraint may couple them to others.
    momentum : {'auto', 'conserved', 'free'}
        Whether total momentum is conserved, and takes degrees of freedom. 'auto' asks the calculator for forces at
        one to three shifted places at the start; with forces that add up to nothing only roughly (plane waves, particle
        mesh), say which.
    **kwargs
        As for `ConstrainedDynamics`; and restart, the path of a file written by `save`.

    Raises
    ------
    InputError
        Temperature not positive, all momenta zero.
    OverdeterminedError
        g is 1.
    UnsupportedError
        A constraint couples `indices` to other atoms.
    """

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        temperature_K: float | None = None,
        *,
        order: int = 2,
        convention: Convention = "exact",
        indices: ArrayLike | None = None,
        momentum: Momentum = "auto",
        **kwargs: Any,
    ) -> None:
        self._options = {"order": order, "convention": convention, "atoms": indices, "momentum": momentum}
        super().__init__(atoms, timestep, self._stepper(temperature_K), **kwargs)

    def _stepper(self, temperature_K: float | None) -> Isokinetic:
        thermal = None if temperature_K is None else units.kB * positive(temperature_K, "temperature_K")
        return Isokinetic(thermal, **self._options)

    def set_temperature(self, temperature_K: float) -> None:
        """Keep another temperature from now on; momenta are scaled."""
        self.stepper = self._stepper(positive(temperature_K, "temperature_K"))
        self._state = replace(self._start(self._systems()), thermostat=None)
        self._begin()

    def _thermostat_after_change(self, last: State | None) -> FloatArray | None:
        return None

    def get_temperature(self) -> float:
        """Temperature in K of the configurations, 2K/((g - 1) k)."""
        twice, _, _, count = self._variables()
        return float(twice / ((count - 1) * units.kB))


class ConstrainedLangevin(ThermostattedDynamics):
    """Langevin dynamics on the constraints, whatever they are: geodesic BAOAB.

    See `kcons.thermostats.Langevin`. Noise is a function of the seed and of the number of the step.

    `get_kinetic_energy`, `get_temperature` and the log are of the middle of the last step, after noise: there
    velocities are as warm as the bath. Those that atoms have at the end of a step are colder along stiff motions.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator.
    timestep : float
        In ASE's unit of time.
    temperature_K : float
    friction : float
        In inverse units of ASE's time, for example 0.01/units.fs.
    rng : int or numpy.random.Generator, optional
        A seed, or a generator from which one is drawn; None takes one from the operating system. It can be read as
        `seed`. A run continued from a trajectory needs another seed; with `restart` the noise goes on.
    fixcm : bool
        Friction and noise leave total momentum alone, which then takes degrees of freedom.
    substeps : int
        Flights along the constraints in each half of the step; more for fast rotations and large steps.
    **kwargs
        As for `ConstrainedDynamics`; and restart, the path of a file written by `save`.

    Raises
    ------
    InputError
        Temperature not positive, friction negative, a negative time step.
    """

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        temperature_K: float,
        friction: float,
        *,
        rng: int | np.random.Generator | None = None,
        fixcm: bool = False,
        substeps: int = 3,
        **kwargs: Any,
    ) -> None:
        #: Seed of the noise.
        self.seed = seed_from(rng)
        self._options = {"substeps": substeps, "conserve_momentum": fixcm}
        stepper = self._stepper(temperature_K, friction)
        super().__init__(atoms, timestep, stepper, **kwargs)

    def _stepper(self, temperature_K: float, friction: float) -> Langevin:
        return Langevin(units.kB * positive(temperature_K, "temperature_K"), friction, self.seed, **self._options)

    def set_temperature(self, temperature_K: float) -> None:
        """Use another temperature from now on."""
        self.stepper = self._stepper(temperature_K, cast(Langevin, self.stepper).friction)


class ConstrainedNoseHoover(ThermostattedDynamics):
    """A Nose-Hoover chain on the constraints: canonical without noise.

    See `kcons.thermostats.NoseHooverChain`. ASE's own chain goes past constraints. Not for targets that move.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator and with momenta (`draw_velocities(..., zero_momentum=True)`).
    timestep : float
        In ASE's unit of time; may be negative.
    temperature_K : float
    tdamp : float
        Time constant of the chain in ASE's unit of time, as for `ase.md.nose_hoover_chain`: masses are kT tdamp^2.
        About a hundred time steps.
    tchain : int
        Links of the chain.
    momentum : {'auto', 'conserved', 'free'}
        As for `IsokineticDynamics`.
    **kwargs
        As for `ConstrainedDynamics`; and restart, the path of a file written by `save`.

    Raises
    ------
    InputError
        Temperature or time constant not positive.
    UnsupportedError
        Targets that move.
    """

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        temperature_K: float,
        tdamp: float,
        *,
        tchain: int = 3,
        momentum: Momentum = "auto",
        **kwargs: Any,
    ) -> None:
        self._options = {"period": 2 * math.pi * positive(tdamp, "tdamp"), "length": tchain, "momentum": momentum}
        super().__init__(atoms, timestep, self._stepper(temperature_K), **kwargs)

    def _stepper(self, temperature_K: float) -> NoseHooverChain:
        return NoseHooverChain(units.kB * positive(temperature_K, "temperature_K"), **self._options)

    def _thermostat_after_change(self, last: State | None) -> FloatArray | None:
        # A copy, at which the chain sees that momenta may be new.
        return None if last is None or last.thermostat is None else last.thermostat.copy()

    def set_temperature(self, temperature_K: float) -> None:
        """Use another temperature from now on; the chain goes on."""
        self.stepper = self._stepper(temperature_K)


def draw_velocities(
    atoms: Atoms,
    temperature_K: float,
    rng: np.random.Generator | int | None = None,
    *,
    exact: bool = False,
    zero_momentum: bool = False,
    constraints: Constraint | Iterable[Constraint] = (),
) -> None:
    """Set momenta drawn from the canonical distribution on the constraints.

    Those of Maxwell and Boltzmann, projected in the mass metric (`kcons.thermostats.thermal_velocities`): the mean
    kinetic energy is g kT/2, equipartitioned, for the g degrees of freedom that are left.

    Parameters
    ----------
    atoms : ase.Atoms
        On their constraints.
    temperature_K : float
    rng : numpy.random.Generator or int, optional
        A generator, or a seed for one; None takes a seed from the operating system.
    exact : bool
        Scale to 2K = g kT exactly.
    zero_momentum : bool
        Take total momentum out, in the directions in which no constraint knows a place in space.
    constraints : sequence of Constraint, optional
        What is held besides the constraints on the atoms, as for `ConstrainedDynamics`.

    Raises
    ------
    InputError
        Temperature not positive; atoms off their constraints.
    UnsupportedError
        `zero_momentum` where atoms are held in space.
    """
    require_atoms(atoms)
    thermal = units.kB * positive(temperature_K, "temperature_K")
    momenta = atoms.get_momenta()
    try:
        atoms.set_momenta(np.zeros_like(momenta), apply_constraint=False)
        held = ConstrainedDynamics(atoms, 0.0, constraints=constraints)
        system = held._systems()
        wanted = None
        if exact:
            count = held.degrees_of_freedom
            if zero_momentum:
                count -= len(open_directions(system.motion, atoms.positions))
            wanted = 0.5 * count * thermal or None
        v = thermal_velocities(
            system,
            atoms.positions,
            thermal,
            generator_of(rng),
            zero_momentum=zero_momentum,
            kinetic_energy=wanted,
        )
        momenta = v * held._weights[0]
    finally:
        atoms.set_momenta(momenta, apply_constraint=False)


def _read(file: str | PathLike[str], n_atoms: int) -> State:
    try:
        state = State.load(file)
    except FileNotFoundError:
        raise
    except InputError as error:
        raise InputError(f"{file} was not written by save: {error}", item="restart") from error
    if state.positions.shape != (n_atoms, 3):
        raise InputError(f"{file} holds {len(state.positions)} atoms, not {n_atoms}", item="restart")
    return state
