"""The pressure of a Context by differences of its energy."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import dumbbell, started, state_of, water_box

from kcons.constraints import Distance
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.openmm import Langevin, PressureReporter, ProjectedIntegrator, hold, molecular_pressure


def test_pressure_is_that_of_openmm():
    """Of water, by its own derivative of the energy; the state stays."""
    system, x = water_box(27)
    barostat = openmm.MonteCarloBarostat(1.0, 300, 0)
    system.addForce(barostat)
    integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300, 5.0))
    context = started(system, integrator, x)
    context.setVelocitiesToTemperature(300, 3)
    integrator.step(20)
    before = state_of(context)
    mine, theirs = molecular_pressure(context), barostat.computeCurrentPressure(context).value_in_unit(unit.bar)
    assert mine == pytest.approx(theirs, rel=2e-3)
    for one, other in zip(before, state_of(context), strict=True):
        assert np.array_equal(one, other)


def test_reporter(tmp_path):
    system, x = water_box(8)
    topology = app.Topology()
    residue = topology.addResidue("all", topology.addChain())
    for _ in x:
        topology.addAtom("O", None, residue)
    simulation = app.Simulation(topology, system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform(0))
    simulation.context.setPositions(x)
    reporter = PressureReporter(tmp_path / "pressure.csv", 2, temperature=300)
    simulation.reporters.append(reporter)
    simulation.step(4)
    lines = (tmp_path / "pressure.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ['#"Step"', "2", "4"]
    assert float(lines[-1].split(",")[1]) == pytest.approx(0.62**3, rel=1e-5)
    assert reporter.values[-1] == pytest.approx(molecular_pressure(simulation.context, 300), rel=1e-12)
    assert reporter.values[-1] != pytest.approx(molecular_pressure(simulation.context), rel=1e-3)


def test_a_system_without_a_box_is_refused():
    system, x = dumbbell()[:2]
    with pytest.raises(InputError, match="periodic"):
        molecular_pressure(started(system, openmm.VerletIntegrator(0.001), x))


def test_numbers_that_are_none(tmp_path):
    system, x = water_box(8)
    context = started(system, openmm.VerletIntegrator(0.001), x)
    assert molecular_pressure(context, 300 * unit.kelvin) == molecular_pressure(context, 300)
    for bad in ({"temperature": -1}, {"temperature": 1 * unit.nanometer}, {"strain": 0}, {"strain": np.nan}):
        with pytest.raises(InputError):
            molecular_pressure(context, **bad)
    with pytest.raises(InputError, match=r"simulation\.context"):
        molecular_pressure(system)
    context.setPositions(np.zeros_like(x))
    with pytest.raises(NonFiniteError, match="overlap"):
        molecular_pressure(context)
    for interval in (0, 2.5, None):
        with pytest.raises(InputError, match="reportInterval"):
            PressureReporter(tmp_path / "pressure.csv", interval)
    assert not (tmp_path / "pressure.csv").exists()


def test_particles_without_mass_have_no_momentum():
    ghosts, y = water_box(8)
    (force,) = (f for f in ghosts.getForces() if isinstance(f, openmm.NonbondedForce))
    for _ in range(3):
        ghosts.addParticle(0.0)
        force.addParticle(0.0, 0.1, 0.0)
    y = np.concatenate([y, 0.1 + 0.05 * np.eye(3)])
    context = started(ghosts, openmm.VerletIntegrator(0.001), y)
    context.setVelocities(np.zeros_like(y))
    ideal = 8 * unit.BOLTZMANN_CONSTANT_kB * 300 * unit.kelvin / context.getState().getPeriodicBoxVolume()
    found = molecular_pressure(context, 300) - molecular_pressure(context)
    assert found == pytest.approx(ideal.value_in_unit(unit.bar), rel=1e-6)


def chain_and_atom(bonded):
    """A chain of four across a face of the cell, and an atom near it; as stored, and each atom wrapped."""
    side = 2.0
    system = openmm.System()
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.9)
    for mass, depth in ((14.0, 0.3),) * 4 + ((40.0, 1.0),):
        system.addParticle(mass)
        force.addParticle(0.0, 0.35, depth)
    for i in range(4):
        for j in range(i):
            force.addException(i, j, 0.0, 1.0, 0.0)
    system.addForce(force)
    bonds = openmm.HarmonicBondForce()
    bonds.setUsesPeriodicBoundaryConditions(True)
    for i in range(3 if bonded else 0):
        bonds.addBond(i, i + 1, 0.153, 2e5)
    system.addForce(bonds)
    system.setDefaultPeriodicBoxVectors(*(side * np.eye(3)))
    x = np.array([[0.03, 0.08, 0.03], [0.03, 0.23, 0.03], [-0.1, 0.29, -0.02], [-0.1, 0.39, -0.13], [0.5, 0.3, 0.1]])
    return system, x, x % side


def test_molecules_across_a_face_of_the_cell():
    """Whichever images their atoms are stored in."""
    system, x, wrapped = chain_and_atom(True)
    found = [molecular_pressure(started(system, openmm.VerletIntegrator(0.001), y), 300) for y in (x, wrapped)]
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    assert abs(found[0]) < 100


def test_a_virtual_site_is_in_one_piece_with_its_molecule():
    system, x, wrapped = chain_and_atom(True)
    system.addParticle(0.0)
    system.getForce(0).addParticle(0.0, 0.35, 0.0)
    system.setVirtualSite(5, openmm.TwoParticleAverageSite(2, 3, 0.5, 0.5))
    x, wrapped = (np.vstack([y, y[2:4].mean(axis=0)]) for y in (x, wrapped))
    found = [molecular_pressure(started(system, openmm.VerletIntegrator(0.001), y), 300) for y in (x, wrapped)]
    assert found[1] == pytest.approx(found[0], rel=1e-6)


def test_rows_that_join_molecules():
    """They move as one where `hold` says so, and are refused otherwise: their forces would be missing."""
    found = []
    for join in (False, True, True):
        system, x, wrapped = chain_and_atom(False)
        y = wrapped if found else x
        rows = Distance([[0, 1], [1, 2], [2, 3]])
        context = started(system, ProjectedIntegrator(0.001, parts=[hold(system, rows, y, join=join)]), y)
        if join:
            found.append(molecular_pressure(context, 300))
            continue
        before = state_of(context)
        with pytest.raises(UnsupportedError, match="join=True"):
            molecular_pressure(context, 300)
        for one, other in zip(before, state_of(context), strict=True):
            assert np.array_equal(one, other)
    assert found[1] == pytest.approx(found[0], rel=1e-6)
