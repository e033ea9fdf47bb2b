"""AMOEBA: polarisable multipoles are forces like any others, and steps on constraints are what they are elsewhere."""

from __future__ import annotations

from functools import cache

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import started, state_of, total_energy

from kcons.openmm import ProjectedIntegrator

#: A Context with AMOEBA takes OpenMM 13 s here.
pytestmark = pytest.mark.validation

BOND, ANGLE = 0.09572, np.radians(104.52)
polarization = pytest.mark.parametrize("kind", ["direct", "mutual"])


@cache
def waters(kind, rigid=True):
    """Four molecules of AMOEBA water, minimized, and velocities of 200 K."""
    topology, x = app.Topology(), []
    chain = topology.addChain()
    for k in range(4):
        residue = topology.addResidue("HOH", chain)
        oxygen = topology.addAtom("O", app.element.oxygen, residue)
        for name in ("H1", "H2"):
            topology.addBond(oxygen, topology.addAtom(name, app.element.hydrogen, residue))
        turn, _ = np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))
        arms = BOND * np.array([[0, 0, 0], [1, 0, 0], [np.cos(ANGLE), np.sin(ANGLE), 0]])
        x.append(np.array([0.3 * (k % 2), 0.3 * (k // 2), 0.02 * k]) + arms @ turn.T)
    system = app.ForceField("amoeba2018.xml").createSystem(
        topology,
        nonbondedMethod=app.NoCutoff,
        rigidWater=rigid,
        polarization=kind,
        mutualInducedTargetEpsilon=1e-6,
    )
    context = started(system, openmm.VerletIntegrator(1e-3), np.concatenate(x))
    context.applyConstraints(1e-10)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 20)
    context.applyConstraints(1e-10)
    context.setVelocitiesToTemperature(200, 3)
    context.applyVelocityConstraints(1e-10)
    return system, *state_of(context)


@polarization
def test_energy_is_conserved_to_second_order_and_as_by_verlet(kind):
    """Verlet takes the first velocities for those of half a step before: another motion of the same energy."""
    system, x, v = waters(kind)
    spread = {}
    for integrate in (openmm.VerletIntegrator, ProjectedIntegrator):
        for dt in (1e-3, 5e-4):
            integrator = integrate(dt)
            integrator.setConstraintTolerance(1e-10)
            context = started(system, integrator, x, v)
            energies = []
            for _ in range(round(0.1 / (10 * dt))):
                integrator.step(10)
                energies.append(total_energy(context))
            spread[integrate, dt] = np.std(energies)
    assert 1.7 < np.log2(spread[ProjectedIntegrator, 1e-3] / spread[ProjectedIntegrator, 5e-4]) < 2.3
    for dt in (1e-3, 5e-4):
        assert spread[ProjectedIntegrator, dt] == pytest.approx(spread[openmm.VerletIntegrator, dt], rel=0.05)
