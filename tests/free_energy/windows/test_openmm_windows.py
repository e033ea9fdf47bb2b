"""Windows in OpenMM: two torsions of a peptide at once."""

from __future__ import annotations

import pickle

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import DATA

from kcons.constraints import Angle, CenterDistance, Dihedral, Distance, DistanceDifference, Formula
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy import OpenMMWindows, Series, Settings, Window, mean_force
from kcons.openmm.device import build

PDB = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
PHI, PSI = Dihedral([[4, 6, 8, 14]]), Dihedral([[6, 8, 14, 16]])


def system():
    field = app.ForceField("amber14-all.xml", "implicit/gbn2.xml")
    return field.createSystem(PDB.topology, constraints=app.HBonds, removeCMMotion=False)


def sampler(coordinates):
    return OpenMMWindows(PDB.topology, system(), PDB.positions, coordinates, platform="Reference")


@pytest.mark.filterwarnings("ignore:the forces exert no torque")
def test_two_torsions_far_from_the_structure(tmp_path):
    windows = pickle.loads(pickle.dumps(sampler({"phi": PHI, "psi": PSI})))
    assert windows.start == pytest.approx([np.pi, np.pi], abs=1e-3)
    settings = Settings(timestep=2.0, relax=5, pull=20, equilibration=20, production=320, every=10)
    windows.sample(Window("up", (-1.2, 1.9), (-1.1, 2.0), 7), settings, tmp_path / "window.npz")
    series = Series.load(tmp_path / "window.npz")
    assert len(series) == 32 and series.off.max() < 1e-10
    np.testing.assert_allclose(series.value, np.tile([-1.1, 2.0], (32, 1)), atol=1e-10)
    assert np.abs(series.multiplier).max() > 1
    assert np.isfinite(series.turned).all() and series.turned.std() < series.multiplier.std() / 2


@pytest.mark.filterwarnings("ignore:.*independent ones", "ignore:the forces exert no torque")
@pytest.mark.skipif(bool(build.refusal()), reason=build.refusal())
def test_windows_on_the_device_are_those_of_the_program(tmp_path, monkeypatch):
    """A hundred steps, the states recorded on the device: multipliers, weights and what belongs to them."""
    # Noise of 1e-14: each has its own.
    settings = Settings(friction=1e-30, relax=0, pull=16, equilibration=20, production=64, every=2)
    found = []
    for why in ("", "there is no compiler"):
        monkeypatch.setattr(build, "refusal", lambda why=why: why)
        window = Window("up", (3.0, 3.1), (3.05, 3.1), 7)
        sampler({"phi": PHI, "psi": PSI}).sample(window, settings, tmp_path / "window.npz")
        found.append(Series.load(tmp_path / "window.npz"))
    for name in ("value", "multiplier", "kinetic", "log_det_z", "gradient", "turned", "mean_kinetic", "time"):
        one, other = (getattr(series, name) for series in found)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max(), err_msg=name)
    forces = [mean_force(series, 2.494).force for series in found]
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-9)


@pytest.mark.parametrize(
    ("coordinate", "target"),
    [
        (Angle([[6, 8, 14]]), 2.0),
        (DistanceDifference([[4, 14], [16, 6]]), -0.016),
        (Formula("sqrt((x1-x2)**2 + (y1-y2)**2 + (z1-z2)**2)", [[4, 14]]), 0.26),
        (CenterDistance([4, 6], [14, 16]), 0.22),
    ],
    ids=["angle", "difference", "formula", "centers"],
)
def test_other_coordinates(tmp_path, coordinate, target):
    windows = sampler({"q": coordinate})
    assert windows.scales.tolist() == ([1.0] if isinstance(coordinate, Angle | Formula) else [10.0])
    settings = Settings(relax=5, pull=20, equilibration=10, production=32, every=1)
    windows.sample(Window("down", (target + 0.02,), (target,), 7), settings, tmp_path / "window.npz")
    np.testing.assert_allclose(Series.load(tmp_path / "window.npz").value, target, atol=1e-10)


def test_structures_that_are_not_of_the_system():
    made, topology, x, distance = openmm.System(), app.Topology(), np.eye(3)[:2], {"r": Distance([[0, 1]])}
    residue = topology.addResidue("X", topology.addChain())
    for _ in x:
        made.addParticle(1.0)
        topology.addAtom("X", None, residue)
    topology.setPeriodicBoxVectors(3.0 * np.eye(3))
    OpenMMWindows(topology, made, x, distance)
    bonds = openmm.HarmonicBondForce()
    bonds.setUsesPeriodicBoundaryConditions(True)
    made.addForce(bonds)
    made.setDefaultPeriodicBoxVectors(*(3.1 * np.eye(3)))
    with pytest.raises(InputError, match=r"box of the Topology is \[\[3\.0.*System.*\[\[3\.1.*setDefaultPeriodic"):
        OpenMMWindows(topology, made, x, distance)
    made.setDefaultPeriodicBoxVectors(*(3.0001 * np.eye(3)))
    OpenMMWindows(topology, made, x, distance)
    made.addForce(openmm.MonteCarloBarostat(1.0, 300.0))
    with pytest.raises(UnsupportedError, match="MonteCarloBarostat; windows are sampled in a box at rest"):
        OpenMMWindows(topology, made, x, distance)


def test_a_pull_begins_in_equilibrium_and_is_recorded_at_each_step(tmp_path):
    settings = Settings(pull=100, equilibration=20, production=320, every=10, relax=3)
    sampler({"phi": PHI}).pull(Window("forward", (-1.2,), (-1.0,), 5), settings, tmp_path / "pull.npz")
    series = Series.load(tmp_path / "pull.npz")
    assert len(series) == 101
    np.testing.assert_allclose(series.value[:, 0], np.linspace(-1.2, -1.0, 101), atol=1e-9)
    assert series.work[0] == 0 and abs(series.work[-1]) > 1e-3
