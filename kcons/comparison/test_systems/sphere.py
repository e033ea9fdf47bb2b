"""Particles on spheres, in reduced units (m = R = 1): moving freely, and as spherical pendulums.

Both solutions are independent of the engine: great circles in closed form, and the pendulum's own
equation of motion integrated to twelve digits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import Potential, no_forces, uniform_field
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import REDUCED, Reference, TestSystem
from kcons.constraints import Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

RADIUS = 1.0
#: The start near the top: angles from it, and speeds. What a method does wrong there is magnified a hundred times.
TILT, SLOW = 0.02, 0.01


def build(size: int, rng: int, *, gravity: float = 0.0, near_top: bool = False) -> TestSystem:
    """`size` particles, each on its own sphere of radius 1, with speeds between 0.5 and 1."""
    generator = np.random.default_rng(rng)
    n: FloatArray = generator.standard_normal((size, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    if near_top:
        n *= TILT / np.hypot(n[:, 0], n[:, 1])[:, None]
        n[:, 2] = np.sqrt(1.0 - TILT * TILT)
    v = np.cross(n, generator.standard_normal((size, 3)))
    v *= (SLOW if near_top else 1.0) * generator.uniform(0.5, 1.0, (size, 1)) / np.linalg.norm(v, axis=1)[:, None]
    centers = 4.0 * np.stack([np.arange(size), np.zeros(size), np.zeros(size)], axis=1)
    x = np.asarray(centers + RADIUS * n, dtype=float)
    masses = np.ones(size)

    def great_circles(time: float) -> Reference:
        speed = np.linalg.norm(v, axis=1)[:, None]
        angle = speed * time / RADIUS
        ends: FloatArray = np.add(centers, RADIUS * (np.cos(angle) * n + np.sin(angle) * v / speed), dtype=np.float64)
        return Reference(ends, 0.0, "great circles")

    def pendulums(time: float) -> Reference:
        ends = [swing(RADIUS * n[k], v[k], gravity, time) for k in range(size)]
        coarse = [swing(RADIUS * n[k], v[k], gravity, time, rtol=1e-11) for k in range(size)]
        error = float(np.sqrt(np.mean(np.sum((np.array(ends) - coarse) ** 2, axis=1))))
        there: FloatArray = np.add(centers, ends, dtype=np.float64)
        return Reference(there, error, "the pendulum's own equation, DOP853 at rtol 2.3e-14")

    spheres = Sphere(np.arange(size), centers, RADIUS)
    what = f"spherical pendulums, g = {gravity:g}" if gravity else "free particles on spheres"
    if near_top:
        what += f", {TILT:g} rad from upright"
    return TestSystem(
        name="sphere-pendulum-top" if near_top else "sphere-pendulum" if gravity else "sphere",
        title=f"{size} {what}; units R, τ = R/v0, ε = m v0²",
        constraint_set=ConstraintSet(spheres, x, masses),
        positions=x,
        velocities=v,
        potential=Potential(uniform_field(masses, gravity), "uniform field") if gravity else no_forces(),
        symbols=["X"] * size,
        horizon=8.0 if near_top else 4.0,
        time_steps=(0.2, 0.1, 0.05, 0.025),
        tolerances=(1e-3, 1e-6, 1e-9),
        units=REDUCED,
        refusals=dict.fromkeys(("ase-bonds", "ase-internals"), "ASE has no constraint that holds an atom on a sphere"),
        solution=pendulums if gravity else great_circles,
        openmm=OpenMMEngine(lambda: _system(masses, gravity), length=1.0, time=1.0, surfaces=[spheres]),
    )


def swing(x: FloatArray, v: FloatArray, gravity: float, time: float, *, rtol: float = 2.3e-14) -> FloatArray:
    """Where a spherical pendulum, hung at the origin, is after `time`, shape (3,).

    x'' = g - (g.x + v.v) x/|x|^2, the closed form of the projected equation (notes eq. 110).
    """
    g = np.array([0.0, 0.0, -gravity])

    def rate(_: float, y: FloatArray) -> FloatArray:
        r, u = y[:3], y[3:]
        return np.concatenate([u, g - (g @ r + u @ u) / (r @ r) * r])

    end = solve_ivp(rate, (0.0, time), np.concatenate([x, v]), method="DOP853", rtol=rtol, atol=1e-15).y[:3, -1]
    return np.asarray(end * (np.linalg.norm(x) / np.linalg.norm(end)))


def _system(masses: FloatArray, gravity: float) -> Any:
    import openmm

    field = openmm.CustomExternalForce(f"{gravity!r}*z")
    for k in range(len(masses)):
        field.addParticle(k)
    return system_of(masses, *([field] if gravity else []))


for _name, _text, _options in (
    ("sphere", "free particles on spheres; closed form", {}),
    ("sphere-pendulum", "spherical pendulums", {"gravity": 1.0}),
    ("sphere-pendulum-top", "spherical pendulums from near the top", {"gravity": 1.0, "near_top": True}),
):
    add_system(_name, build, _text, size=10, quick_size=2, unit="particles", options=_options)
