"""Kinetic energies of rigid water under a chain of thermostats in OpenMM: their mean is g kT/2, variance g (kT)²/2."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app, unit

from kcons.openmm import NoseHoover, ProjectedIntegrator


@pytest.mark.validation
@pytest.mark.parametrize("dt", [0.001, 0.002])
def test_kinetic_energies_are_those_of_the_degrees_of_freedom(dt):
    field = app.ForceField("tip3p.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, boxSize=openmm.Vec3(1.0, 1.0, 1.0))
    system = field.createSystem(box.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.45, rigidWater=True)
    integrator = ProjectedIntegrator(dt, ensemble=NoseHoover(300.0, 20.0))
    integrator.setConstraintTolerance(1e-8)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"), {"Threads": "1"})
    context.setPositions(box.positions)
    integrator.minimizeEnergy(context, maxIterations=100)
    integrator.setVelocitiesToTemperature(context, 300.0, 1)
    integrator.step(round(20.0 / dt))
    values = []
    for _ in range(5000):
        integrator.step(round(0.02 / dt))
        values.append(2 * integrator.kinetic_energy() / (unit.MOLAR_GAS_CONSTANT_R * 300.0 * unit.kelvin))
    found, g = np.array(values), integrator.ensemble.count(integrator)
    for what, expected, most in ((found, g, 0.01), ((found - g) ** 2, 2 * g, 0.1)):
        blocks = np.array([part.mean() for part in np.array_split(what, 20)])
        error = blocks.std(ddof=1) / np.sqrt(20)
        assert abs(what.mean() - expected) <= 3 * error <= most * expected
