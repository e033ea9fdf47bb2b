"""Coordinates reported from OpenMM, however they are held."""

from __future__ import annotations

import csv
import io

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import DATA

from kcons.constraints import Angle, Dihedral, Distance, MovingTarget
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy import HeldCoordinatesReporter
from kcons.free_energy.series import local_mean_force
from kcons.openmm import CollectiveRows, Langevin, ProjectedIntegrator, hold

PDB = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
FIELD = app.ForceField("amber14-all.xml", "implicit/gbn2.xml")
PHI = [4, 6, 8, 14]


def torsion(atoms=PHI):
    force = openmm.CustomTorsionForce("theta")
    force.addTorsion(*atoms, [])
    return force


X = np.array(PDB.positions.value_in_unit(unit.nanometer))


def simulation_of(system, integrator, reporter, still=False):
    simulation = app.Simulation(PDB.topology, system, integrator, openmm.Platform.getPlatformByName("Reference"))
    simulation.context.setPositions(X)
    if still:
        simulation.context.setVelocities(np.zeros_like(X))
    else:
        simulation.context.setVelocitiesToTemperature(300 * unit.kelvin, 3)
        integrator.applyConstraints()
        integrator.applyVelocityConstraints()
    simulation.reporters.append(reporter)
    return simulation


def peptide(constraints=app.HBonds):
    return FIELD.createSystem(PDB.topology, constraints=constraints, removeCMMotion=False)


@pytest.mark.parametrize("bonds", [app.HBonds, app.AllBonds], ids=["HBonds", "AllBonds"])
def test_a_torsion_held_as_a_collective_variable(bonds):
    """Multipliers are those that the rows compute by evaluations of their own."""
    system = peptide(bonds)
    rows = CollectiveRows(system, [torsion()], positions=PDB.positions)
    integrator = ProjectedIntegrator(0.002, parts=[rows], ensemble=Langevin(300, 5))
    integrator.setRandomNumberSeed(1)
    file = io.StringIO()
    reporter = HeldCoordinatesReporter(file, 5, {"phi": Dihedral([PHI])})
    simulation = simulation_of(system, integrator, reporter)
    for _ in range(4):
        simulation.step(5)
        assert reporter.series.multiplier[-1, 0] == pytest.approx(rows.multipliers(simulation.context)[0], rel=1e-6)
    simulation.step(80)
    assert len(reporter.series) == 20
    assert reporter.series.off.max() < 1e-10
    lines = list(csv.reader(io.StringIO(file.getvalue())))
    assert lines[0] == ['#"Step"', "Time (ps)", "phi", "multiplier of phi", "ln det Z"]
    assert [int(line[0]) for line in lines[1:]] == list(range(5, 101, 5))
    assert float(lines[-1][3]) == pytest.approx(reporter.series.multiplier[:, 0][-1], rel=1e-10)
    assert np.isfinite(local_mean_force(reporter.series, 2.49)).all()
    if bonds is app.AllBonds:
        assert abs(reporter.series.gradient).max() > 1e-3


def test_the_same_coordinate_held_in_three_ways(tmp_path):
    pair, angle = [8, 14], [6, 8, 14]
    far, length = (float(np.linalg.norm(X[i] - X[j])) for i, j in ([1, 0], pair))
    found = {}
    for way in ("System", "collective", "hold"):
        system = peptide(app.HBonds)
        bend, bond = openmm.CustomAngleForce("theta"), openmm.CustomBondForce("r")
        bend.addAngle(*angle, [])
        bond.addBond(*pair, [])
        if way == "System":
            system.addConstraint(*pair, length)
        if way == "hold":  # one object of several rows, of which one is named
            part = hold(system, [Distance([[1, 0], pair], [far, length]), Angle([angle])], X)
        else:
            part = CollectiveRows(system, [bend] if way == "System" else [bond, bend], positions=X)
        named = {"bond": Distance([pair]), "angle": Angle([angle])}
        reporter = HeldCoordinatesReporter(str(tmp_path / f"{way}.csv"), 1, named)
        simulation_of(system, ProjectedIntegrator(1e-6, parts=[part]), reporter, still=True).step(1)
        sample = reporter.series[0]
        found[way] = np.concatenate([sample.multiplier, sample.gradient, [sample.log_det_z]])
    for way in ("collective", "hold"):
        np.testing.assert_allclose(found["System"], found[way], rtol=1e-6)


def test_work_of_a_pull_by_hold_is_the_energy_that_it_adds():
    """The target accelerates, which the constraint of `hold` knows and the one that names it does not."""
    system = peptide(None)
    length = float(np.linalg.norm(X[8] - X[14]))
    pull = Distance([[8, 14]], MovingTarget(lambda t: length + 8.0 * t * t))
    integrator = ProjectedIntegrator(0.0001, parts=[hold(system, [pull], X)])
    reporter = HeldCoordinatesReporter(io.StringIO(), 1, {"r": Distance([[8, 14]])})
    simulation, energies = simulation_of(system, integrator, reporter, still=True), []
    for steps in (1, 300):
        simulation.step(steps)
        state = simulation.context.getState(energy=True)
        energies.append((state.getPotentialEnergy() + integrator.kinetic_energy()) / unit.kilojoule_per_mole)
    assert energies[1] - energies[0] > 1
    assert reporter.series.work[-1] == pytest.approx(energies[1] - energies[0], rel=1e-3)


def test_a_bond_to_a_virtual_site_does_not_count_its_force_twice_and_a_coordinate_of_one_is_refused():
    system, bonds, charges = openmm.System(), openmm.HarmonicBondForce(), openmm.NonbondedForce()
    for mass in (1.0, 16.0, 12.0, 14.0, 1.0, 1.0, 0.0):
        system.addParticle(mass)
    system.setVirtualSite(6, openmm.TwoParticleAverageSite(2, 3, -0.5, 1.5))
    x = np.array([[0, 0, 0], [12, 0, 0], [16, 11, 0], [28, 12, 5], [40, 30, 30], [11, -8, 5], [0, 0, 0]]) / 100
    for i, j in ((0, 1), (1, 2), (2, 3), (1, 5), (3, 6)):
        bonds.addBond(i, j, np.linalg.norm(x[i] - x[j]) if j < 6 else 0.06, 1000.0)
    for charge in (0, 0, 0, 0, 0.7, 0, -0.9):
        charges.addParticle(charge, 1.0, 0.0)
    system.addForce(bonds)
    system.addForce(charges)
    integrator = ProjectedIntegrator(0.001, parts=[CollectiveRows(system, [torsion([0, 1, 2, 3])], positions=x)])
    simulation = app.Simulation(app.Topology(), system, integrator, openmm.Platform.getPlatformByName("Reference"))
    reporter = HeldCoordinatesReporter(io.StringIO(), 1, {"t": Dihedral([[0, 1, 2, 3]])})

    def energy(angle):
        place, axis = x.copy(), (x[2] - x[1]) / np.linalg.norm(x[2] - x[1])
        arm = x[3] - x[2]
        place[3] += np.sin(angle) * np.cross(axis, arm) + (1 - np.cos(angle)) * (axis @ arm * axis - arm)
        simulation.context.setPositions(place)
        simulation.context.computeVirtualSites()
        groups = integrator.getIntegrationForceGroups()
        return simulation.context.getState(energy=True, groups=groups).getPotentialEnergy()._value

    slope = (energy(1e-4) - energy(-1e-4)) / 2e-4
    energy(0.0)
    groups = integrator.getIntegrationForceGroups()
    state = simulation.context.getState(positions=True, velocities=True, forces=True, groups=groups)
    reporter.report(simulation, state)
    assert reporter.series.turned[0, 0] == pytest.approx(slope, rel=1e-5)
    simulation.reporters.append(HeldCoordinatesReporter(io.StringIO(), 1, {"r": Distance([[0, 6]], 0.1)}))
    with pytest.raises(UnsupportedError, match="virtual site"):
        simulation.step(1)


def test_bad_input():
    system = peptide()
    psi = [6, 8, 14, 16]
    rows = CollectiveRows(system, [torsion(), torsion(psi)], positions=PDB.positions)
    phi = io.StringIO(), 1, {"phi": Dihedral([PHI])}
    simulation = simulation_of(system, ProjectedIntegrator(0.001, parts=[rows]), HeldCoordinatesReporter(*phi))
    with pytest.raises(InputError, match=r"holds 2 rows, and 1 are named.*beside"):
        simulation.step(1)
    compound = openmm.CompoundIntegrator()
    compound.addIntegrator(ProjectedIntegrator(0.001))
    several = app.Simulation(PDB.topology, peptide(), compound, openmm.Platform.getPlatformByName("Reference"))
    several.context.setPositions(X)
    state = several.context.getState(positions=True, velocities=True, forces=True)
    with pytest.raises(UnsupportedError, match=r"CompoundIntegrator does not tell.*member alone"):
        HeldCoordinatesReporter(*phi).report(several, state)
    simulation.reporters = [HeldCoordinatesReporter(*phi, beside=[Dihedral([psi])])]
    simulation.step(1)
    assert len(simulation.reporters[0].series) == 1
    other = simulation_of(peptide(), ProjectedIntegrator(0.001), simulation.reporters[0])
    with pytest.raises(InputError, match="belongs to another simulation"):
        other.step(1)
