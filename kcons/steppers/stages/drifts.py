"""Constrained flight without forces: the drifts that steppers are made of.

A drift takes tangent velocities, or velocities that differ from them by M^-1 A(x)^T times anything: the
impulse that brings the positions back onto the constraints acts along the same M^-1 A(x)^T and absorbs that
part. Drifts and kicks at the same positions may therefore follow each other without a projection of the
velocities in between; one at the end of the step is enough.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.surface import Sphere
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError
from kcons.motion.motion import Motion
from kcons.steppers.stages.compensated_steps import Point

_MAX_ITERATIONS = 50
_EPS = float(np.finfo(float).eps)


class Drift(Protocol):
    """Constrained flight over one interval."""

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        """Fly for `h` from time `start` to `end`; the new positions are put into `out`, which becomes point.x.

        After an error the contents of `point` and `out` mean nothing, but for point.x.
        """
        ...


class FreeFlight:
    """x1 = x0 + h u with sigma(x1, t1) = 0, u = v + M^-1 A(x0)^T l: RATTLE without forces, order 2."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        v = point.fly(h, out)
        self.motion.project_positions(out, point.x, time=end, reference_time=start, velocities=v, dt=h, out=out)
        point.x = out


class NonholonomicFlight:
    """Free flight where some rows constrain velocities only.

    Their impulses mu act along A(x0) and are found such that a((x0 + x1)/2) . u = c(t0 + h/2), the symmetric
    choice, by Newton's method with the matrix of the start; the position rows are solved exactly by the engine
    at each iteration.

    References
    ----------
    McLachlan and Perlmutter, J. Nonlinear Sci. 16, 283 (2006).
    """

    def __init__(self, motion: Motion, inverse_masses: FloatArray) -> None:
        from scipy.sparse.csgraph import connected_components  # slow to import, rarely needed

        self.motion = motion
        whole = self.whole = motion.constraint_set
        links = whole.incidence @ whole.incidence.T
        labels = connected_components(links, directed=False)[1]
        velocity = ~whole.holonomic
        self.rows: IntArray = np.flatnonzero(np.isin(labels, labels[velocity])).astype(np.int64)
        self.held, self.atoms = whole.subset(self.rows)
        self.is_velocity: NDArray[np.bool_] = ~self.held.holonomic
        self.weights: FloatArray = np.repeat(inverse_masses[self.atoms, 0], 3)

    def move(self, point: Point, out: FloatArray, start: float, end: float, h: float) -> None:
        point.land()
        x, v = point.x, point.v
        # Where there is friction, the time that passes is not that of the flight.
        x0, middle = x[self.atoms], 0.5 * (start + end)
        coefficients = self.held.jacobian(x0, start).toarray()
        spread = coefficients * self.weights
        size = np.sqrt(np.einsum("ij,ij->i", coefficients, coefficients))
        size[size == 0] = 1.0
        gram = (spread @ coefficients.T) / size[:, None] / size
        respond = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)[np.ix_(self.is_velocity, self.is_velocity)]
        push = (spread / size[:, None])[self.is_velocity]
        impulses = np.zeros(len(push))
        kicked = v.copy()
        # A kick that the rows take up whole leaves no speed to compare with, only the rounding of the kick.
        before = float(np.abs(kicked[self.atoms]).max())
        # Impulses that bring positions back know them to rounding, whatever the speed: a wheel may start from rest.
        rounding = 4 * _EPS * float(np.abs(x0).max()) / abs(h)
        error = np.inf
        for _ in range(_MAX_ITERATIONS):
            np.copyto(v, kicked)
            v[self.atoms] += (impulses @ push).reshape(-1, 3)
            np.multiply(v, h, out=out)
            out += x
            self.motion.project_positions(out, x, time=end, reference_time=start, velocities=v, dt=h, out=out)
            between = 0.5 * (x0 + out[self.atoms])
            rows = self.held.jacobian(between, middle).toarray()[self.is_velocity]
            wanted = self.held.velocity_target(between, middle)[self.is_velocity]
            local = v[self.atoms].ravel()
            miss = (rows @ local - wanted) / size[self.is_velocity]
            speed = max(before, float(np.abs(local).max()), float(np.abs(wanted / size[self.is_velocity]).max()))
            last, error = error, float(np.abs(miss).max())
            if error <= 4 * _EPS * speed or (error >= last and error <= max(1e-13 * speed, rounding)):
                point.x = out
                return
            impulses -= respond @ miss
        worst = int(self.rows[self.is_velocity][np.argmax(np.abs(miss))])
        raise ConvergenceError(
            f"velocity row {self.whole.row_name(worst)} is not fulfilled at the middle of the step: relative residual "
            f"{error / speed:.3g} after {_MAX_ITERATIONS} iterations",
            residual=error / speed,
            tolerance=4 * _EPS,
            iterations=_MAX_ITERATIONS,
            row=worst,
            atoms=self.whole.row_atoms(worst),
        )


def rattle_drift(motion: Motion, inverse_masses: FloatArray) -> Drift:
    """The drift of order 2 for what `motion` holds."""
    if motion.constraint_set.holonomic.all():
        return FreeFlight(motion)
    return NonholonomicFlight(motion, inverse_masses)


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
