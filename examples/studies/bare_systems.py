"""Molecules without forces, on which constraint solvers are timed alone: Å, u and fs, 300 K, steps of 2 fs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from kcons.constraints import Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion

#: 300 K in u Å²/fs², and a usual time step in fs.
THERMAL_ENERGY = 2.494e-4
STEP = 2.0
#: No angles.
NONE: IntArray = np.zeros((0, 3), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class BareSystem:
    """Masses and distances.

    Attributes
    ----------
    name : str
    positions : ndarray, shape (n_atoms, 3)
    masses : ndarray, shape (n_atoms,)
    pairs : ndarray of int, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
    angles : ndarray of int, shape (n, 3)
        Triples (vertex in the middle) whose angles OpenMM's CCMA is told, since it converges better for that.
    system : callable, optional
        OpenMM's System, where there is one that knows more.
    """

    name: str
    positions: FloatArray
    masses: FloatArray
    pairs: IntArray
    lengths: FloatArray
    angles: IntArray = field(default_factory=NONE.copy)
    system: Callable[[], Any] | None = None

    @property
    def n_rows(self) -> int:
        return len(self.pairs)

    def constraint_set(self) -> ConstraintSet:
        return ConstraintSet(Distance(self.pairs, self.lengths), self.positions, self.masses)

    @cached_property
    def motion(self) -> Motion:
        """kcons' engine."""
        return Motion(self.constraint_set(), self.positions)

    @cached_property
    def thermal(self) -> FloatArray:
        """Velocities that leave the constraints, shape (n_atoms, 3)."""
        drawn = np.random.default_rng(5).standard_normal(self.positions.shape)
        return np.asarray(drawn * np.sqrt(THERMAL_ENERGY / self.masses)[:, None])

    @cached_property
    def tangent(self) -> FloatArray:
        """The same without what leaves the constraints."""
        return self.motion.project_velocities(self.positions, self.thermal)

    @property
    def moved(self) -> FloatArray:
        """Where free flight ends after a step."""
        return np.asarray(self.positions + STEP * self.tangent)

    def stretch(self, x: FloatArray) -> float:
        """Largest |r/d - 1|."""
        found = np.linalg.norm(x[self.pairs[:, 0]] - x[self.pairs[:, 1]], axis=1)
        return float(np.max(np.abs(found / self.lengths - 1.0)))

    def departure(self, x: FloatArray, v: FloatArray) -> float:
        """Largest |A v| over the root mean square of v, rows of unit norm."""
        i, j = self.pairs.T
        d = x[i] - x[j]
        along = np.sum(d * (v[i] - v[j]), axis=1) / np.linalg.norm(d, axis=1) / np.sqrt(2.0)
        return float(np.max(np.abs(along)) / np.sqrt(np.mean(v * v)))


def water(count: int) -> BareSystem:
    """Rigid TIP3P molecules on a lattice, turned at random."""
    bend = np.radians(104.52)
    shape = 0.9572 * np.array([[0, 0, 0], [1.0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
    x = _turned(shape, count, 3.1)
    first = 3 * np.arange(count)
    pairs = np.stack([first, first + 1, first, first + 2, first + 1, first + 2], axis=1).reshape(-1, 2)
    return _of(f"water, {count} molecules", x, np.tile([15.9994, 1.008, 1.008], count), pairs)


def methyl(count: int) -> BareSystem:
    """CH3 groups whose C-H bonds are held."""
    ends = 1.09 * np.array([[0.943, 0, 0.333], [-0.471, 0.816, 0.333], [-0.471, -0.816, 0.333]])
    ends *= 1.09 / np.linalg.norm(ends, axis=1)[:, None]
    x = _turned(np.vstack([np.zeros(3), ends]), count, 4.0)
    first = 4 * np.arange(count)
    pairs = np.stack([first, first + 1, first, first + 2, first, first + 3], axis=1).reshape(-1, 2)
    one = [[1, 0, 2], [1, 0, 3], [2, 0, 3]]
    angles = (first[:, None, None] + np.array(one)).reshape(-1, 3)
    return _of(f"X-H3 groups, {count}", x, np.tile([12.011, 1.008, 1.008, 1.008], count), pairs, angles)


def chain(bonds: int) -> BareSystem:
    """A zigzag chain of CH2."""
    from kcons.comparison.test_systems.chain import MASS, positions

    x = positions(bonds, "zigzag")
    x -= x.mean(axis=0)
    atoms = np.arange(bonds + 1)
    pairs = np.stack([atoms[:-1], atoms[1:]], axis=1)
    angles = np.stack([atoms[:-2], atoms[1:-1], atoms[2:]], axis=1)
    return _of(f"zigzag chain, {bonds} bonds", x, np.full(bonds + 1, MASS), pairs, angles)


def protein(constrain: str) -> BareSystem:
    """Dihydrofolate reductase, 2489 atoms, with bonds held by name."""
    from kcons.comparison import test_systems

    test_system = test_systems.build("dhfr", constrain=constrain)
    (item,) = test_system.constraint_set.constraints
    md_engine = test_system.openmm
    assert md_engine is not None and test_system.bonds is not None
    name = f"DHFR, {constrain}"
    return BareSystem(
        name,
        test_system.positions,
        test_system.masses,
        test_system.bonds,
        np.asarray(item.target_at(0.0)),
        system=lambda: md_engine.system,
    )


def _turned(shape: FloatArray, count: int, spacing: float) -> FloatArray:
    turns = np.linalg.qr(np.random.default_rng(1).standard_normal((count, 3, 3)))[0]
    edge = int(np.ceil(count ** (1 / 3) - 1e-9))
    sites = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count] * spacing
    x: FloatArray = (np.einsum("nij,kj->nki", turns, shape) + sites[:, None]).reshape(-1, 3)
    return np.ascontiguousarray(x - x.mean(axis=0))


def _of(name: str, x: FloatArray, masses: FloatArray, pairs: IntArray, angles: IntArray = NONE) -> BareSystem:
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    # To the last digit the same where they are meant to be: LAMMPS and SETTLE ask for it.
    lengths = np.round(lengths, 12)
    return BareSystem(name, x, masses, pairs, lengths, angles)
