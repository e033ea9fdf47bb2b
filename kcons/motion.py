"""The engine: what constraints do to positions, velocities, accelerations and forces.

One `Motion` serves one `ConstraintSet`. It splits the rows into clusters, gives each the cheapest exact
solver for its shape (see `kcons.plan`), checks every solve by its residual, and raises a typed error
that names the row, with nothing changed, where there is no solution.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons import diagnosis
from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.degeneracy import without_second_order_rows
from kcons.errors import InputError
from kcons.far_starts import RESCUE_ROWS, FarStart
from kcons.plan import ClusterSolver, LongChains, Plan, make_plan, sparse_distances
from kcons.solvers.general import GeneralClusters
from kcons.solvers.outcome import Outcome

#: Rescues of single clusters by the damped solver within one call, before the call fails.
MAX_RESCUES = 20
#: Largest cluster, in rows, whose multipliers of least norm are found by dense algebra.
DENSE_ROWS = 1500
#: More Newton iterations than a time step of any use takes: the start was far off.
MANY_ITERATIONS = 6


class Motion:
    """Constrained motion of one system.

    Parameters
    ----------
    constraint_set : ConstraintSet
        What is held.
    positions : array_like, shape (n_atoms, 3)
        Positions on (or near) the surface; rank and shapes of clusters are found there.
    degenerate : {'convert', 'raise'}
        What to do with rows that are singular only at second order (a collinear or planar group held by
        all its distances): replace them by linear rows that hold the same, or refuse.
    time : float
        Time of `positions`, for targets that move.

    Attributes
    ----------
    constraint_set : ConstraintSet
        The rows really held: differs from what was given where rows were converted.
    plan : Plan
        Clusters and the solver picked for each.
    rank, degrees_of_freedom : int
        Independent rows, and 3 n_atoms - rank.

    Raises
    ------
    SingularGeometryError
        Second-order-singular rows that cannot be converted, or with ``degenerate='raise'``.
    ContradictionError
        Rows among fixed atoms only that are not fulfilled.

    References
    ----------
    Notes, section 4.1; eqs. 94-107.
    """

    def __init__(
        self,
        constraint_set: ConstraintSet,
        positions: ArrayLike,
        *,
        degenerate: Literal["convert", "raise"] = "convert",
        time: float = 0.0,
    ) -> None:
        if degenerate not in ("convert", "raise"):
            raise InputError(f"degenerate must be 'convert' or 'raise', not {degenerate!r}", item="degenerate")
        x = _positions(positions, constraint_set.n_atoms, "positions")
        self.constraint_set = without_second_order_rows(constraint_set, x, time, convert=degenerate == "convert")
        self.n_atoms = constraint_set.n_atoms
        self.masses = constraint_set.masses
        touched = self.constraint_set.touched
        # Few constrained atoms among many: work on a compact copy of them, and on nothing else.
        self._atoms: IntArray | None = None if 2 * len(touched) >= self.n_atoms else touched
        if self._atoms is None:
            self._local = self.constraint_set
        else:
            self._local, _ = self.constraint_set.subset(np.arange(self.constraint_set.n_rows))
        self.plan: Plan = make_plan(self._local, x if self._atoms is None else x[self._atoms], time)
        self._touched = touched
        self._rescuers: dict[int, ClusterSolver] = {}

    @property
    def rank(self) -> int:
        return self.plan.rank

    @property
    def degrees_of_freedom(self) -> int:
        return 3 * self.n_atoms - self.plan.rank

    # -- positions ------------------------------------------------------------------------------

    def project_positions(
        self,
        x_new: ArrayLike,
        x_ref: ArrayLike,
        *,
        time: float = 0.0,
        reference_time: float | None = None,
        velocities: FloatArray | None = None,
        dt: float | None = None,
        out: FloatArray | None = None,
        multipliers: FloatArray | None = None,
    ) -> FloatArray:
        """Solve sigma(x_new + M^-1 A(x_ref)^T Lambda, time) = 0 (SHAKE condition, true Newton).

        Parameters
        ----------
        x_new, x_ref : array_like, shape (n_atoms, 3)
            Positions to correct, and the positions whose gradients give the directions.
        time, reference_time : float
            Times of `x_new` and `x_ref`; `reference_time` defaults to `time`.
        velocities : ndarray, shape (n_atoms, 3), optional
            Changed in place by (correction)/`dt`, from the multipliers and not from rounded positions;
            those of fixed atoms stay as they are.
        dt : float, optional
            Needed with `velocities`.
        out : ndarray, optional
            Where to put the result; ``out=x_new`` works in place. Without it a new array is made.
        multipliers : ndarray, shape (n_rows,), optional
            Receives Lambda, in natural units (x_new is changed by M^-1 A^T Lambda).

        Returns
        -------
        ndarray, shape (n_atoms, 3)

        Raises
        ------
        ConvergenceError
            No solution near enough; nothing was changed.
        InputError
            Wrong shapes, or a NaN or infinity in the positions of a constrained atom.
        """
        x = _positions(x_new, self.n_atoms, "x_new")
        ref = _positions(x_ref, self.n_atoms, "x_ref")
        if out is None:
            out = x.copy()
        elif out is not x_new:
            _check_out(out, self.n_atoms)
            np.copyto(out, x)
        elif out is not x:
            raise InputError("in-place work needs a contiguous float64 array", item="out")
        inv_dt = 0.0
        if velocities is not None:
            _check_out(velocities, self.n_atoms, "velocities")
            if not dt or not np.isfinite(dt):
                raise InputError(f"velocities are corrected by 1/dt; dt is {dt}", item="dt")
            inv_dt = 1.0 / dt
        reference_time = time if reference_time is None else reference_time
        if self._atoms is None:
            self._positions_direct(out, ref, time, reference_time, velocities, inv_dt, multipliers)
            return out
        atoms = self._atoms
        part = out[atoms]
        speeds = None if velocities is None else velocities[atoms]
        self._positions_direct(part, ref[atoms], time, reference_time, speeds, inv_dt, multipliers)
        out[atoms] = part
        if velocities is not None:
            velocities[atoms] = speeds
        return out

    def _positions_direct(
        self,
        x: FloatArray,
        ref: FloatArray,
        time: float,
        reference_time: float,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
    ) -> None:
        """Run all solvers on the local arrays in place; restore them and raise if one fails."""
        plan = self.plan
        targets = self._local.target(time) if self._local.moving else None
        # One solver alone restores what it changed; several need a copy to go back to.
        several = len(plan.solvers) > 1 or len(plan.pinned) > 0
        saved = (x.copy(), None if velocities is None else velocities.copy()) if several else None
        if len(plan.pinned):
            x[plan.pinned] = plan.pinned_targets(targets, self._local)
        for solver in plan.solvers:
            lam = None if multipliers is None else np.empty(len(solver.rows))
            outcome = solver.positions(
                x, ref, targets, self._local.lattice, velocities, inv_dt, lam, time, reference_time
            )
            if not outcome.converged:
                if saved is None:
                    saved = (x.copy(), None if velocities is None else velocities.copy())
                error = diagnosis.unusable(self._local, self._numbers, {"x_new": x, "x_ref": ref}, outcome, solver)
                if error is None:
                    outcome = self._rescue(
                        solver, outcome, x, ref, targets, velocities, inv_dt, lam, time, reference_time
                    )
                if not outcome.converged:
                    np.copyto(x, saved[0])
                    if velocities is not None and saved[1] is not None:
                        np.copyto(velocities, saved[1])
                    raise error or diagnosis.positions_failed(self._local, self._numbers, outcome, solver, plan)
            if outcome.iterations > MANY_ITERATIONS:
                # A far start leaves the rounding of its size; once more from the near end removes it.
                self._polish(solver, x, ref, targets, velocities, inv_dt, lam, time, reference_time)
            if multipliers is not None and lam is not None:
                multipliers[solver.rows] = lam

    def _polish(
        self,
        solver: ClusterSolver,
        x: FloatArray,
        ref: FloatArray,
        targets: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        lam: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> None:
        more = None if lam is None else np.empty(len(lam))
        again = solver.positions(x, ref, targets, self._local.lattice, velocities, inv_dt, more, time, reference_time)
        if again.converged and lam is not None and more is not None:
            lam += more

    def _rescue(
        self,
        solver: ClusterSolver,
        outcome: Outcome,
        x: FloatArray,
        ref: FloatArray,
        targets: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        lam: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome:
        """Solve the failing cluster by damped Newton, then let the fast solver go on from there."""
        extra = np.zeros(self._local.n_rows)
        for _ in range(MAX_RESCUES):
            if outcome.worst_row < 0:
                return outcome
            row = int(solver.rows[outcome.worst_row])
            general = self._rescuer(row)
            if general is None:
                return outcome
            piece = np.zeros(len(general.rows))
            rescued = general.positions(
                x, ref, targets, self._local.lattice, velocities, inv_dt, piece, time, reference_time
            )
            if not rescued.converged:
                where = int(general.rows[rescued.worst_row]) if rescued.worst_row >= 0 else row
                index = np.flatnonzero(solver.rows == where)
                return rescued._replace(worst_row=int(index[0]) if len(index) else outcome.worst_row)
            extra[general.rows] += piece
            outcome = solver.positions(
                x, ref, targets, self._local.lattice, velocities, inv_dt, lam, time, reference_time
            )
            if outcome.converged:
                if lam is not None:
                    lam += extra[solver.rows]
                return outcome
        return outcome

    def _rescuer(self, row: int) -> ClusterSolver | None:
        """A solver with step control for the cluster of `row`; None if its own solver has that already."""
        label = int(self.plan.labels[row])
        if label not in self._rescuers:
            rows = np.flatnonzero(self.plan.labels == label)
            if len(rows) <= RESCUE_ROWS:
                labels = np.zeros(len(rows), dtype=np.int64)
                self._rescuers[label] = GeneralClusters(self._local, rows, labels, self.plan.inverse_masses)
            elif any(isinstance(solver, LongChains) and row in solver.rows for solver in self.plan.solvers):
                self._rescuers[label] = sparse_distances(self._local, rows, self.plan.inverse_masses)
            else:
                return None
        return self._rescuers[label]

    def restore_positions(self, x: ArrayLike, *, time: float = 0.0, out: FloatArray | None = None) -> FloatArray:
        """Bring positions that are far off onto the constraints: the nearest point in the mass metric.

        For initial positions, not for time steps. Damped Newton where the start is far off; where the search
        for the nearest point does not settle, a point on the constraints along the gradients at the start.

        Raises
        ------
        InfeasibleError
            The residual cannot be made smaller; nothing was changed.
        """
        result = _positions(x, self.n_atoms, "positions").copy()
        local = result if self._atoms is None else result[self._atoms]
        targets = self._local.target(time) if self._local.moving else None
        if len(self.plan.pinned):
            local[self.plan.pinned] = self.plan.pinned_targets(targets, self._local)
        start = FarStart(self._local, self.plan, self._numbers, self._positions_direct, self._tangents)
        start.restore(local, time)
        if self._atoms is not None:
            result[self._atoms] = local
        if out is None:
            return result
        _check_out(out, self.n_atoms)
        np.copyto(out, result)
        return out

    # -- velocities, accelerations, forces ------------------------------------------------------

    def project_velocities(
        self,
        x: ArrayLike,
        v: ArrayLike,
        *,
        time: float = 0.0,
        out: FloatArray | None = None,
        multipliers: FloatArray | None = None,
    ) -> FloatArray:
        """Nearest admissible velocities in the mass metric: A v = c (RATTLE's second stage).

        v - M^-1 A^T mu with (A M^-1 A^T) mu = A v - c; kinetic energy can only decrease where c = 0.

        Parameters
        ----------
        x, v : array_like, shape (n_atoms, 3)
        time : float
        out : ndarray, optional
            ``out=v`` works in place.
        multipliers : ndarray, shape (n_rows,), optional
            Receives mu, in natural units.

        Raises
        ------
        ConvergenceError, InputError
            As `project_positions`; nothing was changed.
        """
        y = _positions(v, self.n_atoms, "velocities")
        here = _positions(x, self.n_atoms, "positions")
        if out is None:
            out = y.copy()
        elif out is not v:
            _check_out(out, self.n_atoms)
            np.copyto(out, y)
        elif out is not y:
            raise InputError("in-place work needs a contiguous float64 array", item="out")
        atoms = self._atoms
        local_x = here if atoms is None else here[atoms]
        local_v = out if atoms is None else out[atoms]
        rates = None
        if self.plan.driven:
            rates = self._local.velocity_target(local_x, time)
        self._tangents(local_x, local_v, rates, time, multipliers, "velocity")
        if atoms is not None:
            out[atoms] = local_v
        return out

    def _tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        time: float,
        multipliers: FloatArray | None,
        what: str,
    ) -> None:
        plan = self.plan
        several = len(plan.solvers) > 1 or len(plan.pinned) > 0
        saved = y.copy() if several else None
        if len(plan.pinned):
            y[plan.pinned] = 0.0 if rates is None else rates[plan.pinned_rows].reshape(-1, 3)
        for solver in plan.solvers:
            lam = None if multipliers is None else np.empty(len(solver.rows))
            outcome = solver.tangents(x, y, rates, self._local.lattice, lam, time)
            if not outcome.converged:
                if saved is not None:
                    np.copyto(y, saved)
                raise diagnosis.tangents_failed(self._local, self._numbers, x, y, outcome, solver, what, plan)
            if multipliers is not None and lam is not None:
                multipliers[solver.rows] = lam

    def acceleration(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^+ b, shape (n_atoms, 3) (notes eq. 105, corrected)."""
        return self._accelerate(x, v, f, time)[0]

    def multipliers(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """lambda of z = A^T lambda, shape (n_rows,) (notes eqs. 103-104).

        Where rows depend on each other, the solution of least norm; rows of fixed atoms come after the
        others and supply what is left.
        """
        return self._accelerate(x, v, f, time)[1]

    def constraint_force(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """z = M a - f, the constraint force, shape (n_atoms, 3) (notes eq. 101)."""
        lam = self._accelerate(x, v, f, time)[1]
        here = _positions(x, self.n_atoms, "positions")
        z = self.constraint_set.jacobian(here, time).T @ lam
        return np.asarray(z).reshape(-1, 3)

    def _accelerate(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float) -> tuple[FloatArray, FloatArray]:
        here = _positions(x, self.n_atoms, "positions")
        speed = _positions(v, self.n_atoms, "velocities")
        force = _positions(f, self.n_atoms, "forces")
        with np.errstate(divide="ignore", invalid="ignore"):
            a = force / self.masses[:, None]
        local_x, local_v = (here, speed) if self._atoms is None else (here[self._atoms], speed[self._atoms])
        local_a = a if self._atoms is None else a[self._atoms]
        with np.errstate(all="ignore"):
            b = self._local.acceleration_target(local_x, local_v, time)
        if not np.all(np.isfinite(b)):
            arrays = {"velocity": local_v, "position": local_x}
            raise diagnosis.undefined_row(self._local, self._numbers, arrays, int(np.argmin(np.isfinite(b))))
        mu = np.zeros(self._local.n_rows)
        self._tangents(local_x, local_a, b, time, mu, "force")
        if self._atoms is not None:
            a[self._atoms] = local_a
        lam = self._least_norm(local_x, -mu, time)
        if len(self.plan.pinned):
            # What the fixed atoms' rows supply: M a - f less the other rows' forces.
            lam[self.plan.pinned_rows] = 0.0
            others = np.asarray(self._local.jacobian(local_x, time).T @ lam).reshape(-1, 3)
            pinned = self.plan.pinned
            numbers = pinned if self._atoms is None else self._atoms[pinned]
            reaction = self.masses[numbers, None] * local_a[pinned] - force[numbers] - others[pinned]
            lam[self.plan.pinned_rows] = reaction.ravel()
        return a, lam

    def _least_norm(self, x: FloatArray, lam: FloatArray, time: float) -> FloatArray:
        """Multipliers of least norm with the same constraint force, where rows depend on each other."""
        if not self.plan.dependent:
            return lam
        jacobian = self._local.jacobian(x, time)
        for rows in self.plan.dependent:
            part = jacobian[rows]
            transposed = part.T.tocsr()
            used = np.flatnonzero(np.diff(transposed.indptr))
            transposed = transposed[used]
            force = transposed @ lam[rows]
            if len(rows) <= DENSE_ROWS:
                lam[rows] = np.linalg.lstsq(transposed.toarray(), force, rcond=1e-10)[0]
            else:
                from scipy.sparse.linalg import lsqr  # slow to import, rarely needed

                lam[rows] = lsqr(transposed, force, atol=1e-15, btol=1e-15, iter_lim=20 * len(rows))[0]
        return lam

    def project_forces(self, x: ArrayLike, f: ArrayLike, *, out: FloatArray | None = None) -> FloatArray:
        """f + z with b = 0: what is left of the force on the surface, for optimisers, shape (n_atoms, 3)."""
        force = _positions(f, self.n_atoms, "forces")
        here = _positions(x, self.n_atoms, "positions")
        result = force.copy() if out is None else out
        if result is not force:
            np.copyto(result, force)
        if len(self._touched) == 0:
            return result
        atoms = self._atoms
        masses = self._local.masses[:, None]
        local_f = force if atoms is None else force[atoms]
        y = local_f * self.plan.inverse_masses[:, None]
        self._tangents(here if atoms is None else here[atoms], y, None, 0.0, None, "force")
        y *= masses
        if atoms is None:
            # Atoms that no row touches keep their force to the last bit.
            if len(self._touched) == self.n_atoms:
                np.copyto(result, y)
            else:
                result[self._touched] = y[self._touched]
        else:
            result[atoms] = y
        return result

    # -- report ---------------------------------------------------------------------------------

    def report(self, x: ArrayLike, v: ArrayLike | None = None, time: float = 0.0) -> diagnosis.Report:
        """Rows, rank, condition, residuals and the solver of each kind of cluster, at `x` (and `v`)."""
        here = _positions(x, self.n_atoms, "positions")
        speed = None if v is None else _positions(v, self.n_atoms, "velocities")
        return diagnosis.make_report(self.constraint_set, self.plan, here, speed, time)

    @property
    def _numbers(self) -> IntArray | None:
        """Global numbers of the local atoms, None if they are the same."""
        return self._atoms

    def __repr__(self) -> str:
        return f"<Motion: {self.constraint_set.n_rows} rows of rank {self.rank} on {self.n_atoms} atoms>"


def _positions(values: ArrayLike, n_atoms: int, item: str) -> FloatArray:
    if (
        type(values) is np.ndarray
        and values.dtype == np.float64
        and values.shape == (n_atoms, 3)
        and values.flags.c_contiguous
    ):
        return values
    array = np.ascontiguousarray(np.asarray(values, dtype=np.float64))
    if array.shape != (n_atoms, 3):
        raise InputError(f"{item} must have shape ({n_atoms}, 3), not {array.shape}", item=item)
    return array


def _check_out(out: FloatArray, n_atoms: int, item: str = "out") -> None:
    if (
        not isinstance(out, np.ndarray)
        or out.dtype != np.float64
        or out.shape != (n_atoms, 3)
        or not out.flags.c_contiguous
        or not out.flags.writeable
    ):
        raise InputError(f"{item} must be a writeable, contiguous float64 array of shape ({n_atoms}, 3)", item=item)
