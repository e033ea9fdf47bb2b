"""Charges on a sphere, and on other surfaces: they move along the surface, then go to a minimum of the energy.

Run with ``python examples/particles_on_a_surface.py``; a few seconds. Twelve charges on a sphere end at the corners of
an icosahedron, whose energy is known: 49.165253058 in units of q²/R (Thomson's problem).
"""

import numpy as np

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Ellipsoid, Formula, Sphere, Torus
from kcons.motion import minimize

n = 12
atoms, origin = np.arange(n), [0.0, 0.0, 0.0]
surfaces = {
    "sphere": Sphere(atoms, origin, 1.0),
    "ellipsoid": Ellipsoid(atoms, origin, [1.0, 1.2, 1.5]),
    "torus": Torus(atoms, origin, [0.0, 0.0, 1.0], 1.0, 0.4),
    "your own": Formula("x1**4 + y1**4 + z1**4 - 1", atoms),
}


def repulsion(x, t=0.0):
    d = x[:, None] - x[None]
    return np.sum(d / (np.linalg.norm(d, axis=-1, keepdims=True) ** 3 + 1e-30), axis=1)


def energy(x):
    return sum(1.0 / np.linalg.norm(x[i] - x[j]) for i in range(n) for j in range(i))


print("surface     energy changes by   off the surface   energy at the minimum")
for name, surface in surfaces.items():
    x = np.random.default_rng(1).normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    held = ConstraintSet(surface, x, np.ones(n))
    x = Motion(held, x).restore_positions(x)  # to the surface
    motion = Motion(held, x)

    system = System(motion, repulsion)
    end = run(system, system.initial_state(x, np.zeros_like(x)), 0.005, 400)
    change = energy(end.positions) + 0.5 * np.sum(end.velocities**2) - energy(x)
    off = np.abs(held.value(end.positions)).max()
    found = energy(minimize(motion, repulsion, end.positions, tolerance=1e-9, longest=0.2).positions)
    print(f"{name:10s} {change:16.1e} {off:17.0e} {found:22.8f}")
    assert off < 1e-12 and abs(change) < 1e-2 * energy(x)
    assert name != "sphere" or abs(found - 49.165253058) < 1e-8
