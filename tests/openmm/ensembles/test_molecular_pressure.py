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
    reporter = PressureReporter(str(tmp_path / "pressure.csv"), 2, temperature=300)
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
