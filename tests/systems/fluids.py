"""Small periodic fluids at a temperature, for what `kcons compare` says of thermostats: atoms, dumbbells, rigid water.

Here nothing is compared along a trajectory. What counts are averages, which plain Metropolis sampling of the same
fluid gives without forces and velocities.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from ase import units
from lennard_jones import LennardJones

from kcons.comparison.test_systems.system import ASE_UNITS, Units
from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion
from kcons.steppers import System

REDUCED = Units("σ", "ε", "τ", 1.0, "τ", 1.0)
#: Lennard-Jones sites a unit of volume, temperature, and largest cutoff.
DENSITY, THERMAL_ENERGY, CUTOFF = 0.5, 1.5, 2.5
#: Bond of a dumbbell and size of its sites.
BOND, SITE = 0.7, 0.9
#: Edge of a box of 8 triatomic molecules, and their shape.
TRIATOMIC_EDGE, TRIATOMIC_SHAPE = 3.9, np.array([[0, 0, 0], [0.6, 0, 0], [-0.2, 0.4 * math.sqrt(2), 0]])
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
    """A fluid of rigid molecules in a cubic box, with what sampling it takes.

    Attributes
    ----------
    name, title : str
    constraint_set : ConstraintSet
    positions : ndarray, shape (n_atoms, 3)
        On a lattice, not at equilibrium.
    forces : LennardJones
    symbols : str
        For ASE.
    thermal_energy : float
        k_B T.
    time_steps : sequence of float
        Default steps, internal units.
    interval : float
        Time between samples.
    friction, period : float
        Of the Langevin thermostat, and of a Nose-Hoover chain.
    shift, turn : float
        Largest moves of a molecule in Metropolis sampling.
    arm : float
        Length that weighs turns against shifts in the temperature of the configurations.
    units : Units
    """

    name: str
    title: str
    constraint_set: ConstraintSet
    positions: FloatArray
    forces: LennardJones
    symbols: str
    thermal_energy: float
    time_steps: tuple[float, ...]
    interval: float
    friction: float
    period: float
    shift: float
    turn: float
    arm: float = 1.0
    units: Units = REDUCED

    @cached_property
    def motion(self) -> Motion:
        """The engine, set up once."""
        return Motion(self.constraint_set, self.positions)

    @property
    def n_molecules(self) -> int:
        return len(self.forces.first) - 1

    def system(self, force: Callable[[FloatArray, float], FloatArray] | None = None) -> System:
        """With its own forces, or with `force`, for one who counts."""
        return System(self.motion, self.forces.force if force is None else force, potential=self.forces.potential)

    def with_time_steps(self, shown: list[float]) -> Fluid:
        """The same fluid with other steps, in the unit of time it shows.

        Raises
        ------
        InputError
            A step that is not positive.
        """
        for dt in shown:
            if not (math.isfinite(dt) and dt > 0):
                raise InputError(f"time step {dt:g} {self.units.time}: give a positive number", item="dt")
        steps = sorted({dt * self.units.time_unit for dt in shown}, reverse=True)
        return replace(self, time_steps=tuple(steps))


def build(size: int, seed: int = 1, *, kind: str = "atoms") -> Fluid:
    """`size` molecules of the fluid `kind`: 'atoms', 'dumbbells', 'triatomics' or 'water'.

    Raises
    ------
    InputError
        Too few molecules for a box.
    """
    smallest = 27 if kind == "water" else 8
    if size < smallest:
        raise InputError(f"{size} are too few for a periodic fluid; use {smallest} or more", item="size")
    return {"atoms": atoms, "dumbbells": dumbbells, "triatomics": triatomics, "water": water}[kind](size, seed)


def atoms(size: int, seed: int = 1) -> Fluid:
    """Lennard-Jones atoms, kT = 1.5, 0.5 of them a unit of volume."""
    box = (size / DENSITY) ** (1 / 3)
    forces = LennardJones(range(size), box, cutoff=min(CUTOFF, 0.5 * box))
    x = _lattice(size, box)
    title = f"{size} Lennard-Jones atoms, box {box:.4g} σ, kT = {THERMAL_ENERGY:g} ε, cutoff {forces.cutoff:.3g} σ"
    return _reduced("thermostat", title, ConstraintSet([], x, forces.masses), x, forces)


def dumbbells(size: int, seed: int = 1) -> Fluid:
    """Rigid dumbbells of Lennard-Jones sites, as dense and as hot."""
    box = (2 * size / DENSITY) ** (1 / 3)
    x = placed(np.array([[-0.5 * BOND, 0, 0], [0.5 * BOND, 0, 0]]), size, box, seed)
    forces = LennardJones(np.repeat(range(size), 2), box, sigma=SITE, cutoff=min(CUTOFF, 0.5 * box))
    held = ConstraintSet(Distance(np.arange(2 * size).reshape(-1, 2), np.full(size, BOND)), x, forces.masses)
    title = f"{size} rigid dumbbells, box {box:.4g} σ, kT = {THERMAL_ENERGY:g} ε, cutoff {forces.cutoff:.3g} σ"
    return _reduced("thermostat-dumbbells", title, held, x, forces)


def triatomics(size: int, seed: int = 1) -> Fluid:
    """Rigid triangles of Lennard-Jones sites, one of them twice as heavy."""
    box = TRIATOMIC_EDGE * (size / 8) ** (1 / 3)
    x = placed(TRIATOMIC_SHAPE, size, box, seed)
    masses = np.tile([2.0, 1.0, 1.0], size)
    forces = LennardJones(np.repeat(range(size), 3), box, masses=masses, sigma=SITE, cutoff=min(CUTOFF, 0.5 * box))
    held = ConstraintSet(Distance(triangles(size)), x, masses)
    title = f"{size} rigid triatomics, box {box:.4g} σ, kT = {THERMAL_ENERGY:g} ε, cutoff {forces.cutoff:.3g} σ"
    return _reduced("thermostat-triatomics", title, held, x, forces)


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
    return Fluid(
        name="thermostat-water",
        title=f"{size} rigid TIP3P waters, box {box:.4g} Å, {WATER_TEMPERATURE:g} K, cutoff {forces.cutoff:.3g} Å, "
        "reaction field",
        constraint_set=ConstraintSet(Distance(triangles(size)), x, forces.masses),
        positions=x,
        forces=forces,
        symbols="OHH" * size,
        thermal_energy=units.kB * WATER_TEMPERATURE,
        time_steps=(4 * units.fs, 2 * units.fs, 1 * units.fs),
        interval=16 * units.fs,
        friction=5e-3 / units.fs,
        period=300 * units.fs,
        shift=0.25,
        turn=0.4,
        arm=0.5,
        units=ASE_UNITS,
    )


def triangles(size: int) -> IntArray:
    """The three pairs of each of `size` triatomic molecules, shape (3 size, 2)."""
    k = 3 * np.arange(size)
    return np.concatenate([np.c_[k, k + 1], np.c_[k, k + 2], np.c_[k + 1, k + 2]])


def placed(shape: FloatArray, size: int, box: float, seed: int = 1) -> FloatArray:
    """`size` molecules of this shape, turned at random, on a cubic lattice that fills the box."""
    rng = np.random.default_rng(seed)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(size)]
    return np.concatenate([c + shape @ q.T for c, q in zip(_lattice(size, box), turns, strict=True)])


def _lattice(size: int, box: float) -> FloatArray:
    edge = math.ceil(size ** (1 / 3) - 1e-9)
    return np.stack(np.unravel_index(np.arange(size), (edge, edge, edge)), axis=1) * (box / edge)


def _reduced(name: str, title: str, held: ConstraintSet, x: FloatArray, forces: LennardJones) -> Fluid:
    return Fluid(
        name=name,
        title=title,
        constraint_set=held,
        positions=x,
        forces=forces,
        symbols="Ar" * len(x),
        thermal_energy=THERMAL_ENERGY,
        time_steps=(0.02, 0.01, 0.005),
        interval=0.04,
        friction=1.0,
        period=1.0,
        shift=0.25,
        turn=0.5,
    )
