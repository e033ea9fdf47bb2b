"""Eight particles tied by springs, and integrators that move them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import openmm
from openmm_systems import context_of

from kcons.openmm import (
    ProjectedIntegrator,
)

X = np.random.default_rng(3).random((8, 3)) * 0.3


MASSES = np.full(8, 12.0)


EVERYTHING = {"positions": True, "velocities": True, "parameters": True, "integratorParameters": True}


def cluster(strength=200.0, bonded=False):
    """Eight particles tied by springs to one another and to a place; with `bonded`, one distance held by OpenMM."""
    system, force, field = openmm.System(), openmm.HarmonicBondForce(), openmm.CustomExternalForce("50*(x^2+y^2+z^2)")
    for i in range(8):
        field.addParticle(system.addParticle(MASSES[i]), [])
        for j in range(i):
            force.addBond(i, j, 0.3, strength)
    system.addForce(force)
    system.addForce(field)
    if bonded:
        system.addConstraint(6, 7, float(np.linalg.norm(X[6] - X[7])))
    return system


@dataclass
class Made:
    """An integrator with its Context, and what can be asked of it."""

    integrator: Any
    context: openmm.Context
    part: Any = None

    def run(self, steps=1):
        self.integrator.step(steps)
        return self.context.getState(**EVERYTHING)


def thermostatted(ensemble, **options):
    def make(strength=200.0):
        integrator = ProjectedIntegrator(0.002, ensemble=ensemble, **options)
        return begun(cluster(strength, bonded=True), integrator)

    return make


def begun(system, integrator, restore=None, part=None):
    context = context_of(system, integrator)
    context.setPositions(X)
    context.setVelocities(0.3 * np.random.default_rng(1).normal(size=X.shape))
    if restore is not None:
        restore(context)
    return Made(integrator, context, part)
