"""A rigid body of four atoms in free flight, all six distances held: an asymmetric top.

Solution: Euler's equations and a quaternion.
"""

from __future__ import annotations

import numpy as np

from kcons.comparison.test_systems.minimal import integrated, spin, turned
from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import no_forces
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import BARE, Reference, TestSystem
from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

MASSES = np.array([1.0, 2.0, 1.5, 0.7])
POSITIONS = np.array(
    [
        [-0.6810050701294086, -0.04689210401958078, -0.0867483363253967],
        [0.3707170845488072, 0.17144232982387025, 0.678895565470517],
        [0.15133031135557973, -0.5747138913599262, -0.6354941550220699],
        [-0.4106065228593934, 0.8086832591596137, -0.4540022315464751],
    ]
)
VELOCITIES = np.array(
    [
        [0.13796480607479455, -0.8074444071755572, 0.31140198090556137],
        [0.0029354124267923906, 0.8044989900216032, 0.03721532090612076],
        [0.6146502709656857, -0.34002335920550963, 0.5848385341801507],
        [-0.7797300533955827, -0.7878836200848351, -0.31870060569718417],
    ]
)
PAIRS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def build(size: int, rng: int) -> TestSystem:
    """The body; its start is fixed."""
    lengths = np.linalg.norm(POSITIONS[PAIRS[:, 0]] - POSITIONS[PAIRS[:, 1]], axis=1)
    return TestSystem(
        name="rotor",
        title="asymmetric top, 4 atoms and 6 distances, in free flight",
        constraint_set=ConstraintSet(Distance(PAIRS), POSITIONS, MASSES),
        positions=POSITIONS,
        velocities=VELOCITIES,
        potential=no_forces(),
        symbols=["X"] * len(MASSES),
        horizon=10.0,
        time_steps=(0.1, 0.05, 0.025, 0.0125),
        tolerances=(1e-3, 1e-6, 1e-9),
        units=BARE,
        bonds=PAIRS,
        solution=lambda time: flight(POSITIONS, VELOCITIES, MASSES, time),
        openmm=OpenMMEngine(lambda: system_of(MASSES, pairs=PAIRS, lengths=lengths), length=1.0, time=1.0),
    )


def flight(x: FloatArray, v: FloatArray, masses: FloatArray, time: float) -> Reference:
    """Free flight of a rigid body that starts at x, v: I omega' = (I omega) x omega in body axes."""
    total = masses.sum()
    center, drift = masses @ x / total, masses @ v / total
    r = x - center
    inertia = np.sum(masses * np.einsum("ij,ij->i", r, r)) * np.eye(3) - np.einsum("i,ij,ik->jk", masses, r, r)
    omega = np.linalg.solve(inertia, masses @ np.cross(r, v - drift))

    def rate(_: float, y: FloatArray) -> FloatArray:
        w = y[4:]
        return np.concatenate([spin(y[:4], w), np.linalg.solve(inertia, np.cross(inertia @ w, w))])

    start = np.concatenate([[0.0, 0.0, 0.0, 1.0], omega])
    return integrated(
        rate, start, time, lambda y: center + drift * time + turned(y[:4], r), "Euler's equations and a quaternion"
    )


add_system("rotor", build, "asymmetric top of 4 atoms; Euler's equations", unit="rigid body", only=True)
