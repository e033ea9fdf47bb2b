"""A small mechanical problem in one form for all programs, and the numbers that judge a run of it.

Units are consistent ones: they are taken as Angstrom, amu and eV by ASE and as nm, dalton and kJ/mol by OpenMM, so
that all programs compute with the same numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import Angle, Constraint, Distance, FixedAtoms, projection
from kcons.constraints.constraint_set import ConstraintSet

Array = NDArray[np.float64]
Pairs = Sequence[tuple[int, int]]
#: Whatever NumPy makes an array of; its own type refuses nested lists of ints and floats.
Numbers: TypeAlias = Any


@dataclass(frozen=True, eq=False)
class Problem:
    """Atoms, what is held, and forces.

    Without lengths, distances of `pairs` are held at what they are, as angles of `triples` always are. Forces are a
    constant `push`, harmonic `springs` (i, j, k, rest length), and springs of the constant `tether` to `anchors`, by
    default the positions. `others` are rows that only kcons knows.
    """

    positions: Numbers
    masses: Numbers
    pairs: Pairs = ()
    lengths: ArrayLike | None = None
    triples: Sequence[tuple[int, int, int]] = ()
    fixed: Sequence[int] = ()
    velocities: ArrayLike | None = None
    push: ArrayLike | None = None
    springs: Sequence[tuple[int, int, float, float]] = ()
    tether: float = 0.0
    anchors: ArrayLike | None = None
    cell: ArrayLike | None = None
    others: Sequence[Constraint] = ()

    x = property(lambda self: np.array(self.positions, dtype=float))
    v = property(lambda self: np.zeros_like(self.x) if self.velocities is None else np.array(self.velocities, float))
    m = property(lambda self: np.array(self.masses, dtype=float))
    n_atoms = property(lambda self: len(self.x))

    @property
    def held_lengths(self) -> Array:
        """Lengths of `pairs`, shape (n_pairs,)."""
        return distances(self.x, self.pairs, self.cell) if self.lengths is None else np.array(self.lengths, dtype=float)

    @property
    def held_angles(self) -> Array:
        """Values of `triples` in radian, shape (n_triples,)."""
        return bends(self.x, self.triples)

    def but(self, **changes: Any) -> Problem:
        """A copy with other attributes."""
        return replace(self, **changes)

    def moving(self, v: ArrayLike) -> Problem:
        """A copy with velocities that fit to what is held."""
        return replace(self, velocities=self.tangent(v))

    def rows(self) -> list[Constraint]:
        """The constraints of kcons."""
        found: list[Constraint] = [FixedAtoms(list(self.fixed))] if len(self.fixed) else []
        found += [Distance(list(self.pairs), self.lengths)] if len(self.pairs) else []
        found += [Angle(list(self.triples))] if len(self.triples) else []
        return [*found, *self.others]

    @property
    def has_forces(self) -> bool:
        return self.push is not None or bool(self.springs) or self.tether != 0

    def forces(self, x: Array, time: float = 0.0) -> Array:
        """Applied forces, shape (n_atoms, 3)."""
        f = np.zeros_like(x) if self.push is None else np.array(self.push, dtype=float)
        for i, j, k, rest in self.springs:
            d = x[i] - x[j]
            r = np.linalg.norm(d)
            pull = k * (rest - r) / r * d
            f[i] += pull
            f[j] -= pull
        if self.tether:
            f -= self.tether * (x - self._anchors)
        return f

    def potential(self, x: Array, time: float = 0.0) -> float:
        """Potential energy."""
        energy = 0.0 if self.push is None else -float(np.sum(np.asarray(self.push) * x))
        for i, j, k, rest in self.springs:
            energy += 0.5 * k * float(np.linalg.norm(x[i] - x[j]) - rest) ** 2
        if self.tether:
            energy += 0.5 * self.tether * float(np.sum((x - self._anchors) ** 2))
        return energy

    @property
    def _anchors(self) -> Array:
        return self.x if self.anchors is None else np.asarray(self.anchors, dtype=float)

    # -- judges -----------------------------------------------------------------------------------

    def residual(self, x: Array) -> float:
        """Largest relative error of a held length, or error of a held angle in radian; NaN if anything is."""
        if not np.all(np.isfinite(x)):
            return float("nan")
        lengths = self.held_lengths
        off = [np.abs(distances(x, self.pairs, self.cell) - lengths) / lengths]
        off.append(np.abs(bends(x, self.triples) - self.held_angles))
        return float(np.concatenate(off).max(initial=0.0))

    def kinetic(self, v: Array) -> float:
        """Kinetic energy of the atoms that are not fixed."""
        moving = np.setdiff1d(np.arange(self.n_atoms), np.asarray(self.fixed, dtype=int))
        return 0.5 * float(np.sum(self.m[moving, None] * v[moving] ** 2))

    @functools.cached_property
    def oracle(self) -> ConstraintSet:
        """The rows for the dense theory of `kcons.constraints.projection`; none of the solvers knows of it."""
        return ConstraintSet(self.rows(), self.x, self.m)

    def tangent(self, v: ArrayLike) -> Array:
        """Velocities projected in the mass metric, densely."""
        return projection.project_velocities(self.oracle.jacobian(self.x).toarray(), self.m, np.asarray(v))

    def acceleration(self, x: Array, v: Array) -> Array:
        """Accelerations of the dense theory (notes, eq. 105)."""
        rows = self.oracle.jacobian(x).toarray()
        return projection.acceleration(rows, self.m, self.forces(x), self.oracle.acceleration_target(x, v))


def distances(x: Array, pairs: Pairs, cell: ArrayLike | None = None) -> Array:
    """Distances of pairs, by minimum images in a cell."""
    i, j = np.asarray(pairs, dtype=int).reshape(-1, 2).T
    d = x[i] - x[j]
    if cell is not None:
        lattice = np.asarray(cell, dtype=float)
        d = d - np.round(d @ np.linalg.inv(lattice)) @ lattice
    return np.asarray(np.sqrt(np.sum(d * d, axis=1)))


def bends(x: Array, triples: Sequence[tuple[int, int, int]]) -> Array:
    """Angles at the middle atoms, radian."""
    if not len(triples):
        return np.zeros(0)
    i, j, k = np.asarray(triples, dtype=int).reshape(-1, 3).T
    u, w = x[i] - x[j], x[k] - x[j]
    return np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), np.sum(u * w, axis=1))
