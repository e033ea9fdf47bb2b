"""The study of steps on the device."""

import openmm_device
import pytest
from openmm import app
from openmm_systems import DATA

from kcons.openmm.device import build

ALANINE = DATA / "alanine-dipeptide-implicit.pdb"


def alanine(path, constraints):
    """In the place of a protein in water."""
    pdb = app.PDBFile(str(path))
    field = app.ForceField("amber14-all.xml", "implicit/gbn2.xml")
    return field.createSystem(pdb.topology, constraints=constraints), pdb.positions


@pytest.mark.skipif(bool(build.refusal()), reason=build.refusal())
def test_all_bonds_and_angles_are_held_by_kernels(monkeypatch):
    """Speeds are not measured."""
    asked = []

    def measured(title, system, start, made, place, *length):
        asked.append((system.getNumConstraints(), made))
        yield {"integrator": next(iter(made)), "ms": 2.0}

    monkeypatch.setattr(openmm_device, "measured", measured)
    monkeypatch.setattr(openmm_device, "VILLIN", ALANINE)
    monkeypatch.setattr(openmm_device, "protein", alanine)
    rows = list(openmm_device.bonds_and_angles("Reference", False))
    assert rows[-1]["ratio"] == 1.0
    (before, _), (after, made) = asked
    assert before == 12 and after == 0  # bonds to hydrogen, and what is left to OpenMM
    # Of 3 * 22 - 6 internal coordinates all but the torsions of 7 bonds.
    assert "53 rows" in str(made["rattle, device"].parts)
