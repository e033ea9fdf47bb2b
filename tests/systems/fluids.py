"""Small periodic fluids of rigid molecules at a temperature, which Metropolis sampling knows without forces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from ase import units
from lennard_jones import LennardJones

from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion
from kcons.steppers import System

#: Lennard-Jones sites a unit of volume, temperature, and largest cutoff.
DENSITY, THERMAL_ENERGY, CUTOFF = 0.5, 1.5, 2.5
#: Bond of a dumbbell and size of its sites.
BOND, SITE = 0.7, 0.9
#: Edge of a box of 27 waters (0.9 g/cm3) and largest cutoff in Å, and temperature in K.
WATER_EDGE, WATER_CUTOFF, WATER_TEMPERATURE = 9.65, 9.0, 400.0
#: Charges are in units in which two of them have the energy q q'/r in eV.
COULOMB = 14.399645
#: TIP3P: charges, the well of the oxygen in eV and its size in Å, and the places of O, H, H.
WATER_CHARGES, WATER_WELL, WATER_SIZE = (-0.834, 0.417, 0.417), 0.1521 * units.kcal / units.mol, 3.1507
WATER_SHAPE = np.array([[0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]])
WATER_MASSES = (15.999, 1.008, 1.008)


@dataclass(frozen=True)
class Fluid:
    """A fluid on a lattice in a cubic box; `shift` and `turn` are the largest moves of Metropolis sampling."""

    constraint_set: ConstraintSet
    positions: FloatArray
    forces: LennardJones
    symbols: str
    thermal_energy: float = THERMAL_ENERGY
    shift: float = 0.25
    turn: float = 0.5

    @cached_property
    def motion(self) -> Motion:
        return Motion(self.constraint_set, self.positions)

    def system(self) -> System:
        return System(self.motion, self.forces.force, potential=self.forces.potential)


def dumbbells(size: int, seed: int = 1) -> Fluid:
    """Rigid dumbbells of Lennard-Jones sites."""
    box = (2 * size / DENSITY) ** (1 / 3)
    x = placed(np.array([[-0.5 * BOND, 0, 0], [0.5 * BOND, 0, 0]]), size, box, seed)
    forces = LennardJones(np.repeat(range(size), 2), box, sigma=SITE, cutoff=min(CUTOFF, 0.5 * box))
    held = ConstraintSet(Distance(np.arange(2 * size).reshape(-1, 2), np.full(size, BOND)), x, forces.masses)
    return Fluid(held, x, forces, "Ar" * len(x))


def water(size: int, seed: int = 1) -> Fluid:
    """Rigid TIP3P water with a smooth cutoff and a reaction field, at 400 K and 0.9 g/cm3."""
    box = WATER_EDGE * (size / 27) ** (1 / 3)
    x = placed(WATER_SHAPE, size, box, seed)
    forces = LennardJones(
        np.repeat(range(size), 3),
        box,
        masses=np.tile(WATER_MASSES, size),
        epsilon=np.tile([WATER_WELL, 0.0, 0.0], size),
        sigma=WATER_SIZE,
        charges=math.sqrt(COULOMB) * np.tile(WATER_CHARGES, size),
        cutoff=min(WATER_CUTOFF, 0.5 * box),
    )
    held = ConstraintSet(Distance(triangles(size)), x, forces.masses)
    return Fluid(held, x, forces, "OHH" * size, units.kB * WATER_TEMPERATURE, turn=0.4)


def triangles(size: int) -> IntArray:
    """The three pairs of each of `size` triatomic molecules, shape (3 size, 2)."""
    k = 3 * np.arange(size)
    return np.concatenate([np.c_[k, k + 1], np.c_[k, k + 2], np.c_[k + 1, k + 2]])


def placed(shape: FloatArray, size: int, box: float, seed: int = 1) -> FloatArray:
    """`size` molecules of this shape, turned at random, on a cubic lattice that fills the box."""
    rng, edge = np.random.default_rng(seed), math.ceil(size ** (1 / 3) - 1e-9)
    lattice = np.stack(np.unravel_index(np.arange(size), (edge, edge, edge)), axis=1) * (box / edge)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(size)]
    return np.concatenate([c + shape @ q.T for c, q in zip(lattice, turns, strict=True)])
