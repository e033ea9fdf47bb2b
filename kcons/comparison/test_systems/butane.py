"""A chain of four atoms with bonds and angles held and a free torsion, k (1 + cos 3 phi), in free flight."""

from __future__ import annotations

import numpy as np

from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import BARE, TestSystem
from kcons.constraints import Angle, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

MASSES = np.array([1.5, 1.0, 1.2, 2.0])
LENGTHS = (1.0, 1.1, 0.9)
ANGLES = (1.9, 2.0)
BARRIER = 0.8
POSITIONS = np.array(
    [
        [-0.5222284052877127, 0.8165610926072225, 0.24597860628670823],
        [0.0, 0.0, 0.0],
        [1.0726873599219975, 0.21744449281949224, 0.10981675831151097],
        [1.317274914365431, 0.4903896668543006, 0.9318130236208423],
    ]
)
VELOCITIES = np.array(
    [
        [-0.0701639869182561, -0.23806819562769413, -0.08489628217113311],
        [0.1, -0.2, 0.15],
        [0.05640165024592506, 0.07035356216888246, 0.04054954181941717],
        [0.14987079439327575, -0.31847001788834944, 0.14184699760931987],
    ]
)
BONDS = np.array([[0, 1], [1, 2], [2, 3]])
TRIPLES = np.array([[0, 1, 2], [1, 2, 3]])


def build(size: int, rng: int) -> TestSystem:
    """One molecule; its start is fixed."""
    return TestSystem(
        name="butane",
        title=f"four-atom chain, 3 bonds and 2 angles held, torsion {BARRIER:g} (1 + cos 3φ)",
        constraint_set=ConstraintSet([Distance(BONDS, LENGTHS), Angle(TRIPLES, ANGLES)], POSITIONS, MASSES),
        positions=POSITIONS,
        velocities=VELOCITIES,
        potential=Potential(torsion, "torsion"),
        symbols=["C"] * 4,
        horizon=5.0,
        time_steps=(0.1, 0.05, 0.025, 0.0125),
        tolerances=(1e-3, 1e-6, 1e-9),
        units=BARE,
        # Between held arms, an angle is the distance of its ends.
        bonds=np.concatenate([BONDS, TRIPLES[:, [0, 2]]]),
    )


def torsion(x: FloatArray) -> tuple[float, FloatArray]:
    """Energy k (1 + cos 3 phi) and forces, shape (4, 3).

    Gradient of phi as in Blondel and Karplus, J. Comput. Chem. 17, 1132 (1996).
    """
    first, middle, last = x[0] - x[1], x[1] - x[2], x[3] - x[2]
    a, b = np.cross(first, middle), np.cross(last, middle)
    length = float(np.linalg.norm(middle))
    phi = float(np.arctan2(np.cross(b, a) @ middle / length, a @ b))
    a, b = a / (a @ a), b / (b @ b)
    shared = (first @ middle) / length * a - (last @ middle) / length * b
    gradient = np.stack([-length * a, length * a + shared, -length * b - shared, length * b])
    return BARRIER * (1.0 + np.cos(3.0 * phi)), 3.0 * BARRIER * np.sin(3.0 * phi) * gradient


add_system("butane", build, "four-atom chain, bonds and angles held, free torsion", unit="molecule", only=True)
