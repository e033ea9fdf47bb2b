"""Systems for steps on the device."""

from __future__ import annotations

import numpy as np
from openmm_systems import field, masses_of, particles, started, state_of, water_box

from kcons.openmm import DeviceIntegrator


def waters(n=8, groups=False):
    """Rigid water on its constraints to rounding, moving along them; in a field of its own group where asked for."""
    system, x = water_box(n, exact=True)  # OpenMM keeps the lengths of rigid water as single numbers
    if groups:
        # As periodic as the box: GPUs compute it where they have moved molecules to.
        text = f"20*(sin({2 * np.pi / 0.62}*x)+cos({2 * np.pi / 0.62}*(y+z)))"
        system.addForce(field(text, system.getNumParticles(), group=1))
    rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    held = particles(masses_of(system), held=rows)
    # kcons' own rows reach what OpenMM's solvers leave.
    context = started(held, DeviceIntegrator(1e-9, tolerance=1e-14), x)
    context.setVelocitiesToTemperature(300, 1)
    context.applyVelocityConstraints(1e-12)
    context.getIntegrator().step(1)
    x, v = state_of(context)
    masses = masses_of(system)
    return system, x, v - masses @ v / masses.sum()


def dumbbells(n, masses, *forces):
    """n of them with their first atoms at the origin, turned at random, 0.1 nm long; and positions."""
    turned = np.random.default_rng(0).normal(size=(n, 3))
    x = np.zeros((2 * n, 3))
    x[1::2] = 0.1 * turned / np.linalg.norm(turned, axis=1)[:, None]
    return particles(list(masses) * n, *forces, held=[(2 * k, 2 * k + 1, 0.1) for k in range(n)]), x
