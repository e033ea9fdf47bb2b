"""Rigid Lennard-Jones dumbbells in reduced units: two that collide, or a periodic box of them.

Solution for the two: each dumbbell's own equations of motion for its centre and its axis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from ase import units
from scipy.spatial import cKDTree

from kcons.comparison.test_systems.minimal import integrated
from kcons.comparison.test_systems.openmm_engine import OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import Evaluate, Potential
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import Reference, TestSystem, Units, thermal_velocities
from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion

REDUCED = Units("σ", "ε", "τ", 1.0, "τ", 1.0)

# The collision.
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

# The box.
BOND = 1.0
#: Sites of a simple cubic lattice: no two atoms are closer than SPACING - BOND, whatever the orientations.
SPACING = 2.15
TEMPERATURE = 1.5
SMALLEST = 8
#: Cutoff, less in small boxes, and where the forces begin to be switched off, as a fraction of it.
CUTOFF, SWITCH = 2.5, 0.7


def build(size: int, seed: int) -> TestSystem:
    """Two dumbbells that collide from a fixed start, or a box of at least 8 of them."""
    if size == 2:
        return _collision()
    if size < SMALLEST:
        raise InputError(
            f"there is no test system of {size} dumbbells; use 2 (a collision), or at least {SMALLEST} (a box)",
            item="size",
        )
    return _box(size, seed)


def _pairs(size: int) -> IntArray:
    return np.arange(2 * size, dtype=np.int64).reshape(-1, 2)


# -- two --------------------------------------------------------------------------------------------


def _collision() -> TestSystem:
    return TestSystem(
        name="dumbbells",
        title="collision of two rigid Lennard-Jones dumbbells, no cutoff",
        constraint_set=ConstraintSet(Distance(_pairs(2), LENGTHS), POSITIONS, MASSES),
        positions=POSITIONS,
        velocities=VELOCITIES,
        potential=Potential(attraction, "Lennard-Jones"),
        symbols=["Ar"] * 4,
        horizon=5.0,
        time_steps=(0.01, 0.005, 0.0025, 0.00125),
        tolerances=(1e-4, 1e-7, 1e-10),
        units=REDUCED,
        bonds=_pairs(2),
        solution=encounter,
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
    return system_of(MASSES, force, pairs=_pairs(2), lengths=LENGTHS)


def encounter(time: float) -> Reference:
    """Centres C and unit axes n: C'' = F/M and n'' = (K - (K . n) n)/I - |n'|^2 n.

    With the atoms at C + a_i n, K = sum a_i f_i and I = sum m_i a_i^2.
    """
    masses = MASSES.reshape(2, 2)
    shares = masses / masses.sum(axis=1)[:, None]
    # Places of the atoms on the axis, from the centre.
    arms = np.stack([-shares[:, 1], shares[:, 0]], axis=1) * LENGTHS[:, None]
    inertia = np.sum(masses * arms * arms, axis=1)[:, None]

    def place(y: FloatArray) -> FloatArray:
        centers, axes = y.reshape(4, 2, 3)[:2]
        n = axes / np.linalg.norm(axes, axis=1)[:, None]
        return np.asarray((centers[:, None] + arms[..., None] * n[:, None]).reshape(4, 3))

    def rate(_: float, y: FloatArray) -> FloatArray:
        n, drift, turn = y.reshape(4, 2, 3)[1:]
        f = attraction(place(y))[1].reshape(2, 2, 3)
        pull = np.sum(arms[..., None] * f, axis=1) / inertia
        n_squared = np.sum(n * n, axis=1)[:, None]
        along = np.sum((pull * n + turn * turn), axis=1)[:, None]
        change = pull - along * n / n_squared
        return np.concatenate([drift, turn, f.sum(axis=1) / masses.sum(axis=1)[:, None], change]).ravel()

    x, v = POSITIONS.reshape(2, 2, 3), VELOCITIES.reshape(2, 2, 3)
    weights = shares[..., None]
    start = [
        np.sum(weights * x, axis=1),
        (x[:, 1] - x[:, 0]) / LENGTHS[:, None],
        np.sum(weights * v, axis=1),
        (v[:, 1] - v[:, 0]) / LENGTHS[:, None],
    ]
    return integrated(rate, np.concatenate(start).ravel(), time, place, "equations of the centres and axes")


# -- a box ------------------------------------------------------------------------------------------


def _box(size: int, seed: int) -> TestSystem:
    rng = np.random.default_rng(seed)
    cells = math.ceil(size ** (1 / 3) - 1e-9)
    side = cells * SPACING
    sites = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * SPACING
    centers = sites[np.sort(rng.permutation(len(sites))[:size])]
    axes = rng.standard_normal((size, 3))
    axes *= 0.5 * BOND / np.linalg.norm(axes, axis=1)[:, None]
    x = np.stack([centers - axes, centers + axes], axis=1).reshape(-1, 3)
    masses = np.tile([1.0, 2.0], size)
    cutoff = min(CUTOFF, 0.499 * side)
    held = ConstraintSet(Distance(_pairs(size), BOND), x, masses, cell=np.full(3, side))
    motion = Motion(held, x)
    return TestSystem(
        name="dumbbells",
        title=f"{size} rigid Lennard-Jones dumbbells, box {side:.4g} σ, T = {TEMPERATURE:g} ε, cutoff {cutoff:.3g} σ",
        constraint_set=held,
        positions=x,
        velocities=thermal_velocities(motion, x, TEMPERATURE / units.kB, seed),
        potential=Potential(_with_cutoff(side, cutoff), "Lennard-Jones, switched off smoothly"),
        symbols=["Ar"] * (2 * size),
        horizon=0.8,
        time_steps=(0.02, 0.01, 0.005, 0.0025),
        tolerances=(1e-3, 1e-5, 1e-7),
        units=REDUCED,
        bonds=_pairs(size),
        cell=np.full(3, side),
        openmm=OpenMMEngine(lambda: _box_system(masses, side, cutoff), length=1.0, time=1.0),
        thermal_energy=TEMPERATURE,
    )


def _with_cutoff(side: float, cutoff: float) -> Evaluate:
    """Lennard-Jones times a switch that has four continuous derivatives, between atoms of different dumbbells."""
    begin = SWITCH * cutoff

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        wrapped = np.mod(x, side)
        wrapped[wrapped >= side] = 0.0  # a tiny negative number is rounded to the side itself
        pairs = cKDTree(wrapped, boxsize=side).query_pairs(cutoff, output_type="ndarray")
        i, j = pairs[pairs[:, 0] // 2 != pairs[:, 1] // 2].T
        d = x[i] - x[j]
        d -= side * np.round(d / side)
        r = np.sqrt(np.sum(d * d, axis=1))
        s6 = r**-6.0
        energy = 4.0 * (s6 * s6 - s6)
        slope = 24.0 * (s6 - 2.0 * s6 * s6) / r
        t = np.clip((cutoff - r) / (cutoff - begin), 0.0, 1.0)
        switch = t**5 * (126.0 - 420.0 * t + 540.0 * t**2 - 315.0 * t**3 + 70.0 * t**4)
        fall = -630.0 * (t * (1.0 - t)) ** 4 / (cutoff - begin)
        push = (-(slope * switch + energy * fall) / r)[:, None] * d
        f = np.zeros_like(x)
        for axis in range(3):
            f[:, axis] = np.bincount(i, push[:, axis], len(x)) - np.bincount(j, push[:, axis], len(x))
        return float(energy @ switch), f

    return evaluate


def _box_system(masses: FloatArray, side: float, cutoff: float) -> Any:
    import openmm

    begin = SWITCH * cutoff
    force = openmm.CustomNonbondedForce(
        f"4*(r^-12-r^-6)*t^5*(126-420*t+540*t^2-315*t^3+70*t^4);t=min(max(({cutoff!r}-r)/{cutoff - begin!r},0),1)"
    )
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(cutoff)
    pairs = _pairs(len(masses) // 2)
    for _ in masses:
        force.addParticle()
    for i, j in pairs.tolist():
        force.addExclusion(i, j)
    system = system_of(masses, force, pairs=pairs, lengths=BOND)
    system.setDefaultPeriodicBoxVectors(*(np.eye(3) * side))
    return system


add_system("dumbbells", build, "collision of two rigid dumbbells; a periodic box from 8 on", size=2, unit="dumbbells")
