"""AMOEBA's mutual induced dipoles are forces like others; Drude particles are refused by everything that kicks."""

from __future__ import annotations

from functools import cache

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import forces_at, masses_of, residuals, started, state_of, total_energy

from kcons.errors import UnsupportedError
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, RattleIntegrator
from kcons.openmm.integrator.schemes import SCHEMES

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


# -- AMOEBA -----------------------------------------------------------------------------------------


@cache
def amoeba(rigid, polarization="mutual"):
    """Four molecules of AMOEBA water near 300 K, dipoles converged to 1e-9 debye."""
    field = app.ForceField("amoeba2018.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(app.ForceField("tip3p.xml"), boxSize=openmm.Vec3(1.9, 1.9, 1.9))
    residues = list(box.topology.residues())
    oxygen = np.array([box.positions[next(r.atoms()).index]._value for r in residues])
    near = np.argsort(np.linalg.norm(oxygen - oxygen[0], axis=1))[:4]
    box.delete([r for k, r in enumerate(residues) if k not in near])
    system = field.createSystem(
        box.topology,
        rigidWater=rigid,
        polarization=polarization,
        mutualInducedTargetEpsilon=1e-9,
        removeCMMotion=False,
    )
    integrator = RattleIntegrator(0.0005, tolerance=1e-12)
    context = started(system, integrator, box.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 20)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 2)
    integrator.step(40)
    return system, *state_of(context)


def spread(system, x, v, integrator, time):
    context = started(system, integrator, x, v)
    found = []
    for _ in range(round(time / integrator.getStepSize()._value)):
        integrator.step(1)
        found.append(total_energy(context))
    return float(np.std(found))


@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("kind", [ProjectedIntegrator, RattleIntegrator])
def test_energy_with_mutual_dipoles_is_conserved_to_second_order(rigid, kind):
    steps = np.array([0.001, 0.0005, 0.00025]) / (1 if rigid else 2)
    errors = [spread(*amoeba(rigid), kind(dt, tolerance=1e-12), 0.01) for dt in steps]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2, abs=0.25)


def test_the_motion_is_that_of_openmm():
    """Beside VerletIntegrator, whose velocities are half a step behind."""
    system, x, v = amoeba(True)
    dt = 0.001
    verlet = openmm.VerletIntegrator(dt)
    verlet.setConstraintTolerance(1e-12)
    theirs = started(system, verlet, x, v)
    theirs.setVelocities(forces_at(theirs) / masses_of(system)[:, None])
    theirs.applyVelocityConstraints(1e-12)
    theirs.setVelocities(v - 0.5 * dt * state_of(theirs)[1])
    ours = started(system, integrator := RattleIntegrator(dt, tolerance=1e-12), x, v)
    for each in (verlet, integrator):
        each.step(20)
    assert np.abs(state_of(ours)[0] - state_of(theirs)[0]).max() < 1e-8
    assert residuals(system, ours)[0] < 1e-7


def test_dipoles_are_mutual():
    """What is tested above is not the cheaper model: forces differ."""
    system, x, _ = amoeba(True)
    direct = amoeba(True, "direct")[0]
    found = []
    for one in (system, direct):
        context = started(one, openmm.VerletIntegrator(0.001), x)
        found.append(forces_at(context))
        del context
    assert np.abs(found[0] - found[1]).max() > 1


@pytest.mark.parametrize(
    "ensemble", [Langevin(300, 1), Isokinetic(300), NoseHoover(300, 10)], ids=["Langevin", "Isokinetic", "NoseHoover"]
)
def test_thermostats_run_with_amoeba(ensemble):
    system, x, v = amoeba(True)
    v = v - masses_of(system) @ v / masses_of(system).sum()
    integrator = ProjectedIntegrator(0.001, ensemble=ensemble)
    context = started(system, integrator, x, v)
    integrator.step(20)
    assert residuals(system, context)[0] < 1e-7
    if not isinstance(ensemble, Langevin):
        before = integrator.ensemble.conserved_energy(integrator)
        integrator.step(20)
        assert abs(integrator.ensemble.conserved_energy(integrator) - before) < 0.1


# -- Drude ------------------------------------------------------------------------------------------


@cache
def drude():
    """Two molecules of SWM4-NDP water: a Drude particle and a virtual site each."""
    field = app.ForceField("swm4ndp.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, model="swm4ndp", boxSize=openmm.Vec3(1.9, 1.9, 1.9))
    box.delete(list(box.topology.residues())[2:])
    return field.createSystem(box.topology, removeCMMotion=False), box.positions


def refused(integrator, step, platform="Reference"):
    system, positions = drude()
    context = started(system, integrator, positions)
    before = state_of(context)
    with pytest.raises(UnsupportedError, match=r"DrudeForce.*DrudeLangevinIntegrator.*DrudeSCFIntegrator"):
        step(context)
    np.testing.assert_array_equal(state_of(context), before)
    assert context.getStepCount() == 0


@pytest.mark.parametrize("scheme", [*SCHEMES, "leapfrog"])
def test_drude_particles_are_refused_by_all_schemes(scheme):
    integrator = ProjectedIntegrator(0.0005, scheme)
    refused(integrator, lambda context: integrator.step(1))


@pytest.mark.parametrize(
    "ensemble", [Langevin(300, 1), Isokinetic(300), NoseHoover(300, 10)], ids=["Langevin", "Isokinetic", "NoseHoover"]
)
def test_drude_particles_are_refused_by_thermostats(ensemble):
    integrator = ProjectedIntegrator(0.0005, ensemble=ensemble)
    refused(integrator, lambda context: integrator.step(1))


def test_drude_particles_are_refused_by_the_compiled_integrator():
    integrator = RattleIntegrator(0.0005)
    refused(integrator, lambda context: integrator.step(1))
    refused(other := RattleIntegrator(0.0005), lambda context: other.setVelocitiesToTemperature(context, 300))


def test_drude_particles_are_refused_in_compound_integrators():
    compound, ours = openmm.CompoundIntegrator(), ProjectedIntegrator(0.0005)
    compound.addIntegrator(ours)
    refused(compound, lambda context: ours.check(context))
