"""Several time steps in ASE: a cheap calculator in every small step, an expensive one in every large one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, cast

import numpy as np
from ase import Atoms, units
from ase.calculators.mixing import SumCalculator

from kcons.ase.binding import FORCES_ONLY, in_step
from kcons.ase.thermostat_dynamics import ThermostattedDynamics
from kcons.ase.topology import kinetic_energy_of
from kcons.constraints.arguments import numbers, positive, seed_from
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import State, System
from kcons.thermostats import ForceGroups, IsokineticSpheres, LangevinRespa

Bath = Literal["langevin", "spheres"]

_OF_ONE_BATH: dict[Bath, tuple[str, ...]] = {
    "langevin": ("conserve_momentum",),
    "spheres": ("spheres", "auxiliary"),
}


class MultipleTimeSteps(ThermostattedDynamics):
    """Constant temperature with the forces of a cheap calculator in small steps, of an expensive one in large ones.

    See `kcons.thermostats.LangevinRespa` and `kcons.thermostats.IsokineticSpheres`. With spheres dynamics are lost: a
    trajectory has the right configurations, and no diffusion, relaxation times or spectra.

    The atoms get the calculator of the whole energy, for logs and trajectories: `slow` with `difference`, otherwise the
    sum of both. Where the atoms are at the end of a step both have been called, so that it costs nothing.

    Parameters
    ----------
    atoms : ase.Atoms
        With momenta (`draw_velocities`).
    timestep : float
        The large step, in ASE's unit of time.
    fast, slow : ASE calculator
    fast_steps : int
        Small steps in a large one, 2 or more.
    temperature_K : float
    friction : float
        In inverse units of ASE's time, for example 0.005/units.fs; above 0 with spheres.
    bath : {'langevin', 'spheres'}
    seed : int or numpy.random.Generator, optional
        Of the noise; None takes one from the operating system. It can be read as `seed`.
    difference : bool
        `slow` is the calculator of the whole energy, and the slow forces are what it gives more than `fast`.
    spheres : {'split', 'axes', 'cluster', 'global'}
    auxiliary : int
        For spheres, see `IsokineticSpheres`.
    order : {2, 4}
        Of the small steps, with 1 or 6 calls of `fast` in each.
    substeps : int
        Flights along the constraints in each half of a small step, for order 2.
    slow_kicks : {'ends', 'middle'}
        With 'middle' the atoms are halfway between two slow kicks at the end of a step, where averages are better; what
        is logged there costs a call of `slow`.
    **kwargs
        As for `ConstrainedDynamics`; and restart, the path of a file written by `save`.

    Raises
    ------
    InputError
        One calculator given twice; calculators of other atoms; bad numbers of steps, friction or
        temperature; options of the other bath. The atoms are then as they were. While it runs: the atoms got another
        calculator.
    UnsupportedError
        Spheres with constraints that move or that hold velocities.
    """

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
        bath: Bath = "langevin",
        seed: int | np.random.Generator | None = None,
        difference: bool = False,
        **kwargs: Any,
    ) -> None:
        if bath not in ("langevin", "spheres"):
            raise InputError(f"bath is {bath!r}; choose 'langevin' or 'spheres'", item="bath")
        #: Seed of the noise.
        self.seed = seed_from(seed, "seed")
        other = _OF_ONE_BATH["langevin" if bath == "spheres" else "spheres"]
        for name in set(other) & set(kwargs):
            raise InputError(f"{name} is no option with bath={bath!r}; leave it out", item=name)
        own = "order", "substeps", "slow_kicks", *_OF_ONE_BATH[bath]
        self._options = {name: kwargs.pop(name) for name in own if name in kwargs}
        self._options["steps"] = {"slow": 1, "fast": fast_steps}
        self._bath: Bath = bath
        stepper = self._stepper(temperature_K, friction)
        self._parts = fast_steps
        if fast is slow:
            raise InputError(
                "fast and slow are the same calculator: its forces would count twice. Give two, or use "
                "ConstrainedLangevin",
                item="slow",
            )
        for name, calculator in (("fast", fast), ("slow", slow)):
            _check(name, calculator, atoms)
        self._calculators = fast, slow
        cheap, expensive = self._forces_of(fast, True), self._forces_of(slow, difference)
        if difference:
            self.groups = ForceGroups.difference(cheap, expensive)
        else:
            self.groups = ForceGroups({"fast": cheap, "slow": expensive})
        self._force = self.groups  # type: ignore[method-assign, assignment]
        before = atoms.calc
        atoms.calc = self._whole = slow if difference else SumCalculator([fast, slow])
        try:
            super().__init__(atoms, timestep, cast(Any, stepper), **kwargs)
        except BaseException:
            atoms.calc = before
            raise

    def _stepper(self, temperature_K: float, friction: float) -> LangevinRespa | IsokineticSpheres:
        kind: Callable[..., Any] = IsokineticSpheres if self._bath == "spheres" else LangevinRespa
        thermal = units.kB * positive(temperature_K, "temperature_K")
        stepper: LangevinRespa | IsokineticSpheres = kind(thermal, friction, self.seed, **self._options)
        return stepper

    def _forces_of(self, calculator: Any, others: bool) -> Callable[[FloatArray, float], FloatArray]:
        """Forces of one calculator, with those of ASE objects that only add forces where asked for."""

        def force(x: FloatArray, time: float) -> FloatArray:
            atoms = self.atoms
            atoms.arrays["positions"][...] = x
            found = np.array(numbers(calculator.get_forces(atoms), "forces of the calculator"))
            if others and found.shape == (len(atoms), 3):
                for item in atoms.constraints:
                    if isinstance(item, FORCES_ONLY):
                        item.adjust_forces(atoms, found)
            return found

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
        return float(kinetic_energy_of(self.atoms) / expected * stepper.thermal_energy / units.kB)

    def get_conserved_energy(self) -> float:
        """Total energy less the heat in eV, for Langevin dynamics.

        Raises
        ------
        UnsupportedError
            On spheres, where forces of the bath do work.
        """
        if isinstance(self.stepper, IsokineticSpheres):
            raise UnsupportedError("nothing like an energy is conserved on spheres; look at averages instead")
        return super().get_conserved_energy()

    def set_temperature(self, temperature_K: float) -> None:
        """Use another temperature from now on."""
        self.stepper = cast(Any, self._stepper(temperature_K, cast(LangevinRespa, self.stepper).friction))

    def _refresh_properties(self) -> None:
        """A step ends with both forces where the atoms are, which are added up for someone who looks."""
        if any(self.nsteps % every == 0 if every > 0 else self.nsteps == -every for _, every, *_ in self.observers):
            with in_step(self.nsteps):
                self.atoms.get_potential_energy(apply_constraint=False)
                self.atoms.get_forces(apply_constraint=False)
            self._answers.note()


def _check(name: str, calculator: Any, atoms: Atoms) -> None:
    """Refuse what is no calculator of these atoms; it is called once where they are."""
    if not hasattr(calculator, "get_forces") or isinstance(calculator, Atoms):
        raise InputError(f"{name} is {calculator!r}; give an ASE calculator", item=name)
    forces = numbers(calculator.get_forces(atoms), f"forces of {name}")
    known = getattr(calculator, "atoms", None)
    other = isinstance(known, Atoms) and not np.array_equal(known.numbers, atoms.numbers)
    if forces.shape != (len(atoms), 3) or other:
        found = f"{len(known)} atoms ({known.get_chemical_formula()})" if isinstance(known, Atoms) else "other atoms"
        raise InputError(
            f"{name} computes forces of shape {forces.shape} of {found}, not of these {len(atoms)} "
            f"({atoms.get_chemical_formula()}); fast and slow must be of the same atoms",
            item=name,
        )
