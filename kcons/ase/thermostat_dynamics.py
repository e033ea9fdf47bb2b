"""Constant temperature and pressure in ASE, each class a thermostat of the core; velocities to start from."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from inspect import signature
from typing import Any, Literal

import numpy as np
from ase import Atoms, units
from ase.calculators.calculator import PropertyNotImplementedError
from ase.calculators.mixing import SumCalculator
from numpy.typing import NDArray

from kcons.ase.binding import BY_ENERGIES, STRESSLESS, with_added
from kcons.ase.dynamics import FAR, ConstrainedDynamics
from kcons.ase.topology import require_atoms
from kcons.constraints import Constraint
from kcons.constraints.arguments import Rng, checked, generator_of, positive, refuse_other, seed_from
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, Stepper, System
from kcons.thermostats import (
    Counts,
    ForceGroups,
    HamiltonianMonteCarlo,
    Isokinetic,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    NoseHooverChain,
    thermal_velocities,
)
from kcons.thermostats.barostats import Barostat, require_barostat
from kcons.thermostats.cells import (
    BarostatBodies,
    CellSystem,
    Virial,
    find_pieces,
    instantaneous_pressure,
    refuse_virial,
)


class AtomsSystem(CellSystem):
    """Constraints, forces and energy of a dynamics object, whose atoms have the cell that changes."""

    def __init__(self, dynamics: ConstrainedDynamics, motion: Motion) -> None:
        self.atoms = dynamics.atoms
        if motion.lattice is None:
            raise InputError(
                "the atoms have no periodic cell, and a barostat nothing to change: set atoms.cell and atoms.pbc",
                item="cell",
            )
        #: Constraints of ASE add forces, which no stress knows of.
        self._stressless = dynamics._only_forces
        super().__init__(
            motion,
            lambda x, t, cell: dynamics._force(x, t),
            lambda x, t, cell: dynamics._energy(x, t),
            self._stress,
            far=FAR,
        )

    @property
    def cell(self) -> FloatArray:
        return np.array(self.atoms.cell.array)

    def set_cell(self, cell: FloatArray, positions: FloatArray) -> None:
        super().set_cell(cell, positions)
        self.atoms.cell[...] = cell
        self.atoms.arrays["positions"][...] = positions

    def _stress(self, x: FloatArray, time: float, cell: FloatArray) -> FloatArray:
        if self._stressless:
            raise UnsupportedError(STRESSLESS)
        self.atoms.arrays["positions"][...] = x
        try:
            found = self.atoms.get_stress(voigt=False, apply_constraint=False)
        except PropertyNotImplementedError as error:
            raise UnsupportedError(f"the calculator has no stress; {BY_ENERGIES}") from error
        return np.asarray(found, dtype=float)


class ThermostattedDynamics(ConstrainedDynamics):
    """What the thermostats share: temperature, barostat, and a stepper that `kind` makes for a kT in eV.

    It gets the keywords that it knows; what became of `rng` is in `seed`.
    """

    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        temperature_K: float | None,
        kind: Callable[..., Stepper],
        *,
        barostat: Barostat | None = None,
        **kwargs: Any,
    ) -> None:
        known = signature(kind).parameters
        options = {name: kwargs.pop(name) for name in known if name in kwargs}
        if "rng" in known:
            options["rng"] = self.seed = seed_from(options.get("rng"))
        self._make = partial(kind, **options)
        if barostat is not None:
            require_barostat(barostat)
        self.barostat = barostat
        stepper = self._make(None if temperature_K is None else _thermal(temperature_K))
        super().__init__(atoms, timestep, stepper, **kwargs)

    def set_temperature(self, temperature_K: float) -> None:
        """Use another temperature from now on; what a thermostat knows beside it goes on.

        The isokinetic thermostat scales the momenta.
        """
        self.stepper = self._make(_thermal(temperature_K))

    def _begin(self) -> None:
        """Start the thermostat, so that atoms have the kinetic energy it keeps before the first step is logged."""
        if self.barostat is not None and self._state is not None:
            self.barostat.variables_of(self._state)  # before anything is changed by a state of another one
        if not isinstance(self.stepper, Isokinetic | NoseHooverChain):
            return
        state = self._start(self._systems())
        try:
            begun = self.stepper.start(self._systems(), state)
        finally:  # forces were asked for elsewhere too
            self.atoms.arrays["positions"][...] = state.positions
        if begun.velocities is not state.velocities:
            begun = replace(begun, velocities=self._put(state.positions, begun.velocities))
        self._state = begun

    def _made(self, motion: Motion) -> System:
        if self.barostat is None:
            return super()._made(motion)
        system = AtomsSystem(self, motion)
        self.barostat.pieces(system, self.atoms.arrays["positions"], self.time)
        return system

    @property
    def thermostat_degrees_of_freedom(self) -> int:
        """g: 3 N less the rank of the rows and less the components of total momentum that are left alone."""
        if isinstance(self.stepper, Isokinetic | NoseHooverChain):
            return int(self._variables()[-1])
        return self.degrees_of_freedom

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
        """The quantity in eV that the exact motion conserves, where targets rest; see the thermostat in the core.

        Raises
        ------
        UnsupportedError
            On spheres, whose bath does work, and of Monte Carlo.
        """
        conserved = getattr(self._mover, "conserved_energy", None)
        if conserved is None:
            raise UnsupportedError(
                f"{type(self.stepper).__name__} conserves nothing like an energy; look at averages, or at "
                "counts.mean_square of Monte Carlo, that of the change of energy over kT"
            )
        system = self._systems()
        return float(conserved(system, self._start(system)))


class IsokineticDynamics(ThermostattedDynamics):
    """Constant kinetic energy; configurations are canonical at `temperature_K`.

    See `kcons.thermostats.Isokinetic`. At the start momenta are scaled to the kinetic energy that belongs to the
    temperature, 2K = (g - 1) kT. ASE's own temperature, 2K/(g' k) by the g' that it counts, reads a little less;
    `get_temperature` of this object reads T.

    Parameters
    ----------
    atoms, timestep, **kwargs
        As for `ConstrainedLangevin`; atoms with momenta (`draw_velocities(..., zero_momentum=True)`).
    temperature_K : float, optional
        None keeps the kinetic energy that the atoms have.
    order : {2, 4, 6}
        1, 6 and 10 force evaluations a step.
    momentum : {'auto', 'conserved', 'free'}
        Whether total momentum is conserved, and takes degrees of freedom. 'auto' asks the calculator for forces at
        one to three shifted places at the start; with forces that add up to nothing only roughly (plane waves, particle
        mesh), say which.

    Raises
    ------
    OverdeterminedError
        g is 1.
    """

    def __init__(self, atoms: Atoms, timestep: float, temperature_K: float | None = None, **kwargs: Any) -> None:
        super().__init__(atoms, timestep, temperature_K, Isokinetic, **kwargs)

    def set_temperature(self, temperature_K: float) -> None:
        super().set_temperature(temperature_K)
        self._state = replace(self._start(self._systems()), thermostat=None)
        self._begin()

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
    atoms, timestep, temperature_K, **kwargs
        As for `ConstrainedDynamics`, and `barostat` (of `kcons.thermostats`), for which atoms need a periodic cell.
    friction : float
        In inverse units of ASE's time, for example 0.01/units.fs.
    rng : int, numpy.random.Generator or None
        A seed, or what one is drawn from, which `seed` then tells; None takes it from the operating system. A run
        continued from a trajectory needs another; with `state` the noise goes on.
    substeps : int
        Flights along the constraints in each half of the step; more for fast rotations and large steps.
    """

    def __init__(self, atoms: Atoms, timestep: float, temperature_K: float, friction: float, **kwargs: Any) -> None:
        super().__init__(atoms, timestep, temperature_K, Langevin, friction=friction, **kwargs)


class ConstrainedNoseHoover(ThermostattedDynamics):
    """A Nose-Hoover chain on the constraints: canonical without noise.

    See `kcons.thermostats.NoseHooverChain`. ASE's own chain goes past constraints. Not for targets that move.

    Parameters
    ----------
    atoms, timestep, temperature_K, **kwargs
        As for `ConstrainedLangevin`; atoms with momenta (`draw_velocities(..., zero_momentum=True)`). The time step may
        be negative.
    tdamp : float
        Time constant of the chain in ASE's unit of time, as for `ase.md.nose_hoover_chain`: masses are kT tdamp^2.
        About a hundred time steps.
    tchain : int
        Links of the chain.
    momentum : {'auto', 'conserved', 'free'}
        As for `IsokineticDynamics`.
    """

    def __init__(
        self, atoms: Atoms, timestep: float, temperature_K: float, tdamp: float, *, tchain: int = 3, **kwargs: Any
    ) -> None:
        period = 2 * math.pi * positive(tdamp, "tdamp")
        super().__init__(atoms, timestep, temperature_K, NoseHooverChain, period=period, length=tchain, **kwargs)


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
    atoms, timestep, temperature_K, rng, **kwargs
        As for `ConstrainedLangevin`; forces of the calculator are the gradient of its energy.
    steps : int or (int, int)
        Time steps of a proposal; with two numbers drawn between them.
    stepper : Stepper, optional
        A reversible and symplectic one: `Rattle` by default; for many atoms `BlanesMoan4`.
    keep : float
        The part of the velocities that a proposal keeps, from 0 to less than 1.
    tolerance : float
        Largest difference of a time step taken back.
    """

    def __init__(
        self, atoms: Atoms, timestep: float, temperature_K: float, steps: int | tuple[int, int], **kwargs: Any
    ) -> None:
        super().__init__(atoms, timestep, temperature_K, HamiltonianMonteCarlo, steps=steps, **kwargs)

    @property
    def counts(self) -> Counts:
        """What became of the proposals."""
        return Counts.of(self._start(self._systems()))


class MultipleTimeSteps(ThermostattedDynamics):
    """Constant temperature with the forces of a cheap calculator in small steps, of an expensive one in large ones.

    See `kcons.thermostats.LangevinRespa` and `kcons.thermostats.IsokineticSpheres`. With spheres dynamics are lost: a
    trajectory has the right configurations, and no diffusion, relaxation times or spectra.

    The atoms get the calculator of the whole energy, for logs and trajectories: `slow` with `difference`, otherwise the
    sum of both. Where the atoms are at the end of a step both have been called, so that it costs nothing.

    Parameters
    ----------
    atoms, timestep, temperature_K, rng, **kwargs
        As for `ConstrainedLangevin`; the time step is the large one.
    fast, slow : ASE calculator
    fast_steps : int
        Small steps in a large one, 2 or more.
    friction : float
        In inverse units of ASE's time, for example 0.005/units.fs; above 0 with spheres.
    bath : {'langevin', 'spheres'}
    difference : bool
        `slow` is the calculator of the whole energy, and the slow forces are what it gives more than `fast`.
    spheres : {'split', 'axes', 'cluster', 'global'}
    auxiliary : int
        For spheres, see `IsokineticSpheres`.
    substeps : int
        Flights along the constraints in each half of a small step.
    slow_kicks : {'ends', 'middle'}
        With 'middle' the atoms are halfway between two slow kicks at the end of a step, where averages are better; what
        is logged there costs a call of `slow`.

    Raises
    ------
    InputError
        One calculator given twice. While it runs: the atoms got another calculator.
    """

    @checked
    def __init__(
        self,
        atoms: Atoms,
        timestep: float,
        *,
        fast: Any,
        slow: Any,
        temperature_K: float,
        friction: float,
        fast_steps: int,
        bath: Literal["langevin", "spheres"] = "langevin",
        difference: bool = False,
        **kwargs: Any,
    ) -> None:
        require_atoms(atoms)
        if fast is slow:
            said = "fast and slow are the same calculator: its forces would count twice; give two"
            raise InputError(said, item="slow")
        for name, calculator in (("fast", fast), ("slow", slow)):
            if not hasattr(calculator, "get_forces") or isinstance(calculator, Atoms):
                raise InputError(f"{name} is {calculator!r:.80}; give an ASE calculator", item=name)
        self._calculators, self._longest = (fast, slow), np.inf
        forces = {"fast": self._forces_of(fast, True), "slow": self._forces_of(slow, difference)}
        self.groups = ForceGroups.difference(*forces.values()) if difference else ForceGroups(forces)
        self._force = self.groups  # type: ignore[method-assign, assignment]
        kind = IsokineticSpheres if bath == "spheres" else LangevinRespa
        steps = {"slow": 1, "fast": fast_steps}
        before = atoms.calc
        atoms.calc = self._whole = slow if difference else SumCalculator([fast, slow])
        try:
            super().__init__(atoms, timestep, temperature_K, kind, friction=friction, steps=steps, **kwargs)
        except BaseException:
            atoms.calc = before
            raise

    def _forces_of(self, calculator: Any, others: bool) -> Callable[[FloatArray, float], FloatArray]:
        """Forces of one calculator, with those of ASE objects that only add forces where asked for."""

        def force(x: FloatArray, time: float) -> FloatArray:
            self.atoms.arrays["positions"][...] = x
            return with_added(self.atoms, calculator.get_forces(self.atoms), None if others else ())

        return force

    def _start(self, system: System) -> State:
        if self.atoms.calc is not self._whole:
            raise InputError(
                f"the atoms got another calculator, {self.atoms.calc!r:.80}, while forces are those of fast and slow; "
                "make another MultipleTimeSteps with it",
                item="calculator",
            )
        return super()._start(system)

    def _begin(self) -> None:
        """Find the spheres, so that what cannot be is refused before the first step."""
        super()._begin()
        if isinstance(self.stepper, IsokineticSpheres):
            self.stepper.radii(self._systems(), self.atoms.positions)

    # -- what can be read -----------------------------------------------------------------------

    @property
    def evaluations(self) -> dict[str, int]:
        """Calls of the fast and of the slow forces so far."""
        return dict(self.groups.evaluations)

    def get_temperature(self) -> float:
        """Kinetic temperature in K; on spheres by the kinetic energy that is expected there, which says little."""
        stepper = self.stepper
        if not isinstance(stepper, IsokineticSpheres):
            return super().get_temperature()
        expected = stepper.kinetic_energy(self._systems(), self.atoms.positions)
        return float(self.atoms.get_kinetic_energy() / expected * stepper.thermal_energy / units.kB)


def draw_velocities(
    atoms: Atoms,
    temperature_K: float,
    rng: Rng = None,
    *,
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
    rng : int, numpy.random.Generator or None
    zero_momentum : bool
        Take total momentum out, in the directions in which no constraint knows a place in space.
    constraints : sequence of Constraint, optional
        What is held besides the constraints on the atoms, as for `ConstrainedDynamics`.

    Raises
    ------
    InputError
        Atoms off their constraints.
    UnsupportedError
        `zero_momentum` where atoms are held in space.
    """
    require_atoms(atoms)
    thermal, rng = _thermal(temperature_K), generator_of(rng)
    momenta = atoms.get_momenta()
    try:
        atoms.set_momenta(np.zeros_like(momenta), apply_constraint=False)
        held = ConstrainedDynamics(atoms, 0.0, constraints=constraints)
        v = thermal_velocities(held._systems(), atoms.positions, thermal, rng, zero_momentum=zero_momentum)
        momenta = v * held._masses
    finally:
        atoms.set_momenta(momenta, apply_constraint=False)


def _thermal(temperature_K: float) -> float:
    """kT in eV."""
    return units.kB * positive(temperature_K, "temperature_K")


class PressureReporter:
    """Pressure and volume of a run; attach it: ``dynamics.attach(reporter, interval=10)``.

    Parameters
    ----------
    dynamics : ConstrainedDynamics
        Or any of the thermostats. It needs no barostat.
    virial : {'molecular', 'atomic', 'difference'}
        See `kcons.thermostats.instantaneous_pressure`; 'difference' is for calculators without stress.
    temperature_K : float, optional
        For N kT/V instead of the present kinetic energy of pieces.

    Attributes
    ----------
    values : list of ndarray, shape (3, 3)
        Pressure tensors in eV/A^3.
    volumes : list of float
    """

    def __init__(
        self,
        dynamics: ConstrainedDynamics,
        *,
        virial: Virial = "molecular",
        temperature_K: float | None = None,
    ) -> None:
        refuse_virial(virial, temperature_K)
        refuse_other(dynamics, ConstrainedDynamics, "dynamics", "a dynamics object of kcons.ase")
        self.dynamics, self.virial = dynamics, virial
        self.thermal = None if temperature_K is None else units.kB * positive(temperature_K, "temperature_K")
        self._known: tuple[Any, AtomsSystem, BarostatBodies | None] | None = None
        self.values: list[FloatArray] = []
        self.volumes: list[float] = []

    def __call__(self) -> None:
        dynamics, atoms = self.dynamics, self.dynamics.atoms
        system, pieces = self._system()
        state = dynamics.state.copied()
        found = instantaneous_pressure(system, state, self.virial, pieces=pieces, thermal_energy=self.thermal)
        self.values.append(found)
        self.volumes.append(float(atoms.get_volume()))

    @property
    def mean(self) -> float:
        """Of the pressure, in eV/A^3, along the axes that a barostat changes."""
        return float(np.mean([np.diagonal(value)[self._axes] for value in self.values]))

    @property
    def _axes(self) -> NDArray[np.bool_]:
        barostat = self.dynamics.barostat
        return np.ones(3, dtype=bool) if barostat is None else barostat.strains.axes

    def _system(self) -> tuple[AtomsSystem, BarostatBodies | None]:
        dynamics, motion = self.dynamics, self.dynamics.motion
        if self._known is None or self._known[0] is not motion:
            system = AtomsSystem(dynamics, motion)
            x, barostat, pieces = dynamics.atoms.arrays["positions"], dynamics.barostat, None
            if self.virial != "atomic" and barostat is None:
                pieces = find_pieces(system, x, self._axes, None, "refuse", dynamics.time)
            elif self.virial != "atomic" and barostat is not None:
                pieces = barostat.pieces(dynamics._systems(), x, dynamics.time)  # type: ignore[arg-type]
            self._known = motion, system, pieces
        return self._known[1:]
