"""Pendulums of one, two and three links in a vertical plane, hung at the origin (m = l = g = 1 for the first).

Solutions: elliptic functions for one link, and for more the equations of motion of the angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ellipj

from kcons.comparison.test_systems.minimal import integrated
from kcons.comparison.test_systems.potential import Potential, uniform_field
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import BARE, Reference, TestSystem
from kcons.constraints import Distance, Sphere
from kcons.constraints.constraint import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

GRAVITY = 1.0
NO_PIVOT = "ASE holds distances between atoms; the pivot is a point"


@dataclass(frozen=True)
class Pendulum:
    """Lengths and masses of the links, and the start: angles from the downward vertical and their rates."""

    title: str
    masses: tuple[float, ...]
    lengths: tuple[float, ...]
    angles: tuple[float, ...]
    rates: tuple[float, ...]
    horizon: float

    def places(self, angles: FloatArray) -> FloatArray:
        """Atoms, shape (n, 3), in the plane y = 0."""
        links = np.stack([np.sin(angles), np.zeros_like(angles), -np.cos(angles)], axis=1)
        return np.cumsum(np.array(self.lengths)[:, None] * links, axis=0)

    def velocities(self, angles: FloatArray, rates: FloatArray) -> FloatArray:
        links = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=1)
        return np.cumsum((np.array(self.lengths) * rates)[:, None] * links, axis=0)


#: The third link of the triple pendulum is the heaviest: it whips.
PENDULUMS = {
    "pendulum": Pendulum(
        "planar pendulum released at 179.9°", (1.0,), (1.0,), (float(np.radians(179.9)),), (0.0,), 8.430255141254303
    ),
    "double-pendulum": Pendulum("double pendulum", (1.0, 0.7), (1.0, 0.8), (2.0, 2.5), (0.1, -0.3), 5.0),
    "triple-pendulum": Pendulum(
        "triple pendulum", (1.0, 0.7, 1.3), (1.0, 0.8, 0.6), (1.5, 2.2, -0.7), (0.0, 0.2, 0.5), 5.0
    ),
}


def build(size: int, rng: int, *, kind: str = "pendulum") -> TestSystem:
    """One of `PENDULUMS`; its start is fixed."""
    chosen = PENDULUMS[kind]
    angles, rates = np.array(chosen.angles), np.array(chosen.rates)
    x, masses = chosen.places(angles), np.array(chosen.masses)
    links = len(masses)
    held: list[Constraint] = [Sphere(0, np.zeros(3), chosen.lengths[0])]
    if links > 1:
        held.append(Distance([[k, k + 1] for k in range(links - 1)], chosen.lengths[1:]))

    def solution(time: float) -> Reference:
        return _swing(chosen.angles[0], time) if links == 1 else _angles(chosen, time)

    return TestSystem(
        name=kind,
        title=f"{chosen.title}; m = l = g = 1" if links == 1 else f"{chosen.title}, g = 1",
        constraint_set=ConstraintSet(held, x, masses),
        positions=x,
        velocities=chosen.velocities(angles, rates),
        potential=Potential(uniform_field(masses, GRAVITY), "uniform field"),
        symbols=["X"] * links,
        horizon=chosen.horizon,
        time_steps=tuple(chosen.horizon / n for n in (200, 400, 800, 1600)),
        tolerances=(1e-3, 1e-6, 1e-9),
        units=BARE,
        refusals={"ase-bonds": NO_PIVOT, "ase-internals": NO_PIVOT},
        solution=solution,
    )


def _swing(start: float, time: float) -> Reference:
    """A pendulum (m = l = g = 1) released at rest at the angle `start`.

    sin(theta/2) = k cd(t, k) and cos(theta/2) = k' nd(t, k) with k = sin(start/2), k' = cos(start/2) and Jacobi's
    elliptic functions. Near k = 1 they take too few digits from k^2; Landen's transformation to the smaller modulus
    j = (1 - k')/(1 + k') mends that (Abramowitz and Stegun, 16.12).
    """
    k, other = np.sin(0.5 * start), np.cos(0.5 * start)
    j = (1.0 - other) / (1.0 + other)

    def place(squared: float) -> FloatArray:
        sn, cn, dn, _ = ellipj(np.sqrt(GRAVITY) * time / (1.0 + j), squared)
        below = cn * cn + 2.0 * other / (1.0 + other) * sn * sn  # 1 - j sn^2
        sine, cosine = k * cn * dn / below, other * (1.0 + j * sn * sn) / below
        return np.array([[2.0 * sine * cosine, 0.0, 2.0 * sine**2 - 1.0]])

    there = place(j * j)
    # What the last digit of the argument is worth.
    error = float(np.linalg.norm(there - place(np.nextafter(j * j, 0.0))))
    return Reference(there, error, "Jacobi's elliptic functions")


def _angles(chosen: Pendulum, time: float) -> Reference:
    """Lagrange's equations: sum_j m_ij l_i l_j [cos(a_i - a_j) a_j'' + sin(a_i - a_j) a_j'^2] = -g m_ii l_i sin a_i."""
    lengths = np.array(chosen.lengths)
    # m_ij: everything that hangs below both links.
    below = np.cumsum(np.array(chosen.masses)[::-1])[::-1]
    count = len(lengths)
    inertia = below[np.maximum.outer(np.arange(count), np.arange(count))] * np.outer(lengths, lengths)
    weight = GRAVITY * below * lengths

    def rate(_: float, y: FloatArray) -> FloatArray:
        angles, rates = y[:count], y[count:]
        difference = np.subtract.outer(angles, angles)
        right = -weight * np.sin(angles) - (inertia * np.sin(difference)) @ rates**2
        return np.concatenate([rates, np.linalg.solve(inertia * np.cos(difference), right)])

    start = np.array(chosen.angles + chosen.rates)
    return integrated(rate, start, time, lambda y: chosen.places(y[:count]), "Lagrange's equations of the angles")


for _name, _text in (
    ("pendulum", "planar pendulum from 179.9°; closed form"),
    ("double-pendulum", "planar double pendulum"),
    ("triple-pendulum", "planar triple pendulum"),
):
    add_system(_name, build, _text, unit="pendulum", only=True, options={"kind": _name})
