"""The two halves of an isokinetic step in one compiled call each, where one compiled solver holds all there is.

A step of a few molecules spends its time in calls from Python to kernels. The kick and the flight before the forces
are therefore one call, and the two projections and the kick after them another. The kernels are those of the engine
and of the closed form, with all of their checks, on the tables of `solvers.fused_distances`; what they cannot do is
left to these, as it was.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.solvers.fused_distances import MORE, packed_positions, packed_tangents
from kcons.solvers.kernels.array_views import integers, piece
from kcons.solvers.sparse.step_control import MANY_ITERATIONS
from kcons.steppers import System
from kcons.steppers.stages.compensated_steps import all_finite
from kcons.steppers.stages.fused_stages import PackedRows, Tables, packed_rows
from kcons.thermostats.isokinetic.kick import after_drift, before_drift

#: Square of a velocity across the constraints, relative to 2K, that is too much for a drift to take out exactly.
MANY = 1e4

#: What a kernel reports: whose array is not finite, or whom to ask instead.
DONE, FORCE, POSITION, VELOCITY, KICK, ENGINE = range(6)


class IsokineticStages(Tables):
    """Compiled halves of a step for one system.

    Parameters
    ----------
    system : System
    found : PackedRows
        All its rows, from `fused_distances`; then 1/m for each coordinate, the masses of the thermostatted atoms,
        and whether others move.
    made_of : tuple
    """

    def __init__(self, system: System, found: PackedRows, made_of: tuple[Any, ...]) -> None:
        super().__init__(system.motion, found, made_of)
        self._shape = (system.n_atoms, 3)

    @classmethod
    def of(  # type: ignore[override]
        cls, system: System, masses: FloatArray, others: bool
    ) -> IsokineticStages | None:
        """For `system`, or None if its rows are too many, move, or hold what no kernel knows.

        Parameters
        ----------
        system : System
        masses : ndarray, shape (n_atoms, 3)
            Masses of the thermostatted atoms; 0 for the others.
        others : bool
            Whether any of the others move.
        """
        if system.force is None:
            return None
        found = packed_rows(system.motion, system.weights.ravel(), masses.ravel(), np.array([float(others)]))
        return None if found is None else cls(system, found, (system, masses, others))

    def before(
        self,
        x: FloatArray,
        u: FloatArray,
        f: FloatArray,
        square: float,
        twice: float,
        t: float,
        h: float,
        tables: FloatArray,
    ) -> tuple[int, FloatArray, FloatArray, float]:
        """The kick over t before a flight over h, and the flight, which ends on the constraints.

        Parameters
        ----------
        x, u, f : ndarray, shape (n_atoms, 3)
            Positions, velocities on the constraints, forces.
        square, twice : float
            f.M_par^+ f and 2K.
        tables : ndarray of float64
            From `tables`, in this step.

        Returns
        -------
        status : int
            DONE; POSITION (those returned are not finite); KICK (it needs the projected forces) or ENGINE (no landing),
            where nothing was done.
        positions, velocities : ndarray, shape (n_atoms, 3)
            The velocities are to be projected.
        log_growth : float
            The integral of alpha over the kick.
        """
        place, speed = np.empty(self._shape), np.empty(self._shape)
        status, log_growth, iterations = kick_and_fly(x, u, f, square, twice, t, h, speed, place, tables)
        if status == DONE:
            self.motion.took(iterations)
        self.refuse()
        return status, place, speed, log_growth

    def after(
        self, x: FloatArray, u: FloatArray, f: FloatArray, twice: float, t: float, tables: FloatArray
    ) -> tuple[int, FloatArray, FloatArray, float, float, float]:
        """Velocities and forces projected at x, and the kick over t.

        Parameters
        ----------
        x, u, f : ndarray, shape (n_atoms, 3)
            Positions; velocities, which are projected in place; forces.
        twice, t : float
            2K, and the time.
        tables : ndarray of float64
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
        status, square, factor, log_growth = project_and_kick(x, u, f, twice, t, speed, pace, tables)
        self.refuse()
        return status, speed, pace, square, factor, log_growth


@njit(cache=True, nogil=True, fastmath={"contract"})
def _fly(x, u, h, out):  # type: ignore[no-untyped-def]
    a, b, c = x.ravel(), u.ravel(), out.ravel()
    for i in range(a.size):
        c[i] = a[i] + h * b[i]


@njit(cache=True, nogil=True)
def _push_others(u, push, t, weights, masses, out):  # type: ignore[no-untyped-def]
    """out = u + t push for atoms that move and are not thermostatted."""
    a, b, c, w, m = u.ravel(), push.ravel(), out.ravel(), weights.ravel(), masses.ravel()
    for i in range(a.size):
        if m[i] == 0 and w[i] > 0:
            c[i] = a[i] + t * b[i]


@njit(cache=True, nogil=True)
def _accelerations(f, weights, out):  # type: ignore[no-untyped-def]
    a, w, c = f.ravel(), weights.ravel(), out.ravel()
    for i in range(a.size):
        c[i] = w[i] * a[i]


@njit(cache=True, nogil=True, error_model="numpy")
def kick_and_fly(x, u0, f, square, twice, t, h, u, out, tables):  # type: ignore[no-untyped-def]
    """`IsokineticStages.before`; status, log of the growth, and iterations."""
    header = integers(tables)
    weights, masses, apart = (
        piece(tables, header, MORE),
        piece(tables, header, MORE + 1),
        piece(tables, header, MORE + 2),
    )
    log_growth, done = before_drift(u0, f, weights, masses, square, twice, t, MANY, u)
    if not done:
        return KICK, 0.0, 0
    if apart[0] != 0:
        _accelerations(f, weights, out)
        _push_others(u0, out, t, weights, masses, u)
    _fly(x, u, h, out)
    iterations = packed_positions(out, x, u, 1.0 / h, tables)
    if not all_finite(out):
        return POSITION, log_growth, 0
    return (DONE if 0 <= iterations <= MANY_ITERATIONS else ENGINE), log_growth, iterations


@njit(cache=True, nogil=True, error_model="numpy")
def project_and_kick(x, u, f, twice, t, out, pace, tables):  # type: ignore[no-untyped-def]
    """`IsokineticStages.after`; status, f.M_par^+ f, factor, and log of the growth."""
    header = integers(tables)
    weights, masses, apart = (
        piece(tables, header, MORE),
        piece(tables, header, MORE + 1),
        piece(tables, header, MORE + 2),
    )
    if not all_finite(f):
        return FORCE, 0.0, 0.0, 0.0
    if not all_finite(x):
        return POSITION, 0.0, 0.0, 0.0
    _accelerations(f, weights, pace)
    # One call site, which is compiled once.
    for y in (u, pace):
        if not packed_tangents(x, y, tables):
            return ENGINE, 0.0, 0.0, 0.0
    square, factor, log_growth, done = after_drift(u, pace, masses, twice, t, out)
    if not done:
        return KICK, square, factor, log_growth
    if apart[0] != 0:
        _push_others(u, pace, t, weights, masses, out)
    return (DONE if all_finite(out) else VELOCITY), square, factor, log_growth
