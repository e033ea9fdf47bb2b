"""Systems with virtual sites, and starts at 300 K."""

from __future__ import annotations

from functools import cache

import numpy as np
import openmm
from openmm import app
from openmm_systems import masses_of, started, state_of

from kcons.openmm import ProjectedIntegrator


def water(model, molecules=8):
    """Some molecules of a box of water, without walls."""
    field = app.ForceField("tip5p.xml" if model == "tip5p" else "amber14/tip4pew.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, model="tip5p" if model == "tip5p" else "tip4pew", boxSize=openmm.Vec3(1.9, 1.9, 1.9))
    box.delete(list(box.topology.residues())[molecules:])
    system = field.createSystem(box.topology, removeCMMotion=False)
    if model == "tip4pd":
        nonbonded = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
        for first in range(0, system.getNumParticles(), 4):
            for k, charge in enumerate((0.0, 0.58, 0.58, -1.16)):
                nonbonded.setParticleParameters(first + k, charge, 0.3165, 0.0 if k else 0.936554)
            share = 0.01546 / (2 * 0.09572 * np.cos(np.radians(104.52 / 2)))
            place = openmm.ThreeParticleAverageSite(first, first + 1, first + 2, 1 - 2 * share, share, share)
            system.setVirtualSite(first + 3, place)
    return system, box.positions


def mixed_sites():
    """Two rigid triangles, whose charges sit on an average of two, an out-of-plane and a local-coordinates site."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    x = []
    for n in range(2):
        first = system.getNumParticles()
        for m in (16.0, 2.0, 3.0, 0.0, 0.0, 0.0):
            system.addParticle(m)
            force.addParticle(0.0, 0.25, 0.4 if m == 16.0 else 0.0)
        a, b, c, pair, plane, local = range(first, first + 6)
        for i, j, d in ((a, b, 0.1), (a, c, 0.12), (b, c, 0.15)):
            system.addConstraint(i, j, d)
        system.setVirtualSite(pair, openmm.TwoParticleAverageSite(b, c, 0.3, 0.7))
        system.setVirtualSite(plane, openmm.OutOfPlaneSite(a, b, c, -0.3, -0.3, 4.0))
        system.setVirtualSite(
            local,
            openmm.LocalCoordinatesSite(
                [a, b, c], [0.5, 0.3, 0.2], [-1.0, 0.5, 0.5], [0.0, -1.0, 1.0], openmm.Vec3(0.03, 0.02, -0.04)
            ),
        )
        for site, charge in ((pair, 0.8), (plane, -0.5), (local, -0.3)):
            force.setParticleParameters(site, charge, 0.1, 0.0)
        for i in range(6):
            for j in range(i):
                force.addException(first + i, first + j, 0, 1, 0)
        height = (0.1**2 - 0.12**2 + 0.15**2) / 0.3
        x += [[0, np.sqrt(0.1**2 - height**2), 0.32 * n], [-height, 0, 0.32 * n], [0.15 - height, 0, 0.32 * n]]
        x += [[0.0, 0.0, 0.0]] * 3
    system.addForce(force)
    return system, np.array(x)


@cache
def prepared(model):
    """A System, and a start at 300 K on its constraints."""
    system, positions = mixed_sites() if model == "mixed" else water(model)
    context = started(system, ProjectedIntegrator(1e-3, tolerance=1e-12), positions)
    integrator = context.getIntegrator()
    context.computeVirtualSites()
    openmm.LocalEnergyMinimizer.minimize(context, 1, 200)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(100)
    x, v = state_of(context)
    masses = masses_of(system)[:, None]
    return system, x, np.where(masses > 0, v - np.sum(masses * v, axis=0) / masses.sum(), 0.0)
