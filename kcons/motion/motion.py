"""The engine: what constraints do to positions, velocities, accelerations and forces.

One `Motion` serves one `ConstraintSet`. It splits the rows into clusters, gives each the cheapest exact
solver for its shape (see `kcons.plan`), checks every solve by its residual, and raises a typed error
that names the row, with nothing changed, where there is no solution.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from math import isfinite

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Finite, as_array, check_out, check_pairs, checked, finite_number, refuse_other
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError
from kcons.motion.certificate import certify
from kcons.motion.report import Report, make_report
from kcons.motion.restoring.kept_geometry import Bonds
from kcons.motion.restoring.moved_groups import restored
from kcons.motion.restoring.nearest_point import LEFT_OVER, FarStart
from kcons.motion.solver_sequence import SolverSequence
from kcons.plan.clusters import fixed_atoms
from kcons.plan.plan import Plan, make_plan
from kcons.plan.second_order import MISFIT, FlatBody, without_second_order_rows
from kcons.solvers.tolerances import UNEVEN


class Motion:
    """Constrained motion of one system.

    Parameters
    ----------
    constraint_set : ConstraintSet
        What is held.
    positions : array_like, shape (n_atoms, 3)
        Positions on (or near) the surface; rank and shapes of clusters are found there. Rows that are singular only at
        second order there (a collinear or planar group held by all its distances) are replaced by linear rows that
        hold the same.
    time : float
        Time of `positions`, for targets that move.

    Attributes
    ----------
    constraint_set : ConstraintSet
        The rows really held: differs from what was given where rows were converted.
    plan : Plan
        Clusters and the solver picked for each.
    rank, degrees_of_freedom : int
        Independent rows, and 3 n - rank for the n atoms that are no virtual sites.
    conversions : tuple of FlatBody
        What was converted, by atoms and rows of the set that was given; printed, a sentence each.

    Raises
    ------
    SingularGeometryError
        Second-order-singular rows that cannot be converted.
    ContradictionError
        Rows among fixed atoms only that are not fulfilled.

    References
    ----------
    Notes, section 4.1; eqs. 94-107.
    """

    @checked
    def __init__(
        self,
        constraint_set: ConstraintSet,
        positions: ArrayLike,
        *,
        time: Finite = 0.0,
    ) -> None:
        refuse_other(constraint_set, ConstraintSet, "constraint_set", "a kcons.ConstraintSet")
        self._shape = (constraint_set.n_atoms, 3)
        x = as_array(positions, self._shape, "positions")
        self._given = constraint_set
        self.constraint_set = without_second_order_rows(constraint_set, x, time)
        self.n_atoms = constraint_set.n_atoms
        self.masses = constraint_set.masses
        touched = self.constraint_set.touched
        # Few constrained atoms among many: work on a compact copy of them, and on nothing else.
        self._atoms: IntArray | None = None if 2 * len(touched) >= self.n_atoms else touched
        if self._atoms is None:
            self._local = self.constraint_set
        else:
            self._local, _ = self.constraint_set.subset(np.arange(self.constraint_set.n_rows))
        here = x if self._atoms is None else x[self._atoms]
        self.plan: Plan = make_plan(self._local, here, time, self.constraint_set)
        self._touched = touched
        self._flat: IntArray = (3 * touched[:, None] + np.arange(3)).ravel() if self._atoms is not None else touched
        self._lattice = self._local.lattice
        self._solve = SolverSequence(self._local, self.plan, self._atoms)
        #: 1/m and m, 0 for fixed atoms, of each component; None where rows touch some atoms only.
        self._weights: tuple[FloatArray, FloatArray] | None = None
        if len(touched) == self.n_atoms:
            inverse = self.plan.inverse_masses
            both = np.repeat([inverse, np.where(inverse > 0, self.masses, 0.0)], 3).reshape(2, -1, 3)
            self._weights = both[0], both[1]
        free = self.plan.inverse_masses[self.plan.inverse_masses > 0]
        self._uneven = bool(free.max(initial=0.0) > UNEVEN * free.min(initial=np.inf))

    @property
    def rank(self) -> int:
        return self.plan.rank

    @property
    def conversions(self) -> tuple[FlatBody, ...]:
        """Straight and flat groups whose rows were singular at second order, and what holds them instead."""
        return self.constraint_set.conversions

    @property
    def degrees_of_freedom(self) -> int:
        return 3 * self.constraint_set.n_moving - self.plan.rank

    @property
    def fixed_atoms(self) -> IntArray:
        """Those that `FixedAtoms` hold."""
        return fixed_atoms(self.constraint_set)

    def took(self, iterations: int) -> None:
        """Remember, for reports, the iterations of a kernel that ran all solvers in one call."""
        self._solve.iterations[:] = [iterations] * len(self.plan.solvers)

    # -- cell -----------------------------------------------------------------------------------

    @property
    def lattice(self) -> FloatArray | None:
        """The cell and its inverse as they are now, shape (2, 3, 3); None without periodicity."""
        return self.cell()

    def set_cell(
        self, cell: ArrayLike | None, pbc: bool | Sequence[bool] = True, positions: ArrayLike | None = None
    ) -> None:
        """Change the periodic cell in place; rows, targets, rank and solvers stay as they are.

        For barostats and cell relaxation: costs microseconds where a new engine costs milliseconds.

        Parameters
        ----------
        cell, pbc
            As for `ConstraintSet`.
        positions : array_like, shape (n_atoms, 3), optional
            Positions in the new cell; where given, rows other than distances are checked against half the box at
            once, and not when they are first projected.

        Raises
        ------
        InputError
            A degenerate cell, a row that is not shorter than half the box, or a first cell for rows whose images
            have to be found anew; nothing was changed.
        ImageError
            Atoms of a row that nothing ties together are half the box apart at `positions`.
        ContradictionError
            A row between fixed atoms is off in this cell: it lies across a face that moves, and the atoms stay.
        """
        before = self.constraint_set.lattice
        x = None if positions is None else as_array(positions, self._shape, "positions")
        self.constraint_set.with_cell(cell, pbc, x)
        self._share(self.constraint_set.lattice)
        self._solve.unchecked = before if positions is None else None

    def _share(self, lattice: FloatArray | None) -> None:
        """Let all sets have this lattice, which the solvers take at each call."""
        before, self._lattice, self._local.lattice = self._lattice, lattice, lattice
        try:
            self.plan.check_cell()
        except KconsError:
            self._lattice = before
            raise
        finally:
            self._given.lattice = self.constraint_set.lattice = self._local.lattice = self._lattice

    @property
    def sources(self) -> tuple[ConstraintSet, ConstraintSet]:
        """The set that was given and `constraint_set`: a barostat may change the cell in either."""
        return self._given, self.constraint_set

    def cell(self) -> FloatArray | None:
        """`lattice`, which a barostat may have changed in the set that was given."""
        if self._given.lattice is self._lattice and self.constraint_set.lattice is self._lattice:
            return self._lattice
        for source in (self._given, self.constraint_set):
            if source.lattice is not self._lattice:
                before = self._lattice
                self._share(source.lattice)
                self._solve.unchecked = before
        return self._lattice

    # -- positions and velocities ---------------------------------------------------------------

    def project_positions(
        self,
        x_new: ArrayLike,
        x_ref: ArrayLike,
        *,
        time: float = 0.0,
        reference_time: float | None = None,
        velocities: FloatArray | None = None,
        dt: float | None = None,
        flight: float = 0.0,
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
        flight : float
            Where `x_new` is the end of a flight of this length from `x_ref`, rows of velocities hold at its middle:
            a((x_ref + x)/2) . (x - x_ref) = flight c((reference_time + time)/2). They do not count if it is 0.
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
            No solution near enough, or one where a row's gradient has turned by a right angle; nothing was changed.
        InputError
            Wrong shapes, or a NaN or infinity in the positions of a constrained atom.
        """
        x = as_array(x_new, self._shape, "x_new")
        ref = as_array(x_ref, self._shape, "x_ref")
        if out is not None and out is not x:
            check_out(out, self._shape)
        inv_dt = 0.0
        if velocities is not None:
            check_out(velocities, self._shape, "velocities")
            if not finite_number(dt, "dt"):
                raise InputError(f"velocities are corrected by 1/dt; dt is {dt}", item="dt")
            inv_dt = 1.0 / float(dt)  # type: ignore[arg-type]
        if multipliers is not None:
            check_out(multipliers, (self.constraint_set.n_rows,), "multipliers")
        if type(time) is not float or not isfinite(time):
            time = finite_number(time, "time")
        reference_time = time if reference_time is None else finite_number(reference_time, "reference_time")
        self.cell()
        atoms = self._atoms
        if atoms is None:
            work = x if out is x_new else x.copy()
            ref = _apart(ref, work)
            self._solve.positions(work, ref, time, reference_time, velocities, inv_dt, multipliers, flight)
            return _in(out, work)
        part = x.take(atoms, 0)
        speeds = None if velocities is None else velocities.take(atoms, 0)
        self._solve.positions(part, ref.take(atoms, 0), time, reference_time, speeds, inv_dt, multipliers, flight)
        if velocities is not None and speeds is not None:
            velocities.put(self._flat, speeds)
        return self._put_back(part, x, x_new, out)

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
        if type(time) is not float or not isfinite(time):
            time = finite_number(time, "time")
        y = as_array(v, self._shape, "velocities")
        here = as_array(x, self._shape, "positions")
        if out is not None and out is not y:
            check_out(out, self._shape)
        if multipliers is not None:
            check_out(multipliers, (self.constraint_set.n_rows,), "multipliers")
        self.cell()
        atoms = self._atoms
        if atoms is None:
            work = y if out is v else y.copy()
            here = _apart(here, work)
            self._solve.tangents(here, work, self._solve.rates(here, time), time, multipliers, "velocity")
            return _in(out, work)
        here, part = here.take(atoms, 0), y.take(atoms, 0)
        self._solve.tangents(here, part, self._solve.rates(here, time), time, multipliers, "velocity")
        return self._put_back(part, y, v, out)

    def _put_back(self, part: FloatArray, x: FloatArray, given: ArrayLike, out: FloatArray | None) -> FloatArray:
        """`x`, which was `given`, with what became of its local atoms, in `out` or in a new array."""
        if out is None:
            out = x.copy()
        elif out is not given:
            np.copyto(out, x)
        out.put(self._flat, part)
        return out

    # -- starts -----------------------------------------------------------------------------------------------

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
        table = None if bonds is None or callable(bonds) else check_pairs(bonds, self.n_atoms)
        pairs: Bonds | None = bonds if callable(bonds) else None if table is None else lambda: table
        search = FarStart(self._solve, time)

        def nearest(y: FloatArray) -> FloatArray:
            result = y.copy()
            local = result if self._atoms is None else result[self._atoms]
            search.restore(local)
            if self._atoms is not None:
                result[self._atoms] = local
            return result

        result = restored(self.constraint_set, self.plan, start, time, pairs, nearest)
        if search.left > LEFT_OVER and table is not None and not len(table):
            warnings.warn(
                f"these positions fulfil all rows, but are not the nearest that do: {search.left:.1g} of the way from "
                "the start leads along the rows, and the search has done what it may. Start nearer to the rows, or "
                "bring targets there in several parts",
                stacklevel=2,
            )
        return _in(out, result)

    # -- accelerations, forces ------------------------------------------------------------------

    def acceleration(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^+ b, shape (n_atoms, 3) (notes eq. 105, corrected)."""
        return self._accelerated(x, v, f, time, None)

    def multipliers(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """lambda of z = A^T lambda, shape (n_rows,) (notes eqs. 103-104).

        Where rows depend on each other, the solution of least norm; rows of fixed atoms come after the
        others and supply what is left.
        """
        return self.respond(x, v, f, time)[1]

    def constraint_force(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> FloatArray:
        """z = M a - f, the constraint force, shape (n_atoms, 3) (notes eq. 101)."""
        slopes = self.constraint_set.jacobian(as_array(x, self._shape, "positions"), time)
        return np.asarray(slopes.T @ self.respond(x, v, f, time)[1]).reshape(-1, 3)

    def respond(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """`acceleration` and `multipliers` of one solve."""
        time = finite_number(time, "time")
        mu = np.zeros(self._local.n_rows)
        a = self._accelerated(x, v, f, time, mu)
        here, force = as_array(x, self._shape, "positions"), as_array(f, self._shape, "forces")
        local_x, local_a = (here, a) if self._atoms is None else (here[self._atoms], a[self._atoms])
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

    def _accelerated(self, x: ArrayLike, v: ArrayLike, f: ArrayLike, time: float, mu: FloatArray | None) -> FloatArray:
        """Accelerations; `mu` receives the solvers' multipliers."""
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
        if not np.all(np.isfinite(b)):
            raise self._solve.failures.undefined(int(np.argmin(np.isfinite(b))), velocity=local_v, position=local_x)
        self._solve.tangents(local_x, local_a, b, time, mu, "force")
        if self._uneven:  # again, for what rounding leaves
            more = None if mu is None else np.empty_like(mu)
            self._solve.tangents(local_x, local_a, b, time, more, "force")
            if mu is not None and more is not None:
                mu += more
        if self._atoms is not None:
            a[self._atoms] = local_a
        return a

    def project_forces(
        self, x: ArrayLike, f: ArrayLike, *, time: float = 0.0, out: FloatArray | None = None
    ) -> FloatArray:
        """f + z with b = 0: what is left of the force on the surface, for optimizers, shape (n_atoms, 3)."""
        if type(time) is not float or not isfinite(time):
            time = finite_number(time, "time")
        force = as_array(f, self._shape, "forces")
        here = as_array(x, self._shape, "positions")
        if out is not None and out is not force:
            check_out(out, self._shape)
        self.cell()
        if self._weights is not None:
            y = force * self._weights[0]
            self._solve.tangents(here, y, None, time, None, "force")
            return np.multiply(y, self._weights[1], out)
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


def _apart(x: FloatArray, work: FloatArray) -> FloatArray:
    """`x`, or a copy where it may be in the memory of `work`, which is written to."""
    alone = x is not work and x.flags.owndata and work.flags.owndata  # as quickly as that
    return x if alone or not np.may_share_memory(work, x) else x.copy()


def _in(out: FloatArray | None, work: FloatArray) -> FloatArray:
    """`work` in `out`, which may be `work` itself, if there is any."""
    if out is None or out is work:
        return work
    np.copyto(out, work)
    return out
