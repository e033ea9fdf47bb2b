"""Constant pressure: volumes change, everything stays held, and the density is that of OpenMM's own dynamics."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_systems import GPUS, PLATFORMS, context_of, residuals, started, state_of, volumes_under_pressure, water_box

from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, RattleIntegrator

BAROSTATS = {
    "isotropic": openmm.MonteCarloBarostat(1.0, 300.0, 2),
    "anisotropic": openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, 1), 300.0, True, False, True, 2),
    "membrane": openmm.MonteCarloMembraneBarostat(
        1.0, 0.0, 300.0, openmm.MonteCarloMembraneBarostat.XYIsotropic, openmm.MonteCarloMembraneBarostat.ZFree, 2
    ),
    "flexible": openmm.MonteCarloFlexibleBarostat(1.0, 300.0, 2),
}
MADE = {
    "Langevin": lambda: ProjectedIntegrator(2e-3, ensemble=Langevin(300, 1.0)),
    "Isokinetic": lambda: ProjectedIntegrator(2e-3, ensemble=Isokinetic(300, momentum="conserved")),
    "NoseHoover": lambda: ProjectedIntegrator(2e-3, ensemble=NoseHoover(300, 1.0)),
    "RattleIntegrator": lambda: RattleIntegrator(2e-3),
}
CASES = [
    *((name, "isotropic", platform) for name in MADE for platform in PLATFORMS),
    *(("Langevin", barostat, "Reference") for barostat in BAROSTATS if barostat != "isotropic"),
    ("RattleIntegrator", "flexible", "CPU"),
]


def pressed(barostat, n=27):
    """Waters under a barostat, with a cutoff that leaves room: OpenMM stops where a small box tilts to twice of it."""
    system, x = water_box(n)
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    nonbonded.setCutoffDistance(0.75 * nonbonded.getCutoffDistance())
    force = copy.copy(BAROSTATS[barostat])
    force.setRandomNumberSeed(5)
    system.addForce(force)
    system.addForce(openmm.CMMotionRemover(10))
    return system, x


@pytest.mark.parametrize(("name", "barostat", "platform"), CASES)
def test_volumes_change_and_all_is_held(name, barostat, platform):
    """Checked at each look, and by the integrator at the end."""
    system, x = pressed(barostat)
    integrator = MADE[name]()
    context = started(system, integrator, x, None, platform)
    volumes = volumes_under_pressure(system, integrator, context)
    assert len(volumes) > 5
    assert max(volumes) / min(volumes) < 1.5
    integrator.check()
    if barostat == "anisotropic":  # y keeps its length
        box = context.getState().getPeriodicBoxVectors(asNumpy=True)._value
        before = [row._value for row in system.getDefaultPeriodicBoxVectors()]
        assert box[1, 1] == pytest.approx(before[1][1], rel=1e-6)
        assert abs(box[0, 0] - before[0][0]) > 1e-6


@pytest.mark.parametrize("platform", [p for p in GPUS if "mixed" in p.id or "none" in p.id])
@pytest.mark.parametrize("name", ["Langevin", pytest.param("RattleIntegrator", marks=pytest.mark.validation)])
def test_on_gpus(name, platform):
    system, x = pressed("isotropic")
    there = started(system, openmm.VerletIntegrator(1e-3), x, None, "CPU")
    openmm.LocalEnergyMinimizer.minimize(there, 10, 20)
    integrator = MADE[name]()
    context = started(system, integrator, state_of(there)[0], None, platform)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    volumes = set()
    for _ in range(10):
        integrator.step(8)
        volumes.add(context.getState().getPeriodicBoxVolume()._value)
        assert residuals(system, context)[0] < 2e-7
    assert len(volumes) > 3
    integrator.check()


def densities(make, blocks, steps, x, system):
    """Mean densities (kg/l) of blocks of a run, the first two left out."""
    integrator = make()
    integrator.setRandomNumberSeed(3)
    context = context_of(system, integrator, "CPU")
    context.setPositions(x)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(300, 1)
    mass = sum(system.getParticleMass(k)._value for k in range(system.getNumParticles())) * 1.66053907e-3
    means = []
    for _ in range(blocks):
        found = []
        for _ in range(steps // 20):
            integrator.step(20)
            found.append(mass / context.getState().getPeriodicBoxVolume().value_in_unit(unit.nanometer**3))
        means.append(np.mean(found))
    return np.array(means[2:])


@pytest.mark.validation
@pytest.mark.parametrize("name", ["Langevin", "Isokinetic", "NoseHoover"])
def test_density_is_that_of_openmm(name):
    """64 waters; standard errors from blocks of 10 ps, which are long beside the correlation time of the volume."""
    system, x = pressed("isotropic", 64)
    ours = densities(MADE[name], 12, 5000, x, system)
    theirs = densities(lambda: openmm.LangevinMiddleIntegrator(300, 1.0, 2e-3), 12, 5000, x, system)
    error = np.sqrt(sum(np.var(found, ddof=1) / len(found) for found in (ours, theirs)))
    assert error < 0.02
    assert abs(ours.mean() - theirs.mean()) < 3.5 * error
