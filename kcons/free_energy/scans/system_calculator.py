"""An OpenMM System, from a file that runs no code, and as an ASE calculator."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from ase import Atoms, units
from ase.calculators.calculator import Calculator, all_changes
from openmm import unit

from kcons.constraints import Constraint, Distance, FixedAtoms
from kcons.errors import InputError, UnsupportedError

#: kJ/mol in eV.
_KJ = units.kJ / units.mol


def read_system(path: Path, item: str) -> openmm.System:
    """The System of an XML file; refuses one with a `PythonForce`, whose code would run while it is read."""
    if not path.is_file():
        raise InputError(f"there is no file {path}", item=item)
    text = path.read_text(encoding="utf-8", errors="replace")
    if "PythonForce" in text:
        raise InputError(
            f"{path} has a PythonForce in it, whose code would run while the file is read; make the System in Python "
            "where you trust it (OpenMMWindows, SystemCalculator)",
            item=item,
        )
    try:
        system = openmm.XmlSerializer.deserialize(text)
    except (ValueError, openmm.OpenMMException) as error:
        raise InputError(f"{path} is no System of OpenMM: {error}", item=item) from error
    if not isinstance(system, openmm.System):
        raise InputError(f"{path} has a {type(system).__name__} in it, no System", item=item)
    return system


class SystemCalculator(Calculator):
    """Energy and forces of an OpenMM System.

    Parameters
    ----------
    system : openmm.System
        Particles in the order of the atoms. The cell is that of the atoms, if they have one.
    platform : str, optional
        Of OpenMM.

    Attributes
    ----------
    held : list of Constraint
        What the System constrains, in angstrom, and particles without mass, which OpenMM does not move. There are no
        forces for it, so a scan is to hold it: ``scan(atoms, ..., held=atoms.calc.held)``.

    Raises
    ------
    UnsupportedError
        Virtual sites, which have no place of their own.
    """

    implemented_properties = ["energy", "forces"]

    def __init__(self, system: openmm.System, platform: str | None = None) -> None:
        super().__init__()
        count = system.getNumParticles()
        sites = [k for k in range(count) if system.isVirtualSite(k)]
        if sites:
            raise UnsupportedError(f"particle {sites[0]} is a virtual site; relax a System without such sites")
        rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
        lengths = [length.value_in_unit(unit.angstrom) for _, _, length in rows]
        self.held: list[Constraint] = [Distance([[i, j] for i, j, _ in rows], lengths)] if rows else []
        still = [k for k in range(count) if not system.getParticleMass(k)._value]
        if still:
            self.held.append(FixedAtoms(still))
        # What a folder of a scan or of windows belongs to.
        self.parameters["system"] = sha256(openmm.XmlSerializer.serialize(system).encode()).hexdigest()
        self._count, self._periodic = count, system.usesPeriodicBoundaryConditions()
        chosen = [] if platform is None else [openmm.Platform.getPlatformByName(platform)]
        self._context = openmm.Context(system, openmm.VerletIntegrator(0.001), *chosen)

    def calculate(
        self,
        atoms: Atoms | None = None,
        properties: Iterable[str] = ("energy", "forces"),
        system_changes: Iterable[str] = all_changes,
    ) -> None:
        """Fill `results`; called by ASE."""
        super().calculate(atoms, list(properties), list(system_changes))
        assert self.atoms is not None
        if len(self.atoms) != self._count:
            raise InputError(
                f"the System has {self._count} particles and the structure {len(self.atoms)} atoms; give those of "
                "one file",
                item="system",
            )
        if self._periodic and self.atoms.pbc.all():
            self._context.setPeriodicBoxVectors(*(self.atoms.cell.array / 10))
        self._context.setPositions(self.atoms.positions / 10)
        state: Any = self._context.getState(getEnergy=True, getForces=True)
        energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.angstrom)
        self.results = {"energy": energy * _KJ, "forces": np.array(forces) * _KJ}
