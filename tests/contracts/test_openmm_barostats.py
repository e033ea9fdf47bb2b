"""OpenMM's barostats beside our integrators: all is held, and volumes have their distribution.

Volumes of rigid ideal gases have an exact one: N is the number of molecules as OpenMM counts them, joined by
constraints of the System, by bonds, and by the bonds of no strength of `hold(..., join=True)`.
"""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm_systems import (
    DEVICE,
    GPUS,
    PLATFORMS,
    particles,
    residuals,
    started,
    state_of,
    volumes_under_pressure,
    water_box,
)
from pressure_systems import TRIANGLE, p_value, placed
from scipy import stats

from kcons.constraints import Distance
from kcons.openmm import Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, hold
from kcons.thermostats import mean

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
    "constant energy": lambda: ProjectedIntegrator(2e-3),
}
ON_DEVICE = {"device, Langevin": lambda: ProjectedIntegrator(2e-3, ensemble=Langevin(300, 1.0), device=True)}
CASES = [
    *((name, "isotropic", platform) for name in MADE for platform in PLATFORMS),
    *(("Langevin", barostat, "Reference") for barostat in BAROSTATS if barostat != "isotropic"),
    ("constant energy", "flexible", "CPU"),
    *(pytest.param(name, "isotropic", place, marks=DEVICE.marks) for name in ON_DEVICE for place in PLATFORMS),
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
    integrator = (MADE | ON_DEVICE)[name]()
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
@pytest.mark.parametrize("name", ["Langevin", pytest.param("constant energy", marks=pytest.mark.validation)])
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


# -- rigid ideal gases --------------------------------------------------------------------------------

N, SIDE, KT = 30, 6.0, 0.00831446261815324 * 300
#: In bar, for a mean volume of SIDE^3 with N molecules.
BAR = 16.6053906717
ENSEMBLES = {
    "Langevin": lambda: Langevin(300, 5.0),
    "NoseHoover": lambda: NoseHoover(300, 5.0, momentum="free"),
    "Isokinetic": lambda: Isokinetic(300, momentum="free"),
}
M = openmm.MonteCarloMembraneBarostat


def barostats(pressure):
    return {
        "isotropic": openmm.MonteCarloBarostat(pressure, 300, 1),
        "one axis": openmm.MonteCarloAnisotropicBarostat(openmm.Vec3(1, 1, pressure), 300, False, False, True, 1),
        "membrane": M(pressure, 0.0, 300, M.XYIsotropic, M.ZFixed, 1),
    }


def gas(sites=False):
    """Rigid triangles without forces in a periodic box, perhaps with a virtual site each."""
    x = placed(0.1 * TRIANGLE, N, SIDE, 3).reshape(N, 3, 3)
    x -= SIDE * np.round((x - x[:, :1]) / SIDE)
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(0.1)
    for _ in range((4 if sites else 3) * N):
        force.addParticle(0.0, 0.1, 0.0)
    pairs = [(3 * k + i, 3 * k + j) for k in range(N) for i, j in ((0, 1), (0, 2), (1, 2))]
    masses = [16.0, 1.0, 2.0] * N + [0.0] * (N if sites else 0)
    y = np.vstack([x.reshape(-1, 3), x[:, 0]])[: len(masses)]
    system = particles(masses, force, held=pairs, x=y)
    for k in range(N if sites else 0):
        site = openmm.ThreeParticleAverageSite(3 * k, 3 * k + 1, 3 * k + 2, 0.5, 0.25, 0.25)
        system.setVirtualSite(3 * N + k, site)
    system.setDefaultPeriodicBoxVectors(*(SIDE * np.eye(3)))
    return system, y


def volumes(system, integrator, x, barostat, count=1200, part=None):
    barostat.setRandomNumberSeed(7)
    system.addForce(barostat)
    integrator.setRandomNumberSeed(5)
    context = started(system, integrator, x)
    context.computeVirtualSites()
    context.setVelocitiesToTemperature(300, 3)
    if part is not None:
        context.applyVelocityConstraints(1e-10)
        part.apply_velocities(context)
    integrator.step(300)
    found = []
    for _ in range(count):
        integrator.step(1)
        found.append(context.getState().getPeriodicBoxVolume()._value)
    return np.array(found), context


def judge(found, n, pressure):
    exact = stats.gamma(n + 1, scale=KT / pressure)
    assert p_value(found, exact) > 0.01
    estimate = mean(found)
    assert estimate.error < 0.05 * exact.mean()
    assert abs(estimate.off(exact.mean())) < 3.5


PRESSURE = (N + 1) * KT / SIDE**3


@pytest.mark.parametrize(
    ("ensemble", "barostat", "sites"),
    [
        *(("Langevin", "isotropic", sites) for sites in (False, True)),
        *(("NoseHoover", "one axis", False), ("Isokinetic", "membrane", False)),
    ],
)
def test_volumes_of_a_rigid_ideal_gas(ensemble, barostat, sites):
    """Virtual sites move with their molecules."""
    system, x = gas(sites)
    integrator = ProjectedIntegrator(0.002, ensemble=ENSEMBLES[ensemble]())
    count = 800 if sites else 1200
    found, context = volumes(system, integrator, x, barostats(PRESSURE * BAR)[barostat], count)
    judge(found, N, PRESSURE)
    integrator.check()
    if sites:
        y, places = np.split(state_of(context)[0], [3 * N])
        assert places == pytest.approx(np.tensordot([0.5, 0.25, 0.25], y.reshape(N, 3, 3), (0, 1)), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("joined", [pytest.param(False, marks=pytest.mark.validation), True])
def test_carried_rows_within_and_across_molecules(joined):
    """Two molecules with a row between them are one, and N is less by one for each such pair."""
    system, x = gas()
    pairs = np.arange(0, 3 * N, 6)
    if joined:
        x = x.reshape(N, 3, 3)
        x[1::2] += (x[0::2, :1] - x[1::2, :1]) + 0.4
        x = x.reshape(-1, 3)
        rows = Distance(np.stack([pairs, pairs + 3], axis=1))
    else:
        rows = Distance(np.array([[0, 1]]) + pairs[:, None])
    part = hold(system, rows, x, join=joined)
    n = N // 2 if joined else N
    pressure = (n + 1) * KT / SIDE**3
    integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300, 5.0), parts=[part])
    found, context = volumes(system, integrator, x, barostats(pressure * BAR)["isotropic"], 800, part)
    assert len(context.getMolecules()) == n
    judge(found, n, pressure)
    part.check(context)
