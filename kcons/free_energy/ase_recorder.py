"""Held coordinates recorded in ASE's dynamics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from ase.calculators.calculator import all_properties
from ase.md.md import MolecularDynamics

from kcons.ase import ConstrainedDynamics, Constraints, IsokineticDynamics
from kcons.ase.binding import applied_forces
from kcons.ase.topology import bonds_of, velocities_of
from kcons.constraints import Constraint, Dihedral
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.held_coordinates import HeldCoordinates, Sample, named
from kcons.free_energy.series import Series
from kcons.motion.motion import Motion
from kcons.thermostats import IsokineticSpheres

#: Names in `Atoms.info` that files have for something else.
_TAKEN = {*all_properties, "Lattice", "Properties", "pbc"}


class AseRecorder:
    """An observer of ASE's dynamics that keeps a `Series`, and shows the last sample on the atoms.

    Attach it before whatever writes the trajectory, at the same interval. ``atoms.info`` then has each coordinate by
    its name, ``"multiplier of <name>"`` and ``"ln det Z"``, which trajectories and extended XYZ files keep.

    Parameters
    ----------
    dynamics : MolecularDynamics
        Of kcons, or another one of ASE whose atoms carry a `kcons.ase.Constraints`. Times are in ASE's unit,
        multipliers in eV by the unit of the coordinate.
    coordinates : mapping of str to Constraint
        As for `HeldCoordinates`.
    constraint_forces : bool
        Whether ``atoms.arrays["constraint_forces"]`` (eV/angstrom) is written too. Takes a solve of all rows.

    Attributes
    ----------
    series : Series

    Raises
    ------
    InputError
        The atoms carry no constraints of kcons, or do not hold a coordinate; a name that files cannot keep.
    UnsupportedError
        At a sample: velocities on isokinetic spheres, where the multipliers need thermal ones.

    Examples
    --------
    ``dynamics.attach(AseRecorder(dynamics, {"torsion": torsion}), interval=10)``
    """

    def __init__(
        self,
        dynamics: MolecularDynamics,
        coordinates: Mapping[str, Constraint],
        *,
        constraint_forces: bool = False,
    ) -> None:
        self.dynamics = dynamics
        self.coordinates = named(coordinates)
        for name in self.coordinates:
            if "=" in name or name in _TAKEN:
                raise InputError(
                    f"a coordinate is called {name!r}, which extended XYZ files cannot keep; give it another name",
                    item=name,
                )
        self.constraint_forces = constraint_forces
        self._motion = self._engine()
        self._held = self._coordinates_of(self._motion)
        self.series = Series(self._held.names, self._held.periods)
        self.last: Sample | None = None

    def _engine(self) -> Motion:
        if isinstance(self.dynamics, ConstrainedDynamics):
            return self.dynamics.motion
        atoms = self.dynamics.atoms
        found = [item for item in atoms.constraints if isinstance(item, Constraints)]
        if len(found) != 1:
            raise InputError(
                f"the atoms carry {len(found) or 'no'} kcons.ase.Constraints objects; a coordinate is held by one "
                "(kcons.ase.constrain), or by a dynamics class of kcons",
                item="dynamics",
            )
        return found[0].engine(atoms)

    def _coordinates_of(self, motion: Motion) -> HeldCoordinates:
        atoms, time = self.dynamics.atoms, self.dynamics.get_time()
        turns = any(isinstance(item, Dihedral) for item in self.coordinates.values())
        bonds = bonds_of(atoms) if turns else None
        return HeldCoordinates(motion, self.coordinates, atoms.positions, time=time, bonds=bonds)

    def __call__(self) -> None:
        atoms, time = self.dynamics.atoms, self.dynamics.get_time()
        motion = self._engine()
        if motion is not self._motion:  # masses, constraints or periodicity were changed
            self._held = self._coordinates_of(motion)
            self._motion = motion
        forces = None
        if isinstance(self.dynamics, ConstrainedDynamics):
            forces = self.dynamics.state.forces
        if forces is None:
            forces = applied_forces(atoms)
        if isinstance(self.dynamics, IsokineticDynamics):  # known once it runs
            self.series.isokinetic_degrees_of_freedom = self.dynamics.thermostat_degrees_of_freedom
        x, v = atoms.positions, velocities_of(atoms)
        sample = self._held.sample(x, v, forces, time)
        spheres = isinstance(getattr(self.dynamics, "stepper", None), IsokineticSpheres)
        if spheres and not np.isfinite(sample.mean_kinetic).all():
            raise UnsupportedError(
                f"velocities on isokinetic spheres are not thermal, and multipliers of {', '.join(self._held.names)} "
                "need them: their mean is found without only for up to 60 rows at rest. Take bath='langevin'"
            )
        self.last = sample
        self.series.append(sample)
        for k, name in enumerate(self._held.names):
            atoms.info[name] = float(sample.value[k])
            atoms.info[f"multiplier of {name}"] = float(sample.multiplier[k])
        atoms.info["ln det Z"] = sample.log_det_z
        if self.constraint_forces:
            atoms.set_array("constraint_forces", motion.constraint_force(x, v, np.asarray(forces), time))

    @property
    def multipliers(self) -> dict[str, float]:
        """Those of the last sample, by name."""
        return {} if self.last is None else dict(zip(self._held.names, self.last.multiplier.tolist(), strict=True))
