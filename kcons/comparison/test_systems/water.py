"""A periodic box of rigid TIP3P water at 300 K and 0.98 g/cm³, with its real forces."""

from __future__ import annotations

import math
from importlib import resources
from importlib.util import find_spec
from typing import Any

import numpy as np
from ase import Atoms, units
from ase.calculators.tip3p import TIP3P

from kcons.comparison.test_systems.openmm_engine import ASE_LENGTH, OpenMMEngine, system_of
from kcons.comparison.test_systems.potential import Potential, of_calculator
from kcons.comparison.test_systems.registry import add_system
from kcons.comparison.test_systems.system import TestSystem, thermal_velocities
from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, System

R_OH = 0.9572
HOH = np.radians(104.52)
R_HH = 2 * R_OH * np.sin(HOH / 2)
O_MASS, H_MASS = 15.9994, 1.008
TEMPERATURE = 300.0
#: Cutoff of the direct forces in Å, less in small boxes.
CUTOFF = 9.0
SMALLEST = 8
#: From so many molecules on, the finest step is left out: the reference takes half as long.
MANY = 2000


def build(size: int, rng: int, *, forces: str = "") -> TestSystem:
    """`size` molecules with forces of 'openmm' (PME; the default where it is installed) or of 'ase' (its TIP3P)."""
    if size < SMALLEST:
        raise InputError(
            f"a box of {size} molecules is too small for periodic forces; use at least {SMALLEST}", item="size"
        )
    forces = forces or ("openmm" if find_spec("openmm") else "ase")
    x, box, equilibrated = _molecules(size)
    triples = np.arange(3 * size).reshape(-1, 3)
    pairs = triples[:, [[0, 1], [0, 2], [1, 2]]].reshape(-1, 2)
    lengths = np.tile([R_OH, R_OH, R_HH], size)
    masses = np.tile([O_MASS, H_MASS, H_MASS], size)
    cell = np.full(3, box)
    held = ConstraintSet(Distance(pairs, lengths), x, masses, cell=cell)
    motion = Motion(held, x)
    x = motion.restore_positions(x)
    cutoff = min(CUTOFF, 0.49 * box)
    potential = _potential(forces, x, box, cutoff, masses)
    if not equilibrated:
        x = _relaxed(motion, potential, x, rng)
    v = thermal_velocities(motion, x, TEMPERATURE, rng)
    potential.forget()
    return TestSystem(
        name="water",
        title=f"{size} rigid TIP3P waters, box {box:.2f} Å, 300 K; {potential.name}",
        constraint_set=held,
        positions=x,
        velocities=v,
        potential=potential,
        symbols=["O", "H", "H"] * size,
        horizon=24 * units.fs,
        time_steps=tuple(dt * units.fs for dt in ((4.0, 2.0, 1.0) if size >= MANY else (4.0, 2.0, 1.0, 0.5))),
        # Below this, the single precision of the forces makes an adaptive integrator reject its steps.
        tolerances=(1e-3, 1e-4, 1e-5),
        bonds=pairs,
        cell=cell,
        thermal_energy=units.kB * TEMPERATURE,
        openmm=None
        if forces == "ase"
        else OpenMMEngine(lambda: _system(box, cutoff, masses, pairs, lengths), platform="CPU"),
    )


def _molecules(size: int) -> tuple[FloatArray, float, bool]:
    """Positions, box, and whether they need no relaxation."""
    for unit, length in (_equilibrated(64), _equilibrated(216)):
        copies = math.ceil((size / len(unit)) ** (1 / 3) - 1e-9)
        shifts = length * np.stack(np.meshgrid(*[np.arange(copies)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        replicas = (unit[None] + shifts[:, None, None, :]).reshape(-1, 3, 3)
        if len(replicas) == size:
            return replicas.reshape(-1, 3), copies * length, True
    # The corner cube that holds `size` molecules; those at its faces do not fit their new images.
    order = np.argsort(replicas[:, 0].max(axis=1), kind="stable")[:size]
    box = length * (size / len(unit)) ** (1 / 3)
    return replicas[np.sort(order)].reshape(-1, 3), box, False


def _equilibrated(size: int) -> tuple[FloatArray, float]:
    """A box that ran 100 ps at 300 K: positions, shape (size, 3, 3), and its length."""
    with resources.files("kcons.comparison.test_systems").joinpath(f"data/water{size}.npz").open("rb") as file:
        data = np.load(file)
        return data["positions"].astype(float).reshape(size, 3, 3), float(data["box"])


def _relaxed(motion: Motion, potential: Potential, x: FloatArray, rng: int) -> FloatArray:
    """Remove overlaps by descent with bounded displacements, then 100 fs with velocities reset every 10."""
    for _ in range(100):
        step = motion.project_forces(x, potential.forces(x)) / motion.masses[:, None]
        longest = np.sqrt(np.max(np.sum(step**2, axis=1)))
        x = motion.project_positions(x + step * min(0.05 / longest, 0.02), x)
    system = System(motion, potential.forces)
    for round_ in range(10):
        v = thermal_velocities(motion, x, TEMPERATURE, rng + 1000 + round_)
        state = State(x, v)
        for _ in range(10):
            state = Rattle().step(system, state, 1.0 * units.fs)
        x = state.positions
    return x


def _potential(forces: str, x: FloatArray, box: float, cutoff: float, masses: FloatArray) -> Potential:
    if forces == "ase":
        atoms = Atoms(["O", "H", "H"] * (len(x) // 3), positions=x, cell=[box] * 3, pbc=True, masses=masses)
        return of_calculator(atoms, TIP3P(rc=cutoff, width=min(1.0, cutoff / 3)), "ASE's TIP3P, cut off")
    if forces != "openmm":
        raise InputError(f"no forces {forces!r} for water; there are 'openmm' and 'ase'", item="forces")
    potential = OpenMMEngine(lambda: _system(box, cutoff, masses), platform="CPU").potential()
    potential.name = f"PME, {potential.name}"
    return potential


def _system(box: float, cutoff: float, masses: FloatArray, pairs: Any = (), lengths: Any = ()) -> Any:
    """OpenMM's System, with its distances (in Å) held by OpenMM if they are given."""
    import openmm

    force = openmm.NonbondedForce()
    sigma, epsilon = 0.315061, 0.1521 * 4.184
    for k in range(len(masses)):
        force.addParticle(*((-0.834, sigma, epsilon) if k % 3 == 0 else (0.417, 1.0, 0.0)))
    for first in range(0, len(masses), 3):
        for i, j in ((0, 1), (0, 2), (1, 2)):
            force.addException(first + i, first + j, 0.0, 1.0, 0.0)
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(cutoff / 10)
    # Smooth enough that the order of a method can be seen: tight Ewald sum, switched dispersion.
    force.setEwaldErrorTolerance(1e-5)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.9 * cutoff / 10)
    force.setUseDispersionCorrection(False)
    system = system_of(masses, force, pairs=pairs, lengths=np.asarray(lengths) * ASE_LENGTH)
    system.setDefaultPeriodicBoxVectors(*(np.eye(3) * box / 10))
    return system


add_system(
    "water", build, "box of rigid TIP3P water, PME forces", size=64, quick_size=8, unit="molecules", takes=("forces",)
)
