"""Rows at the state of a context, seen from Python: values, gradients, their Gram matrix, projections, checks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property

import numpy as np
import openmm
from numpy.typing import ArrayLike

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConstraintError, ConvergenceError, InputError, KconsError, SingularGeometryError
from kcons.motion.motion import Motion
from kcons.openmm.collective.coordinates import as_constraint, energy, forces_in
from kcons.openmm.collective.row_program import GroupRows, owner, variables_of
from kcons.openmm.integrator.guard import positions_of, velocities_of, width
from kcons.openmm.integrator.part import BOND, NEAR, Miss
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.system_checks import (
    SystemRows,
    groups_in,
    refuse_barostat,
    refuse_motion_remover,
    require_context,
)
from kcons.openmm.quantities import masses_of
from kcons.openmm.topology import bonds_of

#: Rows whose part beside the others is smaller than this (of their own norm) are dependent.
DEPENDENT = 1e-5
#: Relative tolerance of rows, and of the System's constraints where differences are taken, in double precision.
TOLERANCE = 1e-13
#: Off the rows by more than this (relative to the scale of a row, or to its rate): not on them.
START_TOLERANCE = 1e-9
#: Two values of one coordinate, by OpenMM and by kcons, differ by less.
SAME = 1e-5
_MAX_NEWTON = 60


class RowsInContext:
    """Rows as they are at the state of a context, and what can be done to them; make a new one when that changes.

    Parameters
    ----------
    rows : GroupRows
    context : openmm.Context
        Its integrator need not be the one that holds the rows, but then targets are those the rows were made with.
    """

    def __init__(self, rows: GroupRows, context: openmm.Context) -> None:
        require_context(context)
        self.rows, self.context, self.system = rows, context, context.getSystem()
        self.precision = Precision.of(context)
        self.masses = masses_of(self.system)
        with np.errstate(divide="ignore"):
            self._inverse_masses = np.where(self.masses > 0, 1.0 / self.masses, 0.0)[:, None]

    # -- the state ------------------------------------------------------------------------------

    @cached_property
    def positions(self) -> FloatArray:
        return positions_of(self.context)

    @cached_property
    def velocities(self) -> FloatArray:
        return velocities_of(self.context)

    @cached_property
    def _owner(self) -> openmm.CustomIntegrator | None:
        return owner(self.rows, self.context)

    @cached_property
    def _settings(self) -> dict[str, float]:
        """What the integrator was made with or told; its variables are copies for the program."""
        if self._owner is None:
            return {}
        program = getattr(self._owner, "program", None)
        return variables_of(self._owner) if program is None else program.settings

    @cached_property
    def _clock(self) -> float:
        return 0.0 if self._owner is None else self.rows._clock(self._owner)

    def targets(self) -> FloatArray:
        """Where each target is now, shape (n_rows,)."""
        rows, found, rates = self.rows, [], self.target_rates()
        for k, target in enumerate(rows._targets):
            if isinstance(target, str):
                found.append(self.context.getParameter(target))
                continue
            value = self._settings.get(rows._of("target", k, self._owner), target)
            found.append(value + (rates[k] * self._clock if rows._rates[k] != 0.0 else 0.0))  # type: ignore[operator]
        return np.array(found)

    def target_rates(self) -> FloatArray:
        rows, read = self.rows, self.context.getParameter
        found = [
            read(rate) if isinstance(rate, str) else self._settings.get(rows._of("rate", k, self._owner), rate)
            for k, rate in enumerate(rows._rates)
        ]
        return np.array(found)

    # -- the rows -------------------------------------------------------------------------------

    def values(self) -> FloatArray:
        """q, shape (n_rows,)."""
        return np.array([energy(self.context, group) for group in self.rows._groups])

    def sigma(self) -> FloatArray:
        """q - target, shape (n_rows,), to the nearest image."""
        off = self.values() - self.targets()
        period = np.array(self.rows.periods)
        safe = np.where(period > 0, period, 1.0)
        return np.where(period > 0, off - safe * np.floor(off / safe + 0.5), off)

    def gradients(self) -> FloatArray:
        """grad q, shape (n_rows, n_particles, 3)."""
        return np.array([-self._force({group}) for group in self.rows._groups])

    def _force(self, groups: set[int]) -> FloatArray:
        return np.array(self.context.getState(getForces=True, groups=groups).getForces(asNumpy=True)._value)

    def slopes(self) -> FloatArray:
        """A v less the rates of the targets, shape (n_rows,)."""
        return np.einsum("kai,ai->k", self.gradients(), self.velocities) - self.target_rates()

    def _directions(self, gradients: FloatArray) -> FloatArray:
        """M_par^+ A^T, M_par^+ that of the System's constraints, shape (n_rows, n_particles, 3)."""
        pushed = gradients * self._inverse_masses
        if self.rows.meets_system:
            with self._kept(positions=False):
                return np.array([self._tangent(row) for row in pushed])
        return pushed

    def _tangent(self, v: FloatArray) -> FloatArray:
        """v along the System's constraints at the context's positions; its velocities are overwritten."""
        self.context.setVelocities(v)
        self.context.applyVelocityConstraints(self._tight)
        return velocities_of(self.context)

    @contextmanager
    def _kept(self, positions: bool = True) -> Iterator[None]:
        """Put the state of the context back afterwards."""
        state = self.context.getState(getPositions=True, getVelocities=True)
        try:
            yield
        finally:
            if positions:
                self.context.setPositions(state.getPositions())
            self.context.setVelocities(state.getVelocities())

    def _grams(self) -> tuple[FloatArray, FloatArray, FloatArray, list[int]]:
        """A, M_par^+ A^T, A M_par^+ A^T, and the rows that add something to those before them."""
        gradients = self.gradients()
        directions = self._directions(gradients)
        gram = np.einsum("jai,kai->jk", gradients, directions)
        gram = 0.5 * (gram + gram.T)
        own = np.einsum("kai,a->k", gradients**2, self._inverse_masses[:, 0])
        good = np.isfinite(own) & (own > 0)
        size = np.sqrt(np.where(good, own, 1.0))
        scaled = gram / (size[:, None] * size)
        adding: list[int] = []
        for k in np.flatnonzero(good).tolist():
            before = scaled[np.ix_(adding, adding)], scaled[adding, k]
            left = scaled[k, k] - (before[1] @ np.linalg.lstsq(*before, rcond=None)[0] if adding else 0.0)
            if left > self._small:
                adding.append(k)
        return gradients, directions, gram, adding

    def gram(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(A, M_par^+ A^T, A M_par^+ A^T).

        Raises
        ------
        SingularGeometryError
            Rows that vanish, or depend on others or on the System's constraints.
        """
        gradients, directions, gram, adding = self._grams()
        for k in range(self.rows.n_rows):
            if k not in adding:
                raise SingularGeometryError(
                    f"row {k} ({self.rows.names[k]}) vanishes, or depends on the rows before it or on the "
                    "constraints of the System. Leave out a row that others imply; a dihedral over a straight angle "
                    "or an RMSD of 0 has no direction",
                    rows=[k],
                )
        return gradients, directions, gram

    def rank(self) -> int:
        """Number of rows that are independent of one another and of the System's constraints."""
        return len(self._grams()[3])

    @property
    def finest(self) -> float:
        """The smallest relative residual that is held: what Forces tell, of coordinates as they see them.

        Where those are single numbers, a row is off by the gradient times what rounding took of them, at random: twice
        its standard deviation is met by nearly each push.
        """
        precision = self.precision
        if precision.name == "double":
            return TOLERANCE
        wide = width(self.context) if self.system.usesPeriodicBoundaryConditions() else 0.0
        moved = self.gradients() * np.maximum(np.abs(self.positions), wide)
        blur = np.linalg.norm(moved, axis=(1, 2)) / np.array(self.rows.scales)
        told = 0.8 * precision.seen * float(np.linalg.norm(blur))
        # A power of two, or it would be another number whenever x is.
        return max(precision.forces, 2.0 ** np.ceil(np.log2(told)) if 0 < told < np.inf else told)

    @property
    def _small(self) -> float:
        """Squares of parts beside other rows that are rounding."""
        return max(DEPENDENT**2, 10 * self.precision.forces)

    @property
    def _tight(self) -> float:
        """Tolerance of the System's constraints where differences are taken."""
        return max(TOLERANCE, self.precision.solvers) if self.precision.name != "double" else TOLERANCE

    # -- projections ----------------------------------------------------------------------------

    def apply_positions(self, tolerance: float | None = None, bonds: ArrayLike | None = None) -> int:
        """See `CollectiveRows.apply_positions`."""
        if tolerance is None:
            tolerance = self.finest if self.rows.asked_tolerance is None else self.rows.asked_tolerance
        scales, start, velocities = np.array(self.rows.scales), self.positions, self.velocities
        system_tolerance = self.context.getIntegrator().getConstraintTolerance()

        def size_at(x: FloatArray) -> tuple[float, FloatArray]:
            self.context.setPositions(x)
            if self.system.getNumConstraints():
                self.context.applyConstraints(system_tolerance)
            off = self.sigma()
            return float(np.linalg.norm(off / scales)), off

        done, reached = 0, False
        try:
            size, off = size_at(self._led(start, bonds))
            for done in range(_MAX_NEWTON):
                if reached := size <= tolerance:
                    return done
                here = positions_of(self.context)
                _, directions, gram = self.gram()
                push = np.einsum("k,kai->ai", np.linalg.solve(gram, -off), directions)
                share = 1.0
                while share > 1e-4:
                    new, new_off = size_at(here + share * push)
                    # Close to the solution rounding decides; a step that does not help ends the iteration.
                    if new < (1.0 - 0.1 * share) * size:
                        break
                    share *= 0.5
                else:
                    break
                size, off = new, new_off
        finally:
            if not reached:
                self.context.setPositions(start)
            self.context.setVelocities(velocities)
        row = int(np.argmax(np.abs(off / scales)))
        raise ConvergenceError(
            f"row {row} ({self.rows.names[row]}) stays off by {abs(off[row]):.3g} after {done} iterations (tolerance "
            f"{tolerance:.3g}); the positions are unchanged. Start closer to the target, or move it there over time",
            residual=size,
            tolerance=tolerance,
            iterations=done,
            row=row,
        )

    def _led(self, start: FloatArray, bonds: ArrayLike | None) -> FloatArray:
        """Where Newton's method begins: for far targets of plain rows, groups are moved whole first.

        Raises
        ------
        InfeasibleError
            There is no way, or other bonds and angles would change.
        """
        miss = self.worst_miss(velocities=False)
        pairs = bonds_of(self.system, start) if bonds is None else np.asarray(bonds)
        if miss is None or miss.near or not len(pairs):
            return start
        off, targets = self.sigma(), self.targets()
        forces = [forces_in(self.system, group) for group in self.rows._groups]
        plain = [as_constraint(f[0], t) if len(f) == 1 else None for f, t in zip(forces, targets.tolist(), strict=True)]
        rows = [row for row in plain if row is not None]
        if len(rows) < len(plain):
            return start
        held = SystemRows.of(self.system)
        if held.n_rows:
            rows.append(Distance(held.pairs, held.lengths))
        try:
            motion = Motion(ConstraintSet(rows, start, held.masses), start)
        except KconsError:
            # Rows that contradict each other or massless particles: what is wrong Newton's method is to say.
            return start
        ours = motion.sources[0].residuals(start, None, 0.0).sigma[: len(off)]
        if not np.all(np.abs(ours - off) < SAME * np.maximum(1.0, np.abs(targets))):  # other images of particles
            return start
        return motion.restore_positions(start, bonds=pairs)

    def apply_velocities(self) -> None:
        """See `CollectiveRows.apply_velocities`."""
        if self.system.getNumConstraints():
            self.context.applyVelocityConstraints(self.context.getIntegrator().getConstraintTolerance())
        velocities = velocities_of(self.context)
        gradients, directions, gram = self.gram()
        slopes = np.einsum("kai,ai->k", gradients, velocities) - self.target_rates()
        change = np.einsum("k,kai->ai", np.linalg.solve(gram, slopes), directions)
        self.context.setVelocities(velocities - change)

    def multipliers(self) -> FloatArray:
        """See `CollectiveRows.multipliers_at`."""
        _, directions, gram = self.gram()
        applied = self._force(groups_in(self.context.getIntegrator()) - self.rows.groups)
        from_forces = np.einsum("kai,ai->k", directions, applied)
        speed = float(np.linalg.norm(self.velocities, axis=1).max(initial=0.0))
        from_motion = np.zeros(self.rows.n_rows)
        if speed > 0:
            # Displacements of 1e-4 nm: the remainder of order four and rounding are both near 1e-11.
            h = 1e-4 / speed
            with self._kept():
                near, far = self._slope_change(h), self._slope_change(2 * h)
            from_motion = (4.0 * near - far) / 3.0
        return np.linalg.solve(gram, -from_motion - from_forces)

    def _slope_change(self, h: float) -> FloatArray:
        """d(A v)/dt in free flight along the System's constraints, by the difference over +-h."""
        change = np.zeros(self.rows.n_rows)
        for side in (1.0, -1.0):
            self.context.setPositions(self.positions + side * h * self.velocities)
            v = self.velocities
            if self.rows.meets_system:
                self.context.applyConstraints(self._tight)
                v = self._tangent(self.velocities)
            change += side * np.einsum("kai,ai->k", self.gradients(), v) / (2 * h)
        return change

    # -- checks ---------------------------------------------------------------------------------

    def check(self, velocities: bool = True) -> None:
        """See `CollectiveRows.check`."""
        rows = self.rows
        for k, group in enumerate(rows._groups):
            if not forces_in(self.system, group):
                raise InputError(
                    f"row {k} ({rows.names[k]}) is no part of this System; make the context from the System that the "
                    "rows were added to",
                    item="context",
                )
        refuse_barostat(self.context, rows.atoms, "a collective row")
        gradients, _, _ = self.gram()
        # A row that knows where the origin is gives momentum to the whole.
        sizes = np.linalg.norm(gradients, axis=(1, 2))
        if np.any(np.linalg.norm(gradients.sum(axis=1), axis=1) > max(1e-9, 10 * self.precision.forces) * sizes):
            refuse_motion_remover(self.system, "a collective row")
        miss = self.worst_miss(velocities)
        if miss is not None:
            remedy = "call restore(context)"
            moves = isinstance(rows._targets[miss.row], float) and rows._rates[miss.row] != 0.0
            if moves and miss.what == "positions" and self._clock == 0.0:
                remedy += (
                    ", or where the target has moved before, with another integrator, go on from there: "
                    f"set_target(integrator, {miss.row}, {self.values()[miss.row]:.12g})"
                )
            raise ConstraintError(f"the {miss}; {remedy}", rows=[miss.row], atoms=miss.atoms)

    def worst_miss(self, velocities: bool = True) -> Miss | None:
        """Energies of the Forces less the targets, and their gradients times v."""
        rows = self.rows
        allowed = np.array(rows.scales) * max(START_TOLERANCE, 10 * rows.tolerance, 2 * self.precision.forces)
        off = self.sigma()
        near = NEAR * self._lengths() if np.any(np.abs(off) > allowed) else 0.0
        miss = Miss.worst("positions", off, allowed, self._name, rows.atoms.__getitem__, near)
        if miss is not None or not velocities:
            return miss
        gradients, v, demanded = self.gradients(), self.velocities, self.target_rates()
        size = np.linalg.norm(gradients, axis=(1, 2)) * float(np.linalg.norm(v, axis=1).max(initial=0.0))
        rates = np.einsum("kai,ai->k", gradients, v) - demanded
        allowed = max(START_TOLERANCE, 2 * self.precision.forces) * (size + np.abs(demanded))
        return Miss.worst("velocities", rates, allowed, self._name, rows.atoms.__getitem__)

    def _lengths(self) -> FloatArray:
        """What rows may be compared with: the target, one radian, or what moves an atom by a short bond."""
        periods, targets = np.array(self.rows.periods), self.targets()
        own = np.where(periods > 0, periods / (2 * np.pi), np.abs(targets))
        return np.asarray(np.maximum(own, BOND * np.linalg.norm(self.gradients(), axis=(1, 2))))

    def _name(self, row: int) -> str:
        return f"{row} ({self.rows.names[row]})"
