"""One ethanol molecule at 300 K with all bonds and all angles held: only two torsions and the tumbling are left."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Any

import numpy as np
from ase import units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.neighborlist import natural_cutoffs, neighbor_list

from kcons.comparison.test_systems.potential import Potential, of_calculator
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Angle, Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.motion.motion import Motion

TEMPERATURE = 300.0


def build(size: int, rng: int, *, forces: str = "") -> TestSystem:
    """Forces are 'xtb' (GFN2-xTB by tblite, where it is installed) or 'emt' (a toy for this molecule, but smooth)."""
    atoms = molecule("CH3CH2OH")
    bonds, angles = topology(atoms)
    x, masses = atoms.positions.copy(), atoms.get_masses()
    held = ConstraintSet([Distance(bonds), Angle(angles)], x, masses)
    motion = Motion(held, x)
    potential = _potential(forces or ("xtb" if find_spec("tblite") else "emt"), atoms)
    # The ends of an angle whose arms are held are at a fixed distance: the same set by distances alone.
    pairs = np.concatenate([bonds, np.sort(angles[:, [0, 2]], axis=1)])
    return TestSystem(
        name="ethanol",
        title=f"ethanol, all {len(bonds)} bonds and {len(angles)} angles, 300 K; {potential.name}",
        constraint_set=held,
        positions=x,
        velocities=thermal_velocities(motion, x, TEMPERATURE, rng),
        potential=potential,
        symbols=atoms.get_chemical_symbols(),
        horizon=32 * units.fs,
        time_steps=tuple(dt * units.fs for dt in (8.0, 4.0, 2.0, 1.0)),
        bonds=pairs,
        thermal_energy=units.kB * TEMPERATURE,
    )


def topology(atoms: Any) -> tuple[IntArray, IntArray]:
    """Bonds, shape (n, 2), and angles, shape (m, 3) with the vertex in the middle."""
    i, j = neighbor_list("ij", atoms, natural_cutoffs(atoms, mult=1.15), self_interaction=False)
    bonds = np.array(sorted({(min(a, b), max(a, b)) for a, b in zip(i.tolist(), j.tolist(), strict=True)}))
    angles = []
    for vertex in range(len(atoms)):
        around = sorted(j[i == vertex].tolist())
        angles += [(a, vertex, b) for k, a in enumerate(around) for b in around[k + 1 :]]
    return bonds.astype(np.int64), np.array(angles, dtype=np.int64).reshape(-1, 3)


def _potential(forces: str, atoms: Any) -> Potential:
    if forces == "emt":
        return of_calculator(atoms, EMT(), "ASE's EMT")
    if forces != "xtb":
        raise InputError(f"no forces {forces!r} for ethanol; there are 'xtb' and 'emt'", item="forces")
    # Its OpenMP threads are set when it is loaded. One is right for nine atoms, and for timings that mean something.
    chosen = os.environ.get("OMP_NUM_THREADS")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        from tblite.ase import TBLite
    finally:
        if chosen is None:
            del os.environ["OMP_NUM_THREADS"]
    return of_calculator(atoms, TBLite(method="GFN2-xTB", accuracy=0.01, verbosity=0), "GFN2-xTB by tblite")


add_system(
    "ethanol",
    build,
    "ethanol, all bonds and angles, GFN2-xTB forces",
    unit="molecule",
    only=True,
    takes=("forces",),
)
