"""Minimization of the energy on the constraints."""

from __future__ import annotations

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError
from kcons.openmm.quantities import forces_at, masses_of, positions_of, velocities_of

#: Longest way of a particle in one step, nm.
_STRIDE = 0.01


def descend(integrator: openmm.Integrator, context: openmm.Context, tolerance: float, iterations: int) -> None:
    """Fast inertial relaxation along the constraints of the System and of the parts.

    Velocities are the search direction in the mass metric: each step projects f/m, turns v towards it, goes, and
    brings x back onto the constraints. Velocities of the context stay as they were. It ends where the root mean square
    of the projected force components is below a tolerance (kJ/mol/nm), or after so many iterations (0: 50,000);
    `ConvergenceError` where the constraints cannot be reached, however short the steps.

    References
    ----------
    Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006).
    """
    system = context.getSystem()
    masses = masses_of(system)[:, None]
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    groups = integrator.getIntegrationForceGroups()
    kept = velocities_of(context)
    dt, alpha, since_turn = 1e-3, 0.1, 0
    v = np.zeros((len(masses), 3))
    try:
        integrator.applyConstraints(context)
        for _ in range(iterations or 50_000):
            pull = _tangent(integrator, context, forces_at(context, groups) * inverse)
            if np.sqrt(np.mean((masses * pull) ** 2)) <= tolerance:
                return
            v = _tangent(integrator, context, v + dt * pull)
            if np.sum(masses * v * pull) > 0:
                since_turn += 1
                v = (1 - alpha) * v + alpha * pull * (_size(v, masses) / _size(pull, masses))
                if since_turn > 5:
                    dt, alpha = 1.1 * dt, 0.99 * alpha
            else:
                v[:], alpha, since_turn = 0.0, 0.1, 0
                dt *= 0.5
            dt, v = _move(integrator, context, v, dt)
    finally:
        context.setVelocities(kept)


def _move(integrator: openmm.Integrator, context: openmm.Context, v: FloatArray, dt: float) -> tuple[float, FloatArray]:
    x = positions_of(context)
    for _ in range(30):
        stride = dt * v
        longest = float(np.sqrt(np.max(np.sum(stride**2, axis=1))))
        context.setPositions(x + stride * min(1.0, _STRIDE / longest if longest > 0 else 1.0))
        try:
            integrator.applyConstraints(context)
            return dt, v
        except ConvergenceError:
            dt, v = 0.25 * dt, 0.25 * v
    context.setPositions(x)
    raise ConvergenceError("the constraints cannot be kept along the descent, however short the steps")


def _tangent(integrator: openmm.Integrator, context: openmm.Context, v: FloatArray) -> FloatArray:
    context.setVelocities(v)
    integrator.applyVelocityConstraints(context)
    return velocities_of(context)


def _size(v: FloatArray, masses: FloatArray) -> float:
    return float(np.sqrt(np.sum(masses * v * v)))
