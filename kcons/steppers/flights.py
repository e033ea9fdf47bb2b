"""Whole stages in one compiled call, where rigid triangles at rest are all that is held.

A call from Python to a kernel costs as much as the kernel's work on ten molecules of water or more. A stage - a kick,
then flights that are each brought back onto the constraints - is therefore one call here, and so is the end of a step.
The kernels are those of `Point` and of the engine, with all of their residual checks; what they cannot solve is left
as it was for the engine, which has more means and names the row.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from kcons.constraints.target import FloatArray
from kcons.motion import MANY_ITERATIONS, Motion
from kcons.solvers.groups import lattice_kind
from kcons.solvers.water import RigidTriangles, triangle_positions, triangle_tangents
from kcons.steppers.summation import Point, add_kick, all_finite, fly, fly_first, fly_once, land

#: What a kernel reports.
_DONE, _FORCE, _POSITION, _VELOCITY, _ENGINE = range(5)
_WHAT = ("", "force", "position", "velocity")


class Flights:
    """Stages of a step for one engine.

    Parameters
    ----------
    motion : Motion
    triangles : RigidTriangles
        The solver of all its rows.
    """

    def __init__(self, motion: Motion, triangles: RigidTriangles) -> None:
        self.motion = motion
        self._tables = triangles.tables()

    @classmethod
    def of(cls, motion: Motion) -> Flights | None:
        """For the rows of `motion`, or None if they hold anything else."""
        triangles = motion.triangles
        return None if triangles is None else cls(motion, triangles)

    def tables(self) -> tuple[Any, ...]:
        """What the kernels need to know, for one step: the cell as it is now, and the solver's tables."""
        return (*lattice_kind(self.motion.lattice), *self._tables)

    def stage(
        self,
        point: Point,
        kick: float,
        force: FloatArray,
        intervals: FloatArray,
        out: FloatArray,
        time: float,
        tables: tuple[Any, ...],
    ) -> str:
        """A kick, then flights of `intervals`; the last ends in `out`, which becomes point.x.

        Parameters
        ----------
        point : Point
            Without a kick that it has not taken yet.
        kick, force
            As for `Point.kick`.
        intervals : ndarray, shape (n_flights,)
            One only where `point` adds up nothing.
        out : ndarray, shape (n_atoms, 3)
        time : float
            For messages: nothing that is held here moves.
        tables : tuple
            From `tables`, in this step.

        Returns
        -------
        str
            Empty, or "force" where that of the kick is not finite.

        Raises
        ------
        ConvergenceError
            As a flight by the engine.
        """
        x, v, fresh = point.x, point.v, point.fresh
        if fresh:
            point.v = np.empty_like(v)
            if point.x_low is None:
                point.push = point.v
            point.fresh = False
        status, at, iterations = _stage(
            intervals, 0, x, v, point.v, point.work, kick, force, point.weights, fresh, out, *tables
        )
        while status == _ENGINE:
            ends, starts = out, x
            if len(intervals) > 1:
                spare = point.work[2]
                ends, starts = (out, spare) if (len(intervals) - at) % 2 else (spare, out)
            h = float(intervals[at])
            self.motion.project_positions(ends, starts if at else x, time=time, velocities=point.push, dt=h, out=ends)
            status, at, iterations = _stage(
                intervals, at + 1, x, v, point.v, point.work, 0.0, point.weights, point.weights, False, out, *tables
            )
        if status == _DONE:
            if iterations >= 0:
                self.motion.took(iterations)
            point.x = out
            return ""
        return _WHAT[status]

    def end(self, point: Point, kick: float, force: FloatArray, time: float, tables: tuple[Any, ...]) -> str:
        """A kick, and the velocities projected, after a stage.

        Returns
        -------
        str
            Empty, or what is not finite: "force", "position" or "velocity".

        Raises
        ------
        ConvergenceError
            As `Motion.project_velocities`.
        """
        status = _end(point.x, point.v, point.work, kick, force, point.weights, *tables)
        if status == _ENGINE:
            self.motion.project_velocities(point.x, point.v, time=time, out=point.v)
            return ""
        return _WHAT[status]


# The tables are those of `Flights.tables`: lattice, kind, atoms, slots, lengths, inverse masses, room to undo.


@numba.njit(cache=True, nogil=True)
def _flight(x, v0, v, work, kick, force, weights, fresh, h, out, *tables):  # type: ignore[no-untyped-def]
    """Fly into `out` and land there; iterations, -1 if it did not land, -2 if the force is not finite."""
    lattice, kind, atoms, slots, lengths, inv_mass, undo = tables
    if work.shape[0] == 0:
        push = v
        sound = fly_once(x, v0, kick, force, weights, h, v, out)
    else:
        push = work[1]
        if fresh:
            sound = fly_first(x, work[0], v0, v, push, kick, force, weights, h, out)
        else:
            sound = fly(x, work[0], v, push, kick, force, weights, h, out)
    if not sound:
        return -2
    landed, _, iterations, _ = triangle_positions(
        out, x, push, 1.0 / h, atoms, slots, lengths, inv_mass, lattice, kind, push[:0], undo
    )
    return iterations if landed else -1


@numba.njit(cache=True, nogil=True)
def _stage(intervals, first, x, v0, v, work, kick, force, weights, fresh, out, *tables):  # type: ignore[no-untyped-def]
    """Flights from number `first` on; they end in `out` and in work[2] by turns, the last one in `out`."""
    n, took = intervals.size, -1
    for i in range(first, n):
        h, last = intervals[i], (n - i) % 2 == 1
        # Written out: where a step starts the array may be of another type (read-only).
        if i == 0 and last:
            took = _flight(x, v0, v, work, kick, force, weights, fresh, h, out, *tables)
        elif i == 0:
            took = _flight(x, v0, v, work, kick, force, weights, fresh, h, work[2], *tables)
        elif last:
            took = _flight(work[2], v, v, work, 0.0, weights, weights, False, h, out, *tables)
        else:
            took = _flight(out, v, v, work, 0.0, weights, weights, False, h, work[2], *tables)
        if not 0 <= took <= MANY_ITERATIONS:
            return (_FORCE if took == -2 else _ENGINE), i, took
    return _DONE, n, took


@numba.njit(cache=True, nogil=True)
def _end(x, v, work, kick, force, weights, *tables):  # type: ignore[no-untyped-def]
    """A kick, then the velocities projected."""
    lattice, kind, atoms, slots, _, inv_mass, undo = tables
    sound = add_kick(v, kick, force, weights) if work.shape[0] == 0 else land(v, work[1], kick, force, weights)
    if not sound:
        return _FORCE
    if not all_finite(x):
        return _POSITION
    converged, _, _, _ = triangle_tangents(x, v, atoms, slots, v[:0], inv_mass, lattice, kind, v[:0], undo)
    if not converged:
        return _ENGINE
    return _DONE if all_finite(v) else _VELOCITY
