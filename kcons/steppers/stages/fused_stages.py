"""Whole stages in one compiled call, where all that is held is at rest, and few rows of it are no distances.

A call from Python to a kernel costs as much as the kernel's work on ten molecules of water or more. A stage - a kick,
then flights that are each brought back onto the constraints - is therefore one call here, and so is the end of a step.
The kernels are those of `Point` and of the engine, with all of their residual checks; what they cannot solve is left
as it was for the engine, which has more means and names the row. Their tables are those of `solvers.fused_distances`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion
from kcons.solvers.called_solvers import CalledSolver
from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.cluster_solver import ClusterSolver
from kcons.solvers.distance_clusters import DistanceClusters
from kcons.solvers.fused_distances import MORE, packed, packed_positions, packed_tangents, set_lattice
from kcons.solvers.kernels.array_views import integers, piece
from kcons.solvers.rigid_triangles import RigidTriangles
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.sparse.mixed_rows import SparseRows
from kcons.solvers.sparse.row_functions import COUNT
from kcons.solvers.sparse.step_control import MANY_ITERATIONS
from kcons.steppers.stages.compensated_steps import (
    Point,
    add_kick,
    all_finite,
    beyond,
    check_finite,
    fly,
    fly_first,
    fly_once,
    land,
)

#: Rows, besides those of triangles, up to which one kernel for all shapes is faster than the engine's for each shape.
MOST_ROWS = 96
#: Chains have a kernel of their own, which costs as much as that for all shapes on so many rows, and so many more a
#: slot of eight lanes; where others are held so that both are called, on more.
CHAIN_ROWS, CHAIN_ROWS_BESIDES, ROWS_A_SLOT = 20, 40, 2

#: What a kernel is to do: end the last step, begin the next stage, or both.
END, FLY, BOTH = 1, 2, 3
#: What a kernel reports of a stage besides iterations: the step before could not be ended; the force is not finite; the
#: engine has to do a flight (less the number of the flight).
UNENDED, _FORCE, _ENGINE = -1, -2, -3
#: No number of iterations.
_UNKNOWN = 1000
#: Types of the arguments of `one_flight` and `many_flights`.
_POINTS = numba.float64[:, ::1]
_ONE = (
    *(numba.int64, numba.float64, _POINTS, _POINTS, _POINTS, numba.float64, numba.float64, _POINTS, _POINTS),
    numba.float64[::1],
)
_MANY = (
    *(numba.int64, numba.float64[::1], numba.float64, numba.int64, _POINTS, _POINTS, _POINTS, numba.float64[:, :, ::1]),
    *(numba.float64, numba.float64, _POINTS, numba.boolean, _POINTS, numba.float64[::1]),
)
#: Of a stage that is not flown.
NO_FRACTIONS = np.empty(0)
#: What it reports of the end of a step but 0; less than that where the engine has to do it.
_BAD_FORCE, _BAD_POSITION, _BAD_VELOCITY, _FAR = 1, 2, 3, 4


class Tables:
    """What compiled stages need to know of one engine.

    Parameters
    ----------
    motion : Motion
    found : PackedRows
        All its rows, and more, from `packed_rows`.
    made_of : tuple
        What `of` was given.
    """

    def __init__(self, motion: Motion, found: PackedRows, made_of: tuple[Any, ...]) -> None:
        self.motion = motion
        self._tables, self._called = found
        self._made_of = made_of
        self._cell = motion.cell
        self._lattice = motion.lattice
        set_lattice(self._tables, self._lattice)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, self._made_of  # addresses are of no use elsewhere

    def refuse(self) -> None:
        """Raise what a Python function among the rows has raised, where a kernel reports that it could not go on."""
        for solver in self._called:
            solver.refuse()

    @classmethod
    def of(cls, *made_of: Any) -> Tables | None:
        """For all that is held, or None where that is not for compiled stages."""
        raise NotImplementedError

    def tables(self) -> FloatArray:
        """What the kernels need to know, for one step: the rows, and the cell as it is now."""
        lattice = self._cell()
        if lattice is not self._lattice:
            self._lattice = lattice
            set_lattice(self._tables, lattice)
        return self._tables


class Flights(Tables):
    """Stages of a step for one engine.

    Parameters
    ----------
    motion : Motion
    found : PackedRows
        All its rows, from `packed_rows`, 1/m for each coordinate, the atoms that show whether the system is
        far from the origin, the first of them the one that positions are then taken relative to, and how far is far.
    made_of : tuple
    """

    def __init__(self, motion: Motion, found: PackedRows, made_of: tuple[Any, ...]) -> None:
        super().__init__(motion, found, made_of)
        #: Iterations that the engine has been told of.
        self.took = _UNKNOWN
        self._kernels: dict[Any, Any] = {}

    @classmethod
    def of(  # type: ignore[override]
        cls, motion: Motion, weights: FloatArray, held: IntArray, far: float
    ) -> Flights | None:
        """For the rows of `motion`, or None if they are too many, move, or hold what no kernel knows.

        Parameters
        ----------
        motion : Motion
        weights : ndarray, shape (n_atoms, 3)
            1/m.
        held : ndarray of int
            Atoms none of which is far from the first where the system is near the origin; empty if it is never far.
        far : float
            The system is far if the first is this many times farther from the origin than from any other.
        """
        found = packed_rows(motion, weights.ravel(), held, np.array([far]))
        return None if found is None else cls(motion, found, (motion, weights, held, far))

    @property
    def one(self) -> Any:
        """`one_flight` for these tables, without Numba's dispatcher.

        That asks for the type of each argument, which takes as long as a dozen bonds. Here all arrays are of one type,
        and have to be: contiguous, of doubles.
        """
        return self._kernel(one_flight, _ONE)

    @property
    def many(self) -> Any:
        """`many_flights` in the same way."""
        return self._kernel(many_flights, _MANY)

    def _kernel(self, function: Any, types: tuple[Any, ...]) -> Any:
        found = self._kernels.get(function)
        if found is None:
            found = self._kernels[function] = function.compile(types)
        return found

    def move(
        self,
        point: Point,
        fractions: FloatArray,
        dt: float,
        out: FloatArray,
        time: float,
        number: int,
        tables: FloatArray,
    ) -> None:
        """A stage from a point, with the kick that it has not taken yet; `out` becomes point.x.

        Raises
        ------
        ConvergenceError, NonFiniteError
            As `landed`.
        """
        kick, force = point.take_kick()
        x, before, fresh = point.x, point.v, point.fresh
        if fresh:
            point.v = np.empty(before.shape)
            if point.x_low is None:
                point.push = point.v
            point.fresh = False
        v, work = point.v, point.work
        if len(work):
            found = self.many(FLY, fractions, dt, 0, x, before, v, work, 0.0, kick, force, fresh, out, tables)
        else:
            found = self.one(FLY, dt, x, before, v, 0.0, kick, force, out, tables)
        if found != self.took:
            point.sound = found != _FORCE
            self.landed(found, fractions, dt, x, v, work, force, out, time, number, tables)
        point.x = out

    def landed(
        self,
        found: int,
        fractions: FloatArray,
        dt: float,
        x: FloatArray,
        v: FloatArray,
        work: FloatArray,
        force: FloatArray,
        out: FloatArray,
        time: float,
        number: int,
        tables: FloatArray,
    ) -> int:
        """What `one_flight` or `many_flights` left to do, from what it reports and the rest of what it was given.

        Parameters
        ----------
        time, number : float, int
            Of the end of the stage, and of the step; for messages.

        Returns
        -------
        int
            Iterations, as `took`.

        Raises
        ------
        ConvergenceError
            As a flight by the engine.
        NonFiniteError
            The force of the kick is not finite.
        """
        while found < 0:
            if found == _FORCE:
                check_finite(force, "force", number)
            self.refuse()
            at = _ENGINE - found
            ends, starts, push, h = out, x, v, dt
            if len(work):
                spare, push, h = work[2], work[1], float(fractions[at]) * dt
                ends, starts = (out, spare) if (len(fractions) - at) % 2 else (spare, out)
            self.took = _UNKNOWN
            start = starts if at else x
            self.motion.project_positions(ends, start, time=time, velocities=push, dt=h, flight=h, out=ends)
            if at + 1 == len(fractions):
                return self.took
            found = self.many(FLY, fractions, dt, at + 1, x, v, v, work, 0.0, 0.0, force, False, out, tables)
        if found != self.took:
            self.took = found
            self.motion.took(found)
        return found

    def end(self, point: Point, dt: float, time: float, number: int, tables: FloatArray) -> None:
        """The last kick of a step, which the point has not taken yet, and its velocities projected.

        Raises
        ------
        ConvergenceError, NonFiniteError
            As `ended`.
        """
        kick, force = point.take_kick()
        x, v, work = point.x, point.v, point.work
        if len(work):
            found = self.many(END, NO_FRACTIONS, dt, 0, x, v, v, work, kick, 0.0, force, False, x, tables)
        else:
            found = self.one(END, dt, x, v, v, kick, 0.0, force, x, tables)
        if found:
            point.sound = found != _BAD_FORCE
            self.ended(found, x, v, force, time, number, tables)

    def ended(
        self, found: int, x: FloatArray, v: FloatArray, force: FloatArray, time: float, number: int, tables: FloatArray
    ) -> bool:
        """What an `END` left to do, from what it reports and what it was given.

        Returns
        -------
        bool
            Whether all is so far from the origin that the next step is made relative to an atom.

        Raises
        ------
        ConvergenceError
            As `Motion.project_velocities`.
        NonFiniteError
            Forces, positions or velocities are not finite.
        """
        if found < 0:
            self.refuse()
            self.motion.project_velocities(x, v, time=time, out=v)
            found = _after(x, v, tables)
        if _BAD_FORCE <= found <= _BAD_VELOCITY:
            values, item = ((force, "force"), (x, "position"), (v, "velocity"))[found - _BAD_FORCE]
            check_finite(values, item, number)
        return found == _FAR


class PackedRows(NamedTuple):
    """The tables of all rows, and whom the kernels call by what stands there: to be kept as long as these."""

    tables: FloatArray
    called: list[CalledSolver]


def packed_rows(motion: Motion, *more: NDArray[Any]) -> PackedRows | None:
    """The tables of all rows, and `more`; None where there are rows that the kernels do not know, or too many."""
    plan, held = motion.plan, motion.constraint_set
    if held.moving or plan.loose is not None or any(plan.whole):
        return None
    if plan.driven and held.target(0.0)[~held.holonomic].any():
        return None
    # Where few atoms are held, the engine works on a copy of these, and counts only them.
    compact = plan.constraint_set is not held
    inverse_masses, pinned = plan.inverse_masses, plan.pinned
    if compact:
        inverse_masses = np.zeros(motion.n_atoms)
        inverse_masses[held.touched] = plan.inverse_masses
        pinned = held.touched[pinned]
    triangles: RigidTriangles | None = None
    chains: Chains | None = None
    rows: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    mixed = [solver for solver in plan.solvers if not isinstance(solver, DistanceClusters)]
    for solver in plan.solvers:
        if isinstance(solver, DistanceClusters):
            if triangles is None and not compact and not mixed and isinstance(solver, RigidTriangles):
                triangles = solver
            elif chains is None and not mixed and isinstance(solver, Chains):
                chains = solver
            else:
                rows.append(solver.rows)
    if chains is not None and not _worth_it(chains, sum(map(len, rows))):
        rows.append(chains.rows)
        chains = None
    others = np.concatenate(rows)
    if len(others) > MOST_ROWS or not all(isinstance(each, SparseRows | SingleRows) for each in mixed):
        return None
    if mixed and (held.images is not None or sum(len(each.rows) for each in mixed) > MOST_ROWS):
        return None
    # Solvers of their own, for the atoms of the whole system: those of the plan may be at work for another one.
    called = [_solver_like(each, held, inverse_masses, plan.late) for each in mixed]
    pairs = np.array([held.row_atoms(int(row)) for row in others], dtype=np.int64).reshape(-1, 2)
    lengths = held.target(0.0)[others]
    places, numbers = plan.pinned_targets(None), held.touched if compact else None
    given = triangles, chains, pairs, lengths, inverse_masses, pinned, places
    return PackedRows(packed(*given, *more, numbers=numbers, late=plan.late[others], called=called), called)


def _solver_like(
    solver: ClusterSolver, held: ConstraintSet, inverse_masses: FloatArray, late: NDArray[np.bool_]
) -> CalledSolver:
    rows = np.sort(solver.rows)
    if isinstance(solver, SingleRows):
        return SingleRows(held, rows, inverse_masses)
    like = SparseRows(held, rows, inverse_masses, late[rows])
    like.numbers[COUNT] = 1.0  # all positions here are the ends of flights
    return like


def _worth_it(chains: Chains, others: int) -> bool:
    """Whether chains are faster by their own kernel than with other rows by that for all shapes."""
    least = (CHAIN_ROWS_BESIDES if others else CHAIN_ROWS) + ROWS_A_SLOT * chains.slots
    return len(chains.rows) > least or len(chains.rows) + others > MOST_ROWS


@njit(cache=True, nogil=True)
def _flight(x, v0, v, work, kick, force, weights, fresh, h, out, tables):  # type: ignore[no-untyped-def]
    """Fly into `out` and land there; iterations, -1 if it did not land, -2 if the force is not finite."""
    if fresh:
        sound = fly_first(x, work[0], v0, v, work[1], kick, force, weights, h, out)
    else:
        sound = fly(x, work[0], v, work[1], kick, force, weights, h, out)
    return packed_positions(out, x, work[1], 1.0 / h, tables) if sound else -2


@njit(cache=True, nogil=True)
def one_flight(what, h, x, v0, v, last_kick, kick, force, out, tables):  # type: ignore[no-untyped-def]
    """The end of a step, the first stage of the next, or both, where nothing adds up remainders.

    Parameters
    ----------
    what : int
        `END`: `v0` takes last_kick M^-1 force and is projected at `x`. `FLY`: a kick of `v0` by kick M^-1 force, then
        a flight of `h` from `x` to `out`. `BOTH`: one after the other.
    v : ndarray, shape (n_atoms, 3)
        The velocities after the flight; may be `v0`.
    tables
        From `Flights.tables`, in this step.

    Returns
    -------
    int
        Of an end alone 0, or what `Flights.ended` has to do. Otherwise iterations, or what `Flights.landed` has to do,
        or `UNENDED`.
    """
    weights = piece(tables, integers(tables), MORE)
    if what != FLY:
        found = _ended(add_kick(v0, last_kick, force, weights), x, v0, tables)
        if what == END or found != 0:
            return found if what == END else UNENDED
    if not fly_once(x, v0, kick, force, weights, h, v, out):
        return _FORCE
    took = packed_positions(out, x, v, 1.0 / h, tables)
    return took if 0 <= took <= MANY_ITERATIONS else _ENGINE


@njit(cache=True, nogil=True)
def many_flights(  # type: ignore[no-untyped-def]
    what,
    fractions,
    dt,
    first,
    x,
    v0,
    v,
    work,
    last_kick,
    kick,
    force,
    fresh,
    out,
    tables,
):
    """The same with a stage of flights of `fractions` of `dt`, from number `first` on; the last one ends in `out`.

    `work` is that of `Point`, `fresh` whether it holds nothing yet.
    """
    weights = piece(tables, integers(tables), MORE)
    if what != FLY:
        found = _ended(land(v0, work[1], last_kick, force, weights), x, v0, tables)
        if what == END or found != 0:
            return found if what == END else UNENDED
        fresh = True
    n, took = fractions.size, -1
    for i in range(first, n):
        # They end in `out` and in work[2] by turns.
        start, end = x, out
        if (n - i) % 2 == 0:
            end = work[2]
        if i > 0:
            start = out if (n - i) % 2 == 0 else work[2]
            v0, kick, fresh = v, 0.0, False
        took = _flight(
            start,
            v0,
            v,
            work,
            kick,
            force,
            weights,
            fresh,
            fractions[i] * dt,
            end,
            tables,
        )
        if not 0 <= took <= MANY_ITERATIONS:
            return _FORCE if took == -2 else _ENGINE - i
    return took


@njit(cache=True, nogil=True, inline="always")
def _ended(sound, x, v, tables):  # type: ignore[no-untyped-def]
    """Velocities projected after a kick, sound or not; 0, or what `Flights.ended` has to do."""
    if not sound:
        return _BAD_FORCE
    if not all_finite(x):
        return _BAD_POSITION
    return _after(x, v, tables) if packed_tangents(x, v, tables) else -1


@njit(cache=True, nogil=True, inline="always")
def _after(x, v, tables):  # type: ignore[no-untyped-def]
    if not all_finite(v):
        return _BAD_VELOCITY
    header = integers(tables)
    held, far = piece(header, header, MORE + 1), piece(tables, header, MORE + 2)
    return _FAR if held.size and beyond(x, held, held[0], far[0]) else 0
