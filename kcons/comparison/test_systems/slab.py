"""Rigid carbon monoxide on a periodic slab of copper, Cu(111): two lower layers fixed, forces of ASE's EMT."""

from __future__ import annotations

import math

import numpy as np
from ase import units
from ase.build import fcc111
from ase.calculators.emt import EMT

from kcons.comparison.test_systems.potential import of_calculator
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion.motion import Motion

#: C-O distance, and height of C above a top site, in Å.
BOND, HEIGHT = 1.15, 1.85
#: Atoms of the surface, along both of its vectors, for each molecule; layers, and how many of them are fixed.
PATCH, LAYERS, FIXED = 2, 4, 2
VACUUM = 6.0
TEMPERATURE = 300.0


def build(size: int, rng: int) -> TestSystem:
    """`size` molecules, one on each 2 x 2 patch; patches beyond their number are left bare."""
    across = math.ceil(math.sqrt(size))
    along = math.ceil(size / across)
    atoms = fcc111("Cu", (PATCH * across, PATCH * along, LAYERS), vacuum=VACUUM)
    atoms.pbc = True
    # Layers are numbered from the top.
    fixed = np.flatnonzero(atoms.get_tags() > LAYERS - FIXED)
    top = np.flatnonzero(atoms.get_tags() == 1).reshape(PATCH * along, PATCH * across)
    sites = atoms.positions[top[::PATCH, ::PATCH].ravel()[:size]]
    metal = len(atoms)
    generator = np.random.default_rng(rng)
    up = np.array([0.0, 0.0, 1.0])
    tilt = up + generator.normal(0.0, 0.1, (size, 3))
    carbon = sites + HEIGHT * up
    oxygen = carbon + BOND * tilt / np.linalg.norm(tilt, axis=1)[:, None]
    atoms += type(atoms)("CO" * size, positions=np.stack([carbon, oxygen], axis=1).reshape(-1, 3))
    x, masses, cell = atoms.positions.copy(), atoms.get_masses(), atoms.cell.array.copy()
    pairs = metal + np.arange(2 * size, dtype=np.int64).reshape(-1, 2)
    held = ConstraintSet([Distance(pairs, BOND), FixedAtoms(fixed)], x, masses, cell=cell)
    molecules = f"{size} rigid CO molecules" if size > 1 else "a rigid CO molecule"
    return TestSystem(
        name="slab",
        title=f"{molecules} on Cu(111), {metal} atoms in {LAYERS} layers of which {FIXED} are fixed, 300 K; ASE's EMT",
        constraint_set=held,
        positions=x,
        velocities=thermal_velocities(Motion(held, x), x, TEMPERATURE, rng, at_rest=False),
        potential=of_calculator(atoms, EMT(), "ASE's EMT"),
        symbols=atoms.get_chemical_symbols(),
        horizon=48 * units.fs,
        time_steps=tuple(dt * units.fs for dt in (4.0, 2.0, 1.0, 0.5)),
        tolerances=(1e-3, 1e-5, 1e-7),
        bonds=pairs,
        fixed=fixed,
        cell=cell,
        thermal_energy=units.kB * TEMPERATURE,
    )


add_system("slab", build, "rigid CO on Cu(111), lower layers fixed, EMT forces", unit="molecules")
