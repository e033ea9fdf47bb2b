"""Systems for steps on the device."""

from __future__ import annotations

import numpy as np
import openmm
from openmm_systems import masses_of, started, state_of, water_box

from kcons.openmm import DeviceIntegrator


def waters(n=8, groups=False):
    """Rigid water on its constraints to rounding, moving along them; in a field of its own group where asked for."""
    system, x = water_box(n, exact=True)  # OpenMM keeps the lengths of rigid water as single numbers
    if groups:
        # As periodic as the box: GPUs compute it where they have moved molecules to.
        field = openmm.CustomExternalForce(f"20*(sin({2 * np.pi / 0.62}*x)+cos({2 * np.pi / 0.62}*(y+z)))")
        for k in range(system.getNumParticles()):
            field.addParticle(k)
        field.setForceGroup(1)
        system.addForce(field)
    held = openmm.System()
    for mass in masses_of(system):
        held.addParticle(mass)
    for k in range(system.getNumConstraints()):
        held.addConstraint(*system.getConstraintParameters(k))
    # kcons' own rows reach what OpenMM's solvers leave.
    context = started(held, DeviceIntegrator(1e-9, tolerance=1e-14), x)
    context.setVelocitiesToTemperature(300, 1)
    context.applyVelocityConstraints(1e-12)
    context.getIntegrator().step(1)
    x, v = state_of(context)
    masses = masses_of(system)
    return system, x, v - masses @ v / masses.sum()
