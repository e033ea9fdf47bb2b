"""Chains of united atoms (CH2, 14 u) with all bonds held at 1.53 Å: zigzag, straight, 175° and freely jointed."""

from __future__ import annotations

from typing import Any

import numpy as np
from ase import units

from kcons.comparison.test_systems.openmm_engine import ASE_LENGTH, ASE_TIME, OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import Evaluate, Potential
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion

BOND = 1.53
MASS = 14.027
TEMPERATURE = 300.0
#: From so many bonds on, runs are half, and a quarter as long: a reference solution has to be paid for.
LONG, VERY_LONG = 50_000, 500_000
#: Stiffness of the site that pulls at each atom, eV/Å².
STIFFNESS = 0.2

SHAPES = {
    "zigzag": "all-trans, 112°",
    "straight": "straight, 180°",
    "175": "nearly straight, 175°",
    "free": "freely jointed, a random walk",
}


def build(size: int, rng: int, *, shape: str = "zigzag") -> TestSystem:
    """A chain of `size` bonds; every atom is tied to its initial place by a soft anisotropic spring."""
    x = positions(size, shape, rng)
    masses = np.full(size + 1, MASS)
    pairs = np.stack([np.arange(size), np.arange(1, size + 1)], axis=1)
    held = ConstraintSet(Distance(pairs, BOND), x, masses)
    # Near 180° small sideways motion changes the directions of the bonds fast.
    pace = 0.5 if shape in ("straight", "175") else 1.0
    horizon, steps = 80.0, [10.0, 5.0, 2.5, 1.25]
    if size >= LONG:
        horizon = 40.0
    if size >= VERY_LONG:
        horizon, steps = 20.0, steps[:3]
    v = thermal_velocities(Motion(held, x), x, TEMPERATURE, rng, at_rest=False)
    return TestSystem(
        name="chain" if shape == "zigzag" else f"chain-{shape}",
        title=f"chain of {size} rigid bonds, {SHAPES[shape]}, 300 K; springs to the initial sites",
        constraint_set=held,
        positions=x,
        velocities=v,
        potential=Potential(_springs(x), "harmonic sites"),
        symbols=["C"] * (size + 1),
        horizon=pace * horizon * units.fs,
        time_steps=tuple(pace * dt * units.fs for dt in steps),
        bonds=pairs,
        openmm=OpenMMEngine(lambda: _system(x, pairs, masses)),
        thermal_energy=units.kB * TEMPERATURE,
    )


def positions(size: int, shape: str, rng: int = 1) -> FloatArray:
    """Atoms of a chain of `size` bonds, shape (size + 1, 3), in Å."""
    if shape not in SHAPES:
        raise InputError(f"no chain shape {shape!r}; there are {', '.join(SHAPES)}", item="shape")
    if shape == "free":
        u = np.random.default_rng(rng).standard_normal((size, 3))
        steps = u / np.linalg.norm(u, axis=1)[:, None]
    else:
        bend = np.radians({"zigzag": 112.0, "straight": 180.0, "175": 175.0}[shape])
        tilt = (np.pi - bend) / 2 * (-1.0) ** np.arange(size)
        steps = np.stack([np.cos(tilt), np.sin(tilt), np.zeros(size)], axis=1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(BOND * steps, axis=0)])


def _sites(start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Stiffness along each axis, and the sites."""
    # Different along each axis, so that no direction is special.
    k = STIFFNESS * np.array([1.0, 1.5, 0.6])
    # Off the start: the forces act from the first step on.
    return k, start + 0.1 * np.sin(np.arange(start.size)).reshape(start.shape)


def _springs(start: FloatArray) -> Evaluate:
    k, center = _sites(start)

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        d = x - center
        return 0.5 * float(np.sum(k * d * d)), -k * d

    return evaluate


def _system(start: FloatArray, pairs: IntArray, masses: FloatArray) -> Any:
    import openmm

    k, center = _sites(start)
    field = openmm.CustomExternalForce("0.5*(kx*(x-x0)^2+ky*(y-y0)^2+kz*(z-z0)^2)")
    for name, value in zip(("kx", "ky", "kz"), k / ASE_TIME**2, strict=True):
        field.addGlobalParameter(name, value)
    for name in ("x0", "y0", "z0"):
        field.addPerParticleParameter(name)
    for atom, site in enumerate(center * ASE_LENGTH):
        field.addParticle(atom, site.tolist())
    return system_of(masses, field, pairs=pairs, lengths=BOND * ASE_LENGTH)


for _shape, _text in (
    ("zigzag", "zigzag chain, all bonds held"),
    ("straight", "straight chain"),
    ("175", "nearly straight chain, 175°"),
    ("free", "freely jointed chain"),
):
    _name = "chain" if _shape == "zigzag" else f"chain-{_shape}"
    add_system(_name, build, _text, size=100, quick_size=20, unit="bonds", options={"shape": _shape})
