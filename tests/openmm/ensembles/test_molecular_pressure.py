"""The pressure of a Context by differences of its energy."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import dumbbell, started, state_of, water_box

from kcons.errors import InputError
from kcons.openmm import Langevin, PressureReporter, ProjectedIntegrator, molecular_pressure


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
