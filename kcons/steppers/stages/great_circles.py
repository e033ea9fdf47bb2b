"""Exact flight along great circles, for atoms that are each on a sphere of their own."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.surface import Sphere
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion


class GreatCircles:
    """Exact flight of atoms that are each on a sphere of their own; other atoms fly straight.

    n = (x - c)/R turns in the plane of n and v by |v| h/R: x1 = c + R (n cos + e sin), v1 = |v| (e cos - n sin)
    with e = v/|v|; no iteration, no limit on h.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """

    def __init__(self, atoms: IntArray, centers: FloatArray, radii: FloatArray, resting: IntArray) -> None:
        self.atoms, self.centers, self.radii, self.resting = atoms, centers, radii[:, None], resting

    @classmethod
    def of(cls, motion: Motion) -> GreatCircles | None:
        """For the rows of `motion`, or None if they hold anything else."""
        atoms, centers, radii, resting = [], [], [], []
        for item in motion.constraint_set.constraints:
            if item.moving:
                return None
            if isinstance(item, Sphere):
                atoms.append(item.atoms[:, 0])
                centers.append(np.broadcast_to(item.center, (item.n_rows, 3)))
                radii.append(item.target_at(0.0))
            elif item.fixes_atoms:
                resting.append(np.unique(item.atoms))
            else:
                return None
        if not atoms:
            return None
        held = np.concatenate(atoms)
        still = np.concatenate([*resting, np.zeros(0, dtype=np.int64)])
        if len(np.unique(held)) != len(held) or np.isin(held, still).any():
            return None
        return cls(held, np.concatenate(centers), np.concatenate(radii), still)

    def land(
        self,
        x: FloatArray,
        low: FloatArray,
        v: FloatArray,
        push: FloatArray,
        h: float,
        out: FloatArray,
        x_low: FloatArray,
    ) -> None:
        """Make an end of the free flight from x + low over h with v + push, which is out + x_low, one on the spheres.

        `push` is changed, and takes what the velocities change by.
        """
        atoms = self.atoms
        out[self.resting] = x[self.resting]
        x_low[self.resting] = 0.0
        d = (x[atoms] - self.centers) + low[atoms]
        n = d / _length(d)
        u = v[atoms]
        outward = np.einsum("ij,ij->i", n, u)[:, None] * n
        u -= outward
        speed = _length(u)
        angle = speed * (h / self.radii)
        # sin(angle)/speed and cos(angle) - 1, also for atoms at rest.
        sine = (h / self.radii) * np.sinc(angle / np.pi)
        half = (0.5 * h / self.radii) * np.sinc(angle / (2 * np.pi))
        less = -2 * (speed * half) ** 2
        change = low[atoms] + ((self.radii * n - d) + self.radii * (n * less + u * sine))
        out[atoms] = there = x[atoms] + change
        x_low[atoms] = (x[atoms] - there) + change
        push[atoms] += u * less - n * (speed**2 * sine) - outward


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))[:, None]
