"""Particles on surfaces of every kind in a smooth potential, for OpenMM and for kcons' own steppers."""

from __future__ import annotations

import numpy as np
import openmm
import openmm_systems
from openmm import unit
from openmm_systems import field, pairs_force, particles, state_of

from kcons.constraints import Ellipsoid, Formula, Plane, Sphere, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.openmm import SurfaceIntegrator
from kcons.steppers import State
from kcons.steppers import System as CoreSystem

#: Neither a multiple of the identity nor along an axis.
TURN = np.linalg.qr(np.array([[1.0, 0.4, -0.3], [0.2, 1.0, 0.5], [-0.6, 0.1, 1.0]]))[0]
CENTER = np.array([0.3, -0.2, 0.5])
FORMULA = "b*x1**2 + y1**2 + 2*z1**2 + 0.3*x1*y1*z1"


KINDS = {
    "sphere": lambda atoms, x: Sphere(atoms, CENTER),
    "cylinder": lambda atoms, x: Ellipsoid(atoms, CENTER, [1, 1, np.inf], target=None),
    "tilted cylinder": lambda atoms, x: Ellipsoid(atoms, CENTER, [1, np.inf, 1], TURN, None),
    "plane": lambda atoms, x: Plane(atoms, [2, 1, -1]),
    "ellipsoid": lambda atoms, x: Ellipsoid(atoms, CENTER, [0.9, 1.2, 1.6], target=None),
    "rotated ellipsoid": lambda atoms, x: Ellipsoid(atoms, CENTER, [0.9, 1.2, 1.6], TURN, target=None),
    "torus": lambda atoms, x: Torus(atoms, CENTER, TURN[0], 1.2),
    # Each particle on a level of its own.
    "formula": lambda atoms, x: Formula(FORMULA, atoms, {"b": 1.5}, target=None),
}

MASSES = np.array([1.0, 2.5, 40.0])
POSITIONS = np.array([[1.2, 0.3, 0.8], [-0.5, 0.7, 0.1], [0.6, -1.0, 1.3]])
VELOCITIES = np.array([[0.4, 0.9, -0.2], [-0.3, 0.5, 0.8], [0.1, -0.2, 0.15]])
POTENTIAL = "0.8*x + 0.5*y^2 + 0.7*x*z + 0.1*z^4"


def force_of(x, t=0.0):
    """Minus the gradient of POTENTIAL and of springs of strength 0.3 between all pairs."""
    X, Y, Z = x.T
    f = -np.stack([0.8 + 0.7 * Z, Y, 0.7 * X + 0.4 * Z**3], axis=1)
    return f - 0.3 * (len(x) * x - x.sum(axis=0))


def system_of(masses=MASSES, potential=POTENTIAL, springs=0.3):
    pairs = [(j, k) for k in range(len(masses)) for j in range(k)]
    bonds = [pairs_force(openmm.CustomBondForce(f"0.5*{springs}*r^2"), *pairs)] if springs else []
    return particles(masses, field(potential, len(masses)), *bonds)


def started(system, integrator, x, v, platform="Reference"):
    context = openmm_systems.started(system, integrator, x, v, platform)
    integrator.applyVelocityConstraints(context)
    return context


def on_surface(kind, scheme, dt, platform="Reference", *, atoms=(0, 1, 2), **arguments):
    """Integrator and context of the three particles, those of `atoms` on surfaces of one kind."""
    atoms = np.array(atoms)
    system = system_of()
    options = {"surfaces": KINDS[kind](atoms, POSITIONS[atoms]), "system": system, "device": False} | arguments
    integrator = SurfaceIntegrator(dt * unit.picosecond, scheme, positions=POSITIONS, **options)
    return integrator, started(system, integrator, POSITIONS, VELOCITIES, platform)


def energy_of(context, integrator):
    """kJ/mol, without the energies that carry surfaces."""
    state = context.getState(energy=True, groups=set(range(32)) - integrator.row_groups)
    return (state.getPotentialEnergy() + state.getKineticEnergy()).value_in_unit(unit.kilojoule_per_mole)


def worst(integrator, context):
    """Largest distance from a surface (nm), and velocity across one relative to the speed."""
    x, v = state_of(context)
    rows = integrator.surfaces
    slopes = [item.gradient(x[item.atoms], 0.0)[:, 0] for item in rows]
    sizes = [np.linalg.norm(slope, axis=1) for slope in slopes]
    off = max(
        np.abs((item.measure(x[item.atoms], 0.0) - item.target_at(0.0)) / size).max()
        for item, size in zip(rows, sizes, strict=True)
    )
    held = [v[item.atoms[:, 0]] for item in rows]
    across = max(
        (np.abs(np.einsum("ij,ij->i", slope, u)) / size / np.linalg.norm(u, axis=1)).max()
        for slope, size, u in zip(slopes, sizes, held, strict=True)
    )
    return off, across


def core_run(kind, stepper, dt, steps, atoms=(0, 1, 2)):
    """The same motion by kcons' own steppers: positions and velocities."""
    atoms = np.array(atoms)
    rows = KINDS[kind](atoms, POSITIONS[atoms])
    motion = Motion(ConstraintSet(rows, POSITIONS, MASSES), POSITIONS)
    system = CoreSystem(motion, force_of)
    state: State = system.initial_state(POSITIONS, VELOCITIES, project=True)
    for _ in range(steps):
        state = stepper.step(system, state, dt)
    return state.positions, state.velocities
