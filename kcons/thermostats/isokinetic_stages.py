"""The two halves of an isokinetic step in one compiled call each, where one compiled solver holds all there is.

A step of a few molecules spends its time in calls from Python to kernels. The kick and the flight before the forces
are therefore one call, and the two projections and the kick after them another. The kernels are those of the engine
and of the closed form, with all of their checks; what they cannot do is left to these, as it was.
"""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np

from kcons.constraints.target import FloatArray
from kcons.motion import MANY_ITERATIONS
from kcons.plan import DistanceClusters
from kcons.solvers.compiled import Tables, kind_and_tables, land, level
from kcons.solvers.groups import lattice_kind
from kcons.steppers import System
from kcons.steppers.summation import all_finite
from kcons.thermostats.kick import after_drift, before_drift

#: Square of a velocity across the constraints, relative to 2K, that is too much for a drift to take out exactly.
MANY = 1e4

#: What a kernel reports: whose array is not finite, or whom to ask instead.
DONE, FORCE, POSITION, VELOCITY, KICK, ENGINE = range(6)


class IsokineticStages:
    """Compiled halves of a step for one system.

    Parameters
    ----------
    system : System
    kind : int
        Kind of the solver of all its rows, see `kcons.solvers.compiled`.
    tables : tuple of ndarray
        Those of the solver.
    masses : ndarray, shape (n_atoms, 3)
        Masses of the thermostatted atoms; 0 for the others.
    others : bool
        Whether any of the others move.
    """

    def __init__(self, system: System, kind: int, tables: Tables, masses: FloatArray, others: bool) -> None:
        self._motion, self._shape = system.motion, (system.n_atoms, 3)
        self._before, self._after = _kernels(kind)
        self._atoms = system.weights, masses, others
        self._solver = tables
        self._lattice: FloatArray | None = None
        self._tables = (*self._atoms, *lattice_kind(None), *tables)

    @classmethod
    def of(cls, system: System, masses: FloatArray, others: bool) -> IsokineticStages | None:
        """For `system`, or None if its rows need more than one compiled solver, move, or leave most atoms alone."""
        motion = system.motion
        plan = motion.plan
        if system.force is None or motion.constraint_set.moving or plan.driven or len(plan.pinned):
            return None
        if plan.constraint_set is not motion.constraint_set or len(plan.solvers) != 1:
            return None
        solver = plan.solvers[0]
        # Exactly this class: those derived from it do more than their solver.
        found = kind_and_tables(solver.solver) if type(solver) is DistanceClusters else None
        return None if found is None else cls(system, *found, masses, others)

    def tables(self) -> tuple[Any, ...]:
        """What the kernels need to know, for one step: masses, the cell as it is now, the tables of the solver."""
        lattice = self._motion.lattice
        if lattice is not self._lattice:
            self._lattice = lattice
            self._tables = (*self._atoms, *lattice_kind(lattice), *self._solver)
        return self._tables

    def before(
        self,
        x: FloatArray,
        u: FloatArray,
        f: FloatArray,
        square: float,
        twice: float,
        t: float,
        h: float,
        tables: tuple[Any, ...],
    ) -> tuple[int, FloatArray, FloatArray, float]:
        """The kick over t before a flight over h, and the flight, which ends on the constraints.

        Parameters
        ----------
        x, u, f : ndarray, shape (n_atoms, 3)
            Positions, velocities on the constraints, forces.
        square, twice : float
            f.M_par^+ f and 2K.
        tables : tuple
            From `tables`, in this step.

        Returns
        -------
        status : int
            DONE, POSITION, KICK (nothing was done: the kick needs the projected forces), or ENGINE (the kick was done;
            the positions are those before they are brought onto the constraints).
        positions, velocities : ndarray, shape (n_atoms, 3)
            The velocities are to be projected.
        log_growth : float
            The integral of alpha over the kick.
        """
        place, speed = np.empty(self._shape), np.empty(self._shape)
        status, log_growth, iterations = self._before(x, u, f, square, twice, t, h, speed, place, *tables)
        if status == DONE:
            self._motion.took(iterations)
        return status, place, speed, log_growth

    def after(
        self, x: FloatArray, u: FloatArray, f: FloatArray, twice: float, t: float, tables: tuple[Any, ...]
    ) -> tuple[int, FloatArray, FloatArray, float, float, float]:
        """Velocities and forces projected at x, and the kick over t.

        Parameters
        ----------
        x, u, f : ndarray, shape (n_atoms, 3)
            Positions; velocities, which are projected in place; forces.
        twice, t : float
            2K, and the time.
        tables : tuple
            From `tables`, in this step.

        Returns
        -------
        status : int
            DONE, FORCE, POSITION, VELOCITY, KICK (projected, but the kick needs `turned`), or ENGINE (nothing was done,
            or u projected and nothing else).
        velocities, pace : ndarray, shape (n_atoms, 3)
            u after the kick, and M_par^+ f.
        square, factor, log_growth : float
            f.M_par^+ f, by what u is brought to its length, and the integral of alpha.
        """
        speed, pace = np.empty(self._shape), np.empty(self._shape)
        status, square, factor, log_growth = self._after(x, u, f, twice, t, speed, pace, *tables)
        return status, speed, pace, square, factor, log_growth


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def _fly(x, u, h, out):  # type: ignore[no-untyped-def]
    a, b, c = x.ravel(), u.ravel(), out.ravel()
    for i in range(a.size):
        c[i] = a[i] + h * b[i]


@numba.njit(cache=True, nogil=True)
def _push_others(u, push, t, weights, masses, out):  # type: ignore[no-untyped-def]
    """out = u + t push for atoms that move and are not thermostatted."""
    a, b, c, w, m = u.ravel(), push.ravel(), out.ravel(), weights.ravel(), masses.ravel()
    for i in range(a.size):
        if m[i] == 0 and w[i] > 0:
            c[i] = a[i] + t * b[i]


@numba.njit(cache=True, nogil=True)
def _accelerations(f, weights, out):  # type: ignore[no-untyped-def]
    a, w, c = f.ravel(), weights.ravel(), out.ravel()
    for i in range(a.size):
        c[i] = w[i] * a[i]


@functools.cache
def _kernels(kind: int) -> tuple[Any, Any]:
    """Kernels around the solver of one kind, a constant to them."""
    solver = kind

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def before(  # type: ignore[no-untyped-def]
        x, u0, f, square, twice, t, h, u, out, weights, masses, others, lattice, image, *tables
    ):
        log_growth, done = before_drift(u0, f, weights, masses, square, twice, t, MANY, u)
        if not done:
            return KICK, 0.0, 0
        if others:
            _accelerations(f, weights, out)
            _push_others(u0, out, t, weights, masses, u)
        _fly(x, u, h, out)
        iterations = land(solver, out, x, u, 1.0 / h, lattice, image, tables)
        if not 0 <= iterations <= MANY_ITERATIONS:
            return ENGINE, log_growth, 0
        return (DONE if all_finite(out) else POSITION), log_growth, iterations

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def after(  # type: ignore[no-untyped-def]
        x, u, f, twice, t, out, pace, weights, masses, others, lattice, image, *tables
    ):
        if not all_finite(f):
            return FORCE, 0.0, 0.0, 0.0
        if not all_finite(x):
            return POSITION, 0.0, 0.0, 0.0
        _accelerations(f, weights, pace)
        if not (level(solver, x, u, lattice, image, tables) and level(solver, x, pace, lattice, image, tables)):
            return ENGINE, 0.0, 0.0, 0.0
        square, factor, log_growth, done = after_drift(u, pace, masses, twice, t, out)
        if not done:
            return KICK, square, factor, log_growth
        if others:
            _push_others(u, pace, t, weights, masses, out)
        return (DONE if all_finite(out) else VELOCITY), square, factor, log_growth

    return before, after
