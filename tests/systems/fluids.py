"""Small periodic fluids of rigid molecules at a temperature, which Metropolis sampling knows without forces.

Compiled, for statistics over millions of steps; any consistent units. Atoms of one molecule do not act on each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from ase import units
from numpy.typing import ArrayLike

from kcons.constraints import Distance
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
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


#: Where the potential begins to be switched off, as a share of the cutoff.
SWITCH = 0.7


class LennardJones:
    """Forces and energies of a periodic fluid in a cubic box.

    u(r) = S(r) [4 eps ((sigma/r)^12 - (sigma/r)^6) + q q' (1/r + r^2/(2 c^3) - 3/(2 c))], mixed by Lorentz and
    Berthelot: charges with a conducting reaction field beyond the cutoff c. S falls from 1 to 0 with two continuous
    derivatives.

    Atoms of one molecule follow each other; `charges` are in units in which the energy of two is q q'/r. The cutoff is
    half the box by default, and at most: beyond, minimum images would be wrong.
    """

    def __init__(
        self,
        molecule: ArrayLike,
        box: float,
        *,
        masses: ArrayLike = 1.0,
        epsilon: ArrayLike = 1.0,
        sigma: ArrayLike = 1.0,
        charges: ArrayLike = 0.0,
        cutoff: float | None = None,
    ) -> None:
        self.molecule = np.asarray(molecule, dtype=np.int64)
        n = len(self.molecule)
        cutoff = 0.5 * box if cutoff is None else cutoff
        if not 0 < cutoff <= 0.5 * box:
            raise InputError(f"the cutoff {cutoff:g} must be above 0 and at most half the box", item="cutoff")
        self.box, self.cutoff = float(box), float(cutoff)
        well, size, charge, mass = (np.broadcast_to(np.asarray(a, float), n) for a in (epsilon, sigma, charges, masses))
        #: eps^(1/2), sigma/2 and q of each atom.
        self.sites: FloatArray = np.ascontiguousarray(np.stack([np.sqrt(well), 0.5 * size, charge], axis=1))
        self.masses: FloatArray = mass.copy()
        self.first = np.append(np.flatnonzero(np.diff(self.molecule, prepend=-1)), n)

    def force(self, x: FloatArray, time: float = 0.0) -> FloatArray:
        """Forces, shape (n_atoms, 3)."""
        return self.evaluate(x)[1]

    def potential(self, x: FloatArray, time: float = 0.0) -> float:
        """Potential energy."""
        return self.evaluate(x)[0]

    def evaluate(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy and forces in one pass."""
        f = np.zeros_like(x)
        return float(_evaluate(x, self.molecule, self.sites, self.box, self.cutoff, f)), f

    def metropolis(
        self,
        x: ArrayLike,
        thermal_energy: float,
        sweeps: int,
        every: int,
        seed: int | Sequence[int],
        shift: float,
        turn: float,
    ) -> tuple[FloatArray, FloatArray, float]:
        """Canonical sampling of rigid molecules by Metropolis moves: energies, positions, share of accepted moves.

        Moves are at most `shift` along each axis and `turn` about a random one; energies are recorded each `every`.
        """
        y, rng, n = np.array(x, dtype=np.float64), np.random.default_rng(seed), len(self.first) - 1
        energies = np.empty(sweeps // every)
        draws, axes = (draw((len(energies), every * n, k)) for draw, k in ((rng.random, 6), (rng.standard_normal, 3)))
        molecules = self.first, self.sites, self.box, self.cutoff
        accepted = _metropolis(y, *molecules, thermal_energy, draws, axes, (shift, turn), energies)
        return energies, y, accepted / (every * len(energies) * n)


@njit(cache=True, nogil=True)
def _pair(r2, a, b, cutoff):  # type: ignore[no-untyped-def]
    """u and u'/r of two sites."""
    r = np.sqrt(r2)
    s = a[1] + b[1]
    q = a[2] * b[2]
    c = (s * s / r2) ** 3
    e = 4.0 * a[0] * b[0] * c
    field = 1.0 / cutoff**3
    u = e * (c - 1.0) + q * (1.0 / r + 0.5 * field * r2 - 1.5 / cutoff)
    d = -e * (12.0 * c - 6.0) / r + q * (field * r - 1.0 / r2)
    begin = SWITCH * cutoff
    if r > begin:
        w = 1.0 / (cutoff - begin)
        t = (r - begin) * w
        k = 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t))
        dk = -30.0 * t * t * (1.0 - t) * (1.0 - t) * w
        d = d * k + u * dk
        u = u * k
    return u, d / r


@njit(cache=True, nogil=True)
def _evaluate(x, molecule, sites, box, cutoff, f):  # type: ignore[no-untyped-def]
    total, cut2, inverse = 0.0, cutoff * cutoff, 1.0 / box
    n, d = x.shape[0], np.empty(3)
    for i in range(n):
        for j in range(i + 1, n):
            if molecule[j] == molecule[i]:
                continue
            r2 = 0.0
            for c in range(3):
                d[c] = x[i, c] - x[j, c]
                d[c] -= box * np.rint(d[c] * inverse)
                r2 += d[c] * d[c]
            if r2 < cut2:
                u, slope = _pair(r2, sites[i], sites[j], cutoff)
                total += u
                for c in range(3):
                    f[i, c] -= slope * d[c]
                    f[j, c] += slope * d[c]
    return total


@njit(cache=True, nogil=True)
def _one(y, a, b, x, sites, box, cutoff):  # type: ignore[no-untyped-def]
    """Energy of atoms a..b at y with all others at x."""
    total, cut2, inverse = 0.0, cutoff * cutoff, 1.0 / box
    for i in range(a, b):
        for j in range(x.shape[0]):
            if a <= j < b:
                continue
            r2 = 0.0
            for c in range(3):
                d = y[i - a, c] - x[j, c]
                d -= box * np.rint(d * inverse)
                r2 += d * d
            if r2 < cut2:
                total += _pair(r2, sites[i], sites[j], cutoff)[0]
    return total


@njit(cache=True, nogil=True)
def _propose(y, draw, axis, moves):  # type: ignore[no-untyped-def]
    """Turn a molecule at places y, shape (n, 3), about its center and move it, in place."""
    size = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    angle = moves[1] * (2.0 * draw[0] - 1.0)
    sine, cosine = np.sin(angle), np.cos(angle)
    center, p = np.zeros(3), np.empty(3)
    for i in range(len(y)):
        for c in range(3):
            center[c] += y[i, c] / len(y)
    for i in range(len(y)):
        along = 0.0
        for c in range(3):
            p[c] = y[i, c] - center[c]
            along += p[c] * axis[c] / size**2
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            across = (axis[d] * p[e] - axis[e] * p[d]) / size
            turned = cosine * p[c] + sine * across + (1.0 - cosine) * along * axis[c]
            y[i, c] = center[c] + moves[0] * (2.0 * draw[1 + c] - 1.0) + turned


@njit(cache=True, nogil=True)
def _metropolis(x, first, sites, box, cutoff, kt, draws, axes, moves, energies):  # type: ignore[no-untyped-def]
    molecules, accepted, energy = len(first) - 1, 0, 0.0
    for k in range(molecules):
        energy += 0.5 * _one(x[first[k] : first[k + 1]], first[k], first[k + 1], x, sites, box, cutoff)
    for record in range(len(energies)):
        for trial in range(draws.shape[1]):
            draw = draws[record, trial]
            k = int(draw[4] * molecules)
            a, b = first[k], first[k + 1]
            y = x[a:b].copy()
            _propose(y, draw, axes[record, trial], moves)
            change = _one(y, a, b, x, sites, box, cutoff) - _one(x[a:b], a, b, x, sites, box, cutoff)
            if change <= 0.0 or draw[5] < np.exp(-change / kt):
                x[a:b] = y
                energy += change
                accepted += 1
        energies[record] = energy
    return accepted
