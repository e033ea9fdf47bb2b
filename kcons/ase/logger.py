"""ASE's log of a run, for atoms that are constrained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from ase import Atoms, units
from ase.md.logger import MDLogger
from ase.stress import full_3x3_to_voigt_6_stress

from kcons.ase.binding import applied_forces
from kcons.ase.constraints_object import Constraints
from kcons.ase.respect import VOIGT, virial_of
from kcons.ase.topology import kinetic_energy_of, velocities_of
from kcons.constraints import Constraint
from kcons.constraints.arguments import refuse_other
from kcons.constraints.constraint_set import rows_like
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion


class ConstraintLogger(MDLogger):
    """`ase.md.MDLogger` with temperature and stress of all that the dynamics holds, and multipliers by name.

    ASE's own logger counts what the objects on the atoms remove. Rows that only the dynamics holds, and total momentum
    that a thermostat leaves alone, are missing there, and constraint forces of such rows in the stress. ``logfile=`` of
    the dynamics of kcons is such a log. With a bath that has noise, kinetic energy and temperature are of the middle of
    the step; see `ConstrainedLangevin`.

    Parameters
    ----------
    dyn : MolecularDynamics
        Of kcons, or another of ASE whose atoms carry `Constraints`.
    atoms : ase.Atoms
    logfile : path, text file or '-'
    coordinates : mapping of str to Constraint
        What is held, each named by an object of the same kind on the same atoms, whatever its target. Each row of it is
        a column: its multiplier, in eV by angstrom or by radian, the force along the coordinate that holds it.
    **kwargs
        As for `ase.md.MDLogger`: header, stress, peratom, mode.

    Examples
    --------
    ``dynamics.attach(ConstraintLogger(dynamics, atoms, "md.log", {"torsion": torsion}), interval=10)``
    """

    def __init__(
        self,
        dyn: Any,
        atoms: Atoms,
        logfile: IO[str] | str,
        coordinates: Mapping[str, Constraint] | None = None,
        *,
        header: bool = True,
        **kwargs: Any,
    ) -> None:
        if coordinates is not None:
            refuse_other(coordinates, Mapping, "coordinates", "each a name: {'torsion': torsion}")
            for name, item in coordinates.items():
                refuse_other(item, Constraint, f"coordinates[{name!r}]", "a constraint that is held")
        self.coordinates = dict(coordinates or {})
        self._known: tuple[Motion, list[int]] | None = None
        if self.coordinates:
            self._rows(_motion(dyn, atoms))
        super().__init__(dyn, atoms, logfile, header=False, **kwargs)
        for name, item in self.coordinates.items():
            for column in [name] if item.n_rows == 1 else [f"{name}[{k}]" for k in range(item.n_rows)]:
                title = f"lambda({column})"
                self.hdr += f" {title:>14s}"
                self.fmt = f"{self.fmt.rstrip()} %{max(14, len(title))}.6g\n"
        if header:
            self.logfile.write(f"{self.hdr}\n")

    def __call__(self) -> None:
        """Write a line."""
        atoms: Atoms = self.atoms
        dyn: Any = self.dyn
        count = len(atoms) if self.peratom else 1
        whole = dyn.get_kinetic_energy() if hasattr(dyn, "motion") else kinetic_energy_of(atoms)
        potential, kinetic = atoms.get_potential_energy() / count, whole / count
        row = [] if dyn is None else [dyn.get_time() / (1000 * units.fs)]
        row += [potential + kinetic, potential, kinetic]
        if hasattr(dyn, "degrees_of_freedom"):
            row.append(dyn.get_temperature())
        else:
            freedom = atoms.get_number_of_degrees_of_freedom()
            row.append(2 * whole / (freedom * units.kB) if freedom else 0.0)
        if self.stress:
            gas = atoms.get_momenta().T @ velocities_of(atoms) / atoms.get_volume()
            row += ((_stress(dyn, atoms) - full_3x3_to_voigt_6_stress(gas)) / units.GPa).tolist()
        if self.coordinates:
            motion = _motion(dyn, atoms)
            x, v = atoms.positions, velocities_of(atoms)
            time = 0.0 if dyn is None else dyn.get_time()
            row += motion.multipliers(x, v, applied_forces(atoms), time)[self._rows(motion)].tolist()
        self.logfile.write(self.fmt % tuple(row))
        self.logfile.flush()

    def _rows(self, motion: Motion) -> list[int]:
        """Rows of the coordinates among those that the engine holds."""
        if self._known is None or self._known[0] is not motion:
            held = motion.constraint_set
            rows = [row for name, item in self.coordinates.items() for row in rows_like(held, item, name)]
            self._known = motion, rows
        return self._known[1]


def _stress(dyn: Any, atoms: Atoms) -> FloatArray:
    """Without that of momenta; the constraints' part is of all rows that a dynamics class of kcons holds."""
    if not hasattr(dyn, "motion"):
        return np.asarray(atoms.get_stress())
    virial = virial_of(dyn.motion, atoms, applied_forces(atoms), dyn.get_time())
    return np.asarray(atoms.get_stress(apply_constraint=False)) - virial[VOIGT] / atoms.get_volume()


def _motion(dyn: Any, atoms: Atoms) -> Motion:
    """The engine of a dynamics class of kcons, or that of the object on the atoms."""
    if hasattr(dyn, "motion"):
        return dyn.motion  # type: ignore[no-any-return]
    found = [item for item in atoms.constraints if isinstance(item, Constraints)]
    if not found:
        raise InputError(
            "the atoms carry no constraints of kcons, so that no coordinate is held; see kcons.ase.constrain, and "
            "kcons.ase.attach for atoms from a file",
            item="coordinates",
        )
    return found[0].engine(atoms)
