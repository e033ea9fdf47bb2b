"""The engine: what constraints do to positions, velocities, accelerations and forces.

One `Motion` serves one `ConstraintSet`. It splits the rows into clusters, gives each the cheapest exact
solver for its shape (see `kcons.plan`), checks every solve by its residual, and raises a typed error
that names the row, with nothing changed, where there is no solution.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_array, check_out, check_pairs, finite_number, numbers
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.motion import failures
from kcons.motion.certificate import certify
from kcons.motion.projector import Projector
from kcons.motion.report import Report, make_report
from kcons.motion.restoring.kept_geometry import Bonds
from kcons.motion.restoring.moved_groups import restored
from kcons.motion.restoring.nearest_point import LEFT_OVER, Work
from kcons.plan.second_order.flat_bodies import MISFIT


class Motion(Projector):
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
    conversions : tuple of FlatBody
        What was converted, by atoms and rows of the set that was given; printed, a sentence each.

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

    def restore_positions(
        self,
        x: ArrayLike,
        *,
        time: float = 0.0,
        out: FloatArray | None = None,
        bonds: ArrayLike | Callable[[], IntArray] | None = None,
    ) -> FloatArray:
        """Bring positions that are off onto the constraints, with other bond lengths and angles as they were.

        For initial positions, not for time steps. Near starts go to the nearest point in the mass metric, where
        x - x_0 = M^-1 A(x)^T Lambda. Where that would change other bonds or angles, and for far starts, groups move
        as rigid pieces first: see `kcons.motion.restoring.moved_groups`.

        Parameters
        ----------
        x : array_like, shape (n_atoms, 3)
        time : float
        out : ndarray, optional
            Where to put the result.
        bonds : array_like of int, shape (n, 2), or callable that gives them, optional
            The bonds of the molecules; a callable is asked only where they are needed. Without them, distances that
            rows hold count, and atoms that these do not join are bonded where their distances suggest it; where most
            held distances are off by more than a quarter the start is no structure to be kept. An empty list: the
            nearest point, whatever becomes of what no row holds.

        Raises
        ------
        InfeasibleError
            There is no way from here, or other bonds change by more than 1.25 % of their length (0.02 angstrom) or
            other angles by more than 2 degrees; nothing was changed.
        InputError
            Bonds of unknown atoms.

        Warns
        -----
        UserWarning
            ``bonds=[]``, and the search has ended on the rows before it came to the nearest point.
        """
        time = finite_number(time, "time")
        if out is not None:
            check_out(out, self._shape)
        self.cell()
        start = as_array(x, self._shape, "positions")
        pairs: Bonds | None = None
        nearest_only = False
        if callable(bonds):
            pairs = bonds
        elif bonds is not None:
            table = check_pairs(bonds, self.n_atoms)
            nearest_only = not len(table)

            def pairs() -> IntArray:
                return table

        work = Work(self.plan)
        left = 0.0

        def nearest(y: FloatArray) -> FloatArray:
            nonlocal left
            result = y.copy()
            local = result if self._atoms is None else result[self._atoms]
            left = self._solve.nearest(local, time, work)
            if self._atoms is not None:
                result[self._atoms] = local
            return result

        result = restored(self.constraint_set, self.plan, start, time, pairs, nearest)
        if left > LEFT_OVER and nearest_only:
            warnings.warn(
                f"these positions fulfil all rows, but are not the nearest that do: {left:.1g} of the way from the "
                "start leads along the rows, and the search has done what it may. Start nearer to the rows, or bring "
                "targets there in several parts",
                stacklevel=2,
            )
        if out is None:
            return result
        np.copyto(out, result)
        return out

    # -- accelerations, forces ------------------------------------------------------------------

    def acceleration(
        self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0, *, feedback: FloatArray | None = None
    ) -> FloatArray:
        """a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^+ b, shape (n_atoms, 3) (notes eq. 105, corrected).

        `feedback`, shape (n_rows,), is added to b (Baumgarte's stabilisation).
        """
        return self._accelerated(x, v, f, time, feedback)[0]

    def multipliers(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """lambda of z = A^T lambda, shape (n_rows,) (notes eqs. 103-104).

        Where rows depend on each other, the solution of least norm; rows of fixed atoms come after the
        others and supply what is left.
        """
        return self.respond(x, v, f, time)[1]

    def constraint_force(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """z = M a - f, the constraint force, shape (n_atoms, 3) (notes eq. 101)."""
        lam = self.respond(x, v, f, time)[1]
        here = as_array(x, self._shape, "positions")
        z = self.constraint_set.jacobian(here, time).T @ lam
        return np.asarray(z).reshape(-1, 3)

    def respond(
        self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0, *, feedback: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """`acceleration` and `multipliers` of one solve."""
        time = finite_number(time, "time")
        mu = np.zeros(self._local.n_rows)
        a, local_a, local_x, force = self._accelerated(x, v, f, time, feedback, mu)
        lam = self.plan.least_norm(local_x, -mu, time)
        if len(self.plan.pinned):
            # What the fixed atoms' rows supply: M a - f less the other rows' forces.
            lam[self.plan.pinned_rows] = 0.0
            others = np.asarray(self._local.jacobian(local_x, time).T @ lam).reshape(-1, 3)
            pinned = self.plan.pinned
            atoms = pinned if self._atoms is None else self._atoms[pinned]
            reaction = self.masses[atoms, None] * local_a[pinned] - force[atoms] - others[pinned]
            lam[self.plan.pinned_rows] = reaction.ravel()
        return a, lam

    def _accelerated(
        self,
        x: ArrayLike,
        v: ArrayLike,
        f: ArrayLike,
        time: float,
        feedback: FloatArray | None,
        mu: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Accelerations, those of local atoms, local positions, forces; `mu` receives the solvers' multipliers."""
        time = finite_number(time, "time")
        here = as_array(x, self._shape, "positions")
        speed = as_array(v, self._shape, "velocities")
        force = as_array(f, self._shape, "forces")
        self.cell()
        with np.errstate(divide="ignore", invalid="ignore"):
            a = force / self.masses[:, None]
        local_x, local_v = (here, speed) if self._atoms is None else (here[self._atoms], speed[self._atoms])
        local_a = a if self._atoms is None else a[self._atoms]
        with np.errstate(all="ignore"):
            b = self._local.acceleration_target(local_x, local_v, time)
            if feedback is not None:
                b = b + numbers(feedback, "feedback")
        if not np.all(np.isfinite(b)):
            arrays = {"velocity": local_v, "position": local_x}
            raise failures.undefined_row(self._local, self._atoms, arrays, int(np.argmin(np.isfinite(b))))
        self._solve.tangents(local_x, local_a, b, time, mu, "force")
        if self._atoms is not None:
            a[self._atoms] = local_a
        return a, local_a, local_x, force

    def project_forces(
        self, x: ArrayLike, f: ArrayLike, *, time: float = 0.0, out: FloatArray | None = None
    ) -> FloatArray:
        """f + z with b = 0: what is left of the force on the surface, for optimisers, shape (n_atoms, 3)."""
        time = finite_number(time, "time")
        force = as_array(f, self._shape, "forces")
        here = as_array(x, self._shape, "positions")
        if out is not None:
            check_out(out, self._shape)
        self.cell()
        touched, masses = self._touched, self._local.masses[:, None]
        local = force if self._atoms is None else force.take(touched, 0)
        y = local * self.plan.inverse_masses[:, None]
        self._solve.tangents(here if self._atoms is None else here.take(touched, 0), y, None, time, None, "force")
        if self._atoms is None:
            y, masses = y.take(touched, 0), masses[touched]
        result = force.copy() if out is None else out
        if result is not f:
            np.copyto(result, force)
        # Atoms that no row touches keep their force to the last bit.
        result[touched] = y * masses
        return result

    # -- certificate and report ---------------------------------------------------------------------------------

    def certify(
        self,
        x: ArrayLike,
        v: ArrayLike | None = None,
        time: float = 0.0,
        *,
        still: float = 0.0,
        moved: bool = True,
    ) -> None:
        """Raise unless positions (and velocities) are on the constraints as the set, and not a solver, defines them.

        Where rows were converted, the rows that were given are looked at too. Speeds of `still` count as rest.
        Positions that no solver has `moved` are not looked at.

        Raises
        ------
        CertificateError
        """
        time = finite_number(time, "time")
        here = as_array(x, self._shape, "positions")
        speed = None if v is None else as_array(v, self._shape, "velocities")
        self.cell()
        certify(self.constraint_set, here, speed, time, still=still, moved=moved)
        if self.conversions:
            certify(self._given, here, speed, time, slack=10 * MISFIT, still=still, moved=moved)

    def report(self, x: ArrayLike, v: ArrayLike | None = None, time: float = 0.0, *, condition: bool = True) -> Report:
        """Rows, rank, condition, residuals, iterations and the solver of each kind of cluster, at `x` (and `v`).

        ``condition=False`` leaves out the condition numbers, which take longer than all else in the report.
        """
        time = finite_number(time, "time")
        here = as_array(x, self._shape, "positions")
        speed = None if v is None else as_array(v, self._shape, "velocities")
        self.cell()
        return make_report(
            self.constraint_set, self.plan, here, speed, time, self._solve.iterations, condition=condition
        )

    def __repr__(self) -> str:
        return f"<Motion: {self.constraint_set.n_rows} rows of rank {self.rank} on {self.n_atoms} atoms>"
