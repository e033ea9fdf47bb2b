"""Carried constraint objects, surfaces among them, and collective rows in one integrator."""

import numpy as np
import openmm
import pytest
from openmm import unit

from kcons.constraints import Angle, Sphere
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row, hold

RADIUS, ANGLE, DISTANCE = 0.6, 1.9, 0.5


def _chain() -> tuple[openmm.System, np.ndarray]:
    """Particles 0 to 2 an angle, 3 and 4 at a distance, 5 on a sphere around the origin."""
    x = np.array([[0.1, 0, 0], [0.2, 0.1, 0], [0.3, 0, 0.05], [0.8, 0.1, 0], [0.8, 0.6, 0.1], [0.0, 0.6, 0.1]])
    system = openmm.System()
    springs = openmm.CustomBondForce("200*(r-0.5)^2")
    for i in range(len(x)):
        system.addParticle(12.0 + i)
        for j in range(i):
            springs.addBond(j, i)
    system.addForce(springs)
    return system, x


def test_two_kinds_of_parts_go_together():
    system, x = _chain()
    carried = hold(system, [Angle([(0, 1, 2)], ANGLE), Sphere([5], [0, 0, 0], RADIUS)], positions=x)
    distance = openmm.CustomBondForce("r")
    distance.addBond(3, 4)
    rows = CollectiveRows(system, [Row(distance, DISTANCE)])
    integrator = ProjectedIntegrator(0.002, parts=(carried, rows))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 4)
    energies = []
    for _ in range(5):
        integrator.step(10)
        integrator.check()
        state = context.getState(positions=True, energy=True, groups=set(range(32)) - integrator.row_groups)
        r = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
        a, b = r[0] - r[1], r[2] - r[1]
        assert abs(np.arccos(a @ b / np.sqrt((a @ a) * (b @ b))) - ANGLE) < 1e-11
        assert abs(np.linalg.norm(r[3] - r[4]) - DISTANCE) < 1e-11
        assert abs(np.linalg.norm(r[5]) - RADIUS) < 1e-12
        energy = state.getPotentialEnergy() + integrator.kinetic_energy()
        energies.append(energy.value_in_unit(unit.kilojoule_per_mole))
    assert np.ptp(energies) < 0.02 * abs(np.mean(energies))
    assert integrator.degrees_of_freedom() == 18 - 3


def test_what_cannot_be_reached_leaves_positions_as_they_were():
    system, x = _chain()
    carried = hold(system, [Angle([(0, 1, 2)], ANGLE)], positions=x)
    sphere = hold(system, Sphere([5], center=[0, 0, 0], radius=RADIUS), x)
    integrator = ProjectedIntegrator(0.002, parts=(carried, sphere))
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    x[5] = 0.0  # the center: no nearest point
    context.setPositions(x)
    with pytest.raises(Exception, match=r"Sphere\(5\)|particle 5|row") as caught:
        integrator.applyConstraints(context)
    assert type(caught.value).__module__ == "kcons.errors"
    assert np.array_equal(context.getState(positions=True).getPositions(asNumpy=True)._value, x)
