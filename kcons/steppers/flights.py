"""Whole stages in one compiled call, where distances at rest and fixed atoms are all that is held.

A call from Python to a kernel costs as much as the kernel's work on ten molecules of water or more. A stage - a kick,
then flights that are each brought back onto the constraints - is therefore one call here, and so is the end of a step.
The kernels are those of `Point` and of the engine, with all of their residual checks; what they cannot solve is left
as it was for the engine, which has more means and names the row.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.motion import MANY_ITERATIONS, Motion
from kcons.plan import DistanceClusters
from kcons.solvers.groups import lattice_kind
from kcons.solvers.packed import Packed, packed, packed_positions, packed_tangents
from kcons.solvers.water import RigidTriangles
from kcons.steppers.summation import Point, add_kick, all_finite, fly, fly_first, fly_once, land

#: Rows, besides those of triangles, up to which one kernel for all shapes is faster than the engine's for each shape.
MOST_ROWS = 128

#: What a kernel reports.
_DONE, _FORCE, _POSITION, _VELOCITY, _ENGINE = range(5)
_WHAT = ("", "force", "position", "velocity")


class Flights:
    """Stages of a step for one engine.

    Parameters
    ----------
    motion : Motion
    tables : tuple of ndarray
        All its rows, from `kcons.solvers.packed`.
    """

    def __init__(self, motion: Motion, tables: Packed) -> None:
        self.motion = motion
        self._tables = tables
        self._lattice = motion.lattice
        self._all_tables = (*lattice_kind(self._lattice), *tables)

    @classmethod
    def of(cls, motion: Motion) -> Flights | None:
        """For the rows of `motion`, or None if they are too many, move, or hold anything but distances."""
        found = _packed(motion)
        return None if found is None else cls(motion, found)

    def tables(self) -> tuple[Any, ...]:
        """What the kernels need to know, for one step: the cell as it is now, and the rows."""
        lattice = self.motion.lattice
        if lattice is not self._lattice:
            self._lattice, self._all_tables = lattice, (*lattice_kind(lattice), *self._tables)
        return self._all_tables

    def move(
        self, point: Point, fractions: FloatArray, dt: float, out: FloatArray, time: float, tables: tuple[Any, ...]
    ) -> str:
        """`stage` for a point, with the kick that it has not taken yet; `out` becomes point.x."""
        kick, force = point.take_kick()
        v, fresh = point.v, point.fresh
        if fresh:
            point.v = np.empty_like(v)
            if point.x_low is None:
                point.push = point.v
            point.fresh = False
        bad = self.stage(point.x, v, point.v, point.work, kick, force, point.weights, fresh, fractions, dt, out, time,
            tables,
        )  # fmt: skip
        if not bad:
            point.x = out
        return bad

    def stage(
        self,
        x: FloatArray,
        v0: FloatArray,
        v: FloatArray,
        work: FloatArray,
        kick: float,
        force: FloatArray,
        weights: FloatArray,
        fresh: bool,
        fractions: FloatArray,
        dt: float,
        out: FloatArray,
        time: float,
        tables: tuple[Any, ...],
    ) -> str:
        """A kick of `v0` by kick M^-1 force, then flights from `x` on; the last ends in `out`.

        Parameters
        ----------
        x, v0 : ndarray, shape (n_atoms, 3)
        v : ndarray, shape (n_atoms, 3)
            The velocities in the end; may be `v0`.
        work : ndarray, shape (3, n_atoms, 3) or (0, 0, 3)
            That of `Point`.
        kick, force
            As for `Point.kick`.
        weights : ndarray, shape (n_atoms, 3)
            1/m.
        fresh : bool
            Whether `work` holds nothing yet.
        fractions : ndarray, shape (n_flights,)
            Of `dt`. One only where nothing is added up.
        dt : float
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
        # For other arrays, such as read-only ones, everything would be compiled once more.
        x, v0, force = (a if a.flags.carray else np.array(a, dtype=np.float64, order="C") for a in (x, v0, force))
        status, at, iterations = _stage(fractions, dt, 0, x, v0, v, work, kick, force, weights, fresh, out, *tables)
        while status == _ENGINE:
            ends, starts = out, x
            if len(fractions) > 1:
                spare = work[2]
                ends, starts = (out, spare) if (len(fractions) - at) % 2 else (spare, out)
            h = float(fractions[at]) * dt
            push = work[1] if len(work) else v
            self.motion.project_positions(ends, starts if at else x, time=time, velocities=push, dt=h, out=ends)
            status, at, iterations = _stage(
                fractions, dt, at + 1, x, v, v, work, 0.0, weights, weights, False, out, *tables
            )
        if status == _DONE:
            if iterations >= 0:
                self.motion.took(iterations)
            return ""
        return _WHAT[status]

    def end(
        self,
        x: FloatArray,
        v: FloatArray,
        work: FloatArray,
        kick: float,
        force: FloatArray,
        weights: FloatArray,
        time: float,
        tables: tuple[Any, ...],
    ) -> str:
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
        status = _end(x, v, work, kick, force, weights, *tables)
        if status == _ENGINE:
            self.motion.project_velocities(x, v, time=time, out=v)
            status = _DONE if all_finite(v) else _VELOCITY
        return _WHAT[status]


def _packed(motion: Motion) -> Packed | None:
    """The tables of all rows; None where there are rows that the kernels do not know."""
    plan, held = motion.plan, motion.constraint_set
    if plan.driven or held.moving or plan.loose is not None:
        return None
    # Where few atoms are held, the engine works on a copy of these, and counts only them.
    compact = plan.constraint_set is not held
    inverse_masses, pinned = plan.inverse_masses, plan.pinned
    if compact:
        inverse_masses = np.zeros(motion.n_atoms)
        inverse_masses[held.touched] = plan.inverse_masses
        pinned = held.touched[pinned]
    triangles: RigidTriangles | None = None
    rows: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    for solver in plan.solvers:
        if not isinstance(solver, DistanceClusters):
            return None
        if triangles is None and not compact and isinstance(solver.solver, RigidTriangles):
            triangles = solver.solver
        else:
            rows.append(solver.rows)
    others = np.concatenate(rows)
    if len(others) > MOST_ROWS:
        return None
    pairs = np.array([held.row_atoms(int(row)) for row in others], dtype=np.int64).reshape(-1, 2)
    lengths = held.target(0.0)[others]
    return packed(triangles, pairs, lengths, inverse_masses, pinned, plan.pinned_targets(None))


# The tables are those of `Flights.tables`: lattice, kind, and what `kcons.solvers.packed` takes.


@numba.njit(cache=True, nogil=True)
def _flight(x, v0, v, work, kick, force, weights, fresh, h, out, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]
    """Fly into `out` and land there; iterations, -1 if it did not land, -2 if the force is not finite."""
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
    return packed_positions(out, x, push, 1.0 / h, lattice, kind, numbers, whole, small)


@numba.njit(cache=True, nogil=True)
def _stage(fractions, dt, first, x, v0, v, work, kick, force, weights, fresh, out, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]  # fmt: skip
    """Flights from number `first` on; they end in `out` and in work[2] by turns, the last one in `out`."""
    n, took = fractions.size, -1
    for i in range(first, n):
        h = fractions[i] * dt
        start, end = (work[2], out) if (n - i) % 2 == 1 else (out, work[2])
        if i == 0:
            start = x
        else:
            kick, fresh = 0.0, False
        took = _flight(start, v0 if i == 0 else v, v, work, kick, force, weights, fresh, h, end,
            lattice, kind, numbers, whole, small,
        )  # fmt: skip
        if not 0 <= took <= MANY_ITERATIONS:
            return (_FORCE if took == -2 else _ENGINE), i, took
    return _DONE, n, took


@numba.njit(cache=True, nogil=True)
def _end(x, v, work, kick, force, weights, lattice, kind, numbers, whole, small):  # type: ignore[no-untyped-def]
    """A kick, then the velocities projected."""
    sound = add_kick(v, kick, force, weights) if work.shape[0] == 0 else land(v, work[1], kick, force, weights)
    if not sound:
        return _FORCE
    if not all_finite(x):
        return _POSITION
    if not packed_tangents(x, v, lattice, kind, numbers, whole, small):
        return _ENGINE
    return _DONE if all_finite(v) else _VELOCITY
