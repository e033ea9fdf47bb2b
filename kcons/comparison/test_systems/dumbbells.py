"""Two rigid Lennard-Jones dumbbells that collide, in reduced units."""

from __future__ import annotations

from typing import Any

import numpy as np

from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import TestSystem, Units
from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

REDUCED = Units("σ", "ε", "τ", 1.0, "τ", 1.0)

MASSES = np.array([1.0, 2.0, 1.5, 0.8])
LENGTHS = np.array([1.0, 1.1])
POSITIONS = np.array(
    [
        [-2.003970775632096, 0.16655561109788544, -0.4337091906147089],
        [-2.2980146121839518, 0.06672219445105729, 0.5168545953073544],
        [2.5075745147687605, -0.313068600809556, -0.2974913247826058],
        [1.6232977848085741, 0.012003626517917521, 0.2702962339673859],
    ]
)
VELOCITIES = np.array(
    [
        [1.147583117862048, 0.19900083305560515, 0.14748659089852048],
        [0.776208441068976, -0.09950041652780257, 0.0012567045507397556],
        [-0.8797168730164893, 0.09310400960265507, -0.16600550253211768],
        [-0.6505308630940826, -0.11707001800497825, 0.31126031724772063],
    ]
)
PAIRS = np.array([[0, 1], [2, 3]])


def build(size: int, rng: int) -> TestSystem:
    """Two dumbbells that collide, from a fixed start."""
    return TestSystem(
        name="dumbbells",
        title="collision of two rigid Lennard-Jones dumbbells, no cutoff",
        constraint_set=ConstraintSet(Distance(PAIRS, LENGTHS), POSITIONS, MASSES),
        positions=POSITIONS,
        velocities=VELOCITIES,
        potential=Potential(attraction, "Lennard-Jones"),
        symbols=["Ar"] * 4,
        horizon=5.0,
        time_steps=(0.01, 0.005, 0.0025, 0.00125),
        tolerances=(1e-4, 1e-7, 1e-10),
        units=REDUCED,
        bonds=PAIRS,
        openmm=OpenMMEngine(_collision_system, length=1.0, time=1.0),
    )


def attraction(x: FloatArray) -> tuple[float, FloatArray]:
    """Lennard-Jones energy and forces between the atoms 0, 1 and 2, 3."""
    d = x[:2, None] - x[None, 2:]
    squared = np.sum(d * d, axis=2)
    s6 = squared**-3
    push = (24.0 * (2.0 * s6 * s6 - s6) / squared)[..., None] * d
    return 4.0 * float(np.sum(s6 * s6 - s6)), np.concatenate([push.sum(axis=1), -push.sum(axis=0)])


def _collision_system() -> Any:
    import openmm

    force = openmm.CustomBondForce("4*(r^-12-r^-6)")
    for i in (0, 1):
        for j in (2, 3):
            force.addBond(i, j)
    return system_of(MASSES, force, pairs=PAIRS, lengths=LENGTHS)


add_system("dumbbells", build, "collision of two rigid dumbbells", size=2, unit="collision of two dumbbells", only=True)
