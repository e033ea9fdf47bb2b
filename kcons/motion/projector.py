"""Positions and velocities of a whole system projected onto its constraints: what a time step needs."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_array, check_out, finite_number, refuse_other
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError
from kcons.motion.local_projections import LocalProjections
from kcons.plan.plan import Plan, make_plan
from kcons.plan.second_order.conversion import without_second_order_rows
from kcons.plan.second_order.flat_bodies import FlatBody


class Projector:
    """The part of `kcons.motion.motion.Motion` that projects, with the parameters and attributes said there."""

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
        refuse_other(constraint_set, ConstraintSet, "constraint_set", "a kcons.ConstraintSet")
        time = finite_number(time, "time")
        self._shape = (constraint_set.n_atoms, 3)
        x = as_array(positions, self._shape, "positions")
        self._given = constraint_set
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
        here = x if self._atoms is None else x[self._atoms]
        self.plan: Plan = make_plan(self._local, here, time, self.constraint_set)
        self._touched = touched
        self._flat: IntArray = (3 * touched[:, None] + np.arange(3)).ravel() if self._atoms is not None else touched
        self._lattice = self._local.lattice
        self._solve = LocalProjections(self._local, self.plan, self._atoms)

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
        held = [c.atoms.ravel() for c in self.constraint_set.constraints if c.fixes_atoms]
        return np.unique(np.concatenate(held)) if held else np.zeros(0, dtype=np.int64)

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
        held = self.constraint_set
        before = held.lattice
        try:
            held.with_cell(cell, pbc)
            held.check_half_box(None if positions is None else as_array(positions, self._shape, "positions"), before)
            self._share(held.lattice)
        except KconsError:
            held.lattice = before
            raise
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
        if out is not None:
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
            ref = ref.copy() if np.may_share_memory(work, ref) else ref
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
        if out is not None:
            check_out(out, self._shape)
        if multipliers is not None:
            check_out(multipliers, (self.constraint_set.n_rows,), "multipliers")
        self.cell()
        atoms = self._atoms
        if atoms is None:
            work = y if out is v else y.copy()
            here = here.copy() if np.may_share_memory(work, here) else here
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


def _in(out: FloatArray | None, work: FloatArray) -> FloatArray:
    """`work` in `out`, which may be `work` itself, if there is any."""
    if out is None or out is work:
        return work
    np.copyto(out, work)
    return out
