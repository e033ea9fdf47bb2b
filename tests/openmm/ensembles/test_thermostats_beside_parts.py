"""Every ensemble has its temperature; those that scale velocities beside rows that parts hold."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from ensemble_runs import on_their_rows, run, twice_kinetic, two_parts, warm
from openmm_ensembles import ENSEMBLES
from openmm_systems import context_of, loose_alanine, state_of, water_box

from kcons.openmm import ProjectedIntegrator, hold
from kcons.openmm.quantities import GAS_CONSTANT

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque", "ignore:total momentum")
#: Noise differs between programs.
WITHOUT_NOISE = [name for name, make in ENSEMBLES.items() if not make(300).noisy]


@pytest.mark.parametrize("bath", ENSEMBLES)
def test_a_run_has_the_temperature(bath):
    """From 200 K to 300 K, within three standard errors: rigid waters in a weak well, none of whose momenta last."""
    system, x = water_box(8)
    well = openmm.CustomExternalForce("20*(x^2+y^2+1.5*z^2)")
    for k in range(0, 24, 3):
        well.addParticle(k)
    system.addForce(well)
    integrator = ProjectedIntegrator(2e-3, ensemble=ENSEMBLES[bath](300.0, 50.0))
    integrator.setRandomNumberSeed(3)
    context = context_of(system, integrator)
    context.setPositions(x)
    integrator.setVelocitiesToTemperature(context, 200, 1)
    integrator.step(1000)
    values = []
    for _ in range(400):
        integrator.step(10)
        values.append(integrator.computeSystemTemperature()._value)
    blocks = np.reshape(values, (20, -1)).mean(axis=1)
    error = blocks.std(ddof=1) / np.sqrt(20)
    assert error < 6
    assert abs(blocks.mean() - 300) <= max(3 * error, 1e-6)


@pytest.mark.parametrize("bath", WITHOUT_NOISE)
@pytest.mark.usefixtures("without_device")
def test_rows_that_are_carried_move_as_those_of_the_system(bath):
    """The same bonds held by OpenMM and by kcons: one trajectory of atoms and bath, although others move x."""
    system, x, v = loose_alanine()
    other = copy.deepcopy(system)
    carried = hold(other, [], positions=x, take="all")
    ends = []
    for this, parts in ((system, ()), (other, (carried,))):
        integrator = ProjectedIntegrator(
            1e-3, parts=parts, tolerance=1e-13, ensemble=ENSEMBLES[bath](300.0, 20.0, momentum="free")
        )
        context = run(this, integrator, x, v, 10)
        r, u = state_of(context)
        context.setPositions(r + 0.7)
        context.setVelocities(u)
        integrator.step(10)
        ends.append((*state_of(context), integrator.program.remembered()))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=3e-12)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=3e-9)
    assert ends[0][2] == pytest.approx(ends[1][2], rel=1e-7)


@pytest.mark.parametrize("bath", ["Isokinetic", "NoseHoover"])
def test_parts_keep_their_rows(bath):
    system, x, parts = two_parts()
    ensemble = ENSEMBLES[bath](300.0)
    integrator = ProjectedIntegrator(1e-3, parts=parts, ensemble=ensemble)
    context = warm(system, integrator, x, 4)
    values = []
    for block in range(20):
        integrator.step(10)
        integrator.check()
        values.append(ensemble.conserved_energy(integrator))
        r, u = on_their_rows(*state_of(context))
        # 18 coordinates, three rows; the sphere stands in space, so that momentum is not conserved.
        if bath == "Isokinetic":
            assert abs(twice_kinetic(system, u) / ((18 - 3 - 1) * GAS_CONSTANT * 300) - 1) <= 1e-13
        if block == 1:  # somebody moves x between steps
            context.setPositions(r + 0.0)
            integrator.applyConstraints(context)
    assert ensemble.count(integrator) == 15
    if bath == "NoseHoover":
        assert np.ptp(values) < 0.05 < abs(integrator.getGlobalVariableByName("chain_place"))
