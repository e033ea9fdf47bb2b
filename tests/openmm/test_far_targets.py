"""`apply_positions` of rows from `hold`, with far targets: bonds of the System lead, and stay as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openmm
import pytest
from ase.build import molecule
from openmm import app, unit

from kcons.constraints import Dihedral
from kcons.openmm import ProjectedIntegrator, hold

DATA = Path(__file__).parents[1] / "data"
REFERENCE = openmm.Platform.getPlatformByName("Reference")


def placed(system: openmm.System, rows, x: np.ndarray) -> openmm.Context:
    context = openmm.Context(system, ProjectedIntegrator(0.001, parts=[rows]), REFERENCE)
    context.setPositions(x)
    return context


def positions(context: openmm.Context) -> np.ndarray:
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


@pytest.mark.parametrize("hydrogen", [1.008, 3.024])
@pytest.mark.parametrize("degrees", [150, 75, 30, -60])
def test_masses_alone(degrees: float, hydrogen: float) -> None:
    """A System without forces: distances say what is bonded, whatever the masses (heavy hydrogens)."""
    atoms = molecule("CH3CH2OH")
    x = 0.1 * atoms.positions
    system = openmm.System()
    for number, mass in zip(atoms.numbers, atoms.get_masses(), strict=True):
        system.addParticle(hydrogen if number == 1 else mass)
    rows = hold(system, Dihedral([[3, 2, 1, 0]], np.radians(degrees)), x)
    context = placed(system, rows, x)
    rows.apply_positions(context)
    atoms.positions = 10 * positions(context)
    assert rows.report(context).residual < 1e-13
    assert abs(atoms.get_distance(2, 3) - 10 * np.linalg.norm(x[2] - x[3])) < 1e-9
    rows.check(context)


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds, app.HAngles])
def test_alanine_dipeptide(constraints: object) -> None:
    """Both torsions of the backbone far away, with constraints of the System that go into the rows or stay."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(pdb.topology, constraints=constraints)
    x = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    bonds = np.array([(b[0].index, b[1].index) for b in pdb.topology.bonds()])
    rows = hold(system, Dihedral([[4, 6, 8, 14], [6, 8, 14, 16]], np.radians([-60.0, -45.0])), x)
    context = placed(system, rows, x)
    rows.apply_positions(context)
    y = positions(context)
    assert rows.report(context).residual < 1e-13
    length = [np.linalg.norm(z[bonds[:, 0]] - z[bonds[:, 1]], axis=1) for z in (x, y)]
    held = {tuple(sorted(a)) for c in rows.motion.constraint_set.constraints for a in c.atoms.tolist() if len(a) == 2}
    others = np.array([tuple(sorted(b)) not in held for b in bonds.tolist()])
    assert np.abs(length[1] - length[0])[others].max(initial=0.0) < 0.002
    assert np.abs(length[1] - length[0]).max() < 0.004  # to the lengths of the force field
