"""Constrained flight without forces: the drifts that steppers are made of.

A drift takes tangent velocities, or velocities that differ from them by M^-1 A(x)^T times anything: the
impulse that brings the positions back onto the constraints acts along the same M^-1 A(x)^T and absorbs that
part. Drifts and kicks at the same positions may therefore follow each other without a projection of the
velocities in between; one at the end of the step is enough.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.surface import Sphere
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion
from kcons.steppers.stages.compensated_steps import Point


class Drift(Protocol):
    """Constrained flight over one interval."""

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        """Fly for `h` from time `start` to `end`; the new positions are put into `out`, which becomes point.x.

        After an error the contents of `point` and `out` mean nothing, but for point.x.
        """
        ...


class FreeFlight:
    """x1 = x0 + h u with sigma(x1, t1) = 0, u = v + M^-1 A(x0)^T l: RATTLE without forces, order 2.

    Rows of velocities hold at the middle, a((x0 + x1)/2) . u = c((t0 + t1)/2), which is the symmetric choice. Where
    there is friction, the time that passes is not the length of the flight.

    References
    ----------
    McLachlan and Perlmutter, J. Nonlinear Sci. 16, 283 (2006).
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        v = point.fly(h, out)
        self.motion.project_positions(
            out, point.x, time=end, reference_time=start, velocities=v, dt=h, flight=h, out=out
        )
        point.x = out


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
            elif item.family == "FixedAtoms":
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

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        x, atoms = point.x, self.atoms
        low = point.remainder(atoms)
        push = point.fly(h, out)
        x_low = point.x_low
        assert x_low is not None
        out[self.resting] = x[self.resting]
        x_low[self.resting] = 0.0
        d = (x[atoms] - self.centers) + low
        n = d / _length(d)
        u = point.v[atoms]
        outward = np.einsum("ij,ij->i", n, u)[:, None] * n
        u -= outward
        speed = _length(u)
        angle = speed * (h / self.radii)
        # sin(angle)/speed and cos(angle) - 1, also for atoms at rest.
        sine = (h / self.radii) * np.sinc(angle / np.pi)
        half = (0.5 * h / self.radii) * np.sinc(angle / (2 * np.pi))
        less = -2 * (speed * half) ** 2
        change = low + ((self.radii * n - d) + self.radii * (n * less + u * sine))
        out[atoms] = there = x[atoms] + change
        x_low[atoms] = (x[atoms] - there) + change
        push[atoms] += u * less - n * (speed**2 * sine) - outward
        point.x = out


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))[:, None]
