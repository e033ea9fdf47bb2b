"""Rows at the state of a context, seen from Python: projections, multipliers, checks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import ConstraintError, ConvergenceError, InputError
from kcons.openmm.collective.plain_rows import near_targets
from kcons.openmm.collective.row_forces import forces_in
from kcons.openmm.integrator.guard import positions_of
from kcons.openmm.integrator.part import BOND, NEAR, Miss
from kcons.openmm.integrator.system_checks import refuse_barostat, refuse_motion_remover
from kcons.openmm.topology import bonds_of

if TYPE_CHECKING:
    pass

from kcons.openmm.collective.measured_rows import MeasuredRows, applied_groups

#: Off the rows by more than this (relative to the scale of a row, or to its rate): not on them.
START_TOLERANCE = 1e-9
_MAX_NEWTON = 60


class ContextRows(MeasuredRows):
    """What can be done to rows at the state of a context."""

    # -- projections ----------------------------------------------------------------------------

    def apply_positions(self, tolerance: float | None = None, bonds: ArrayLike | None = None) -> int:
        """See `CollectiveRows.apply_positions`."""
        if tolerance is None:
            tolerance = self.finest if self.rows.asked_tolerance is None else self.rows.asked_tolerance
        scales = np.array(self.rows.scales)
        start, velocities = self.positions, self.velocities
        system_tolerance = self.context.getIntegrator().getConstraintTolerance()

        def size_at(x: FloatArray) -> tuple[float, FloatArray]:
            self.context.setPositions(x)
            if constrained:
                self.context.applyConstraints(system_tolerance)
            off = self.sigma()
            return float(np.linalg.norm(off / scales)), off

        constrained = self.context.getSystem().getNumConstraints() > 0
        done = 0
        try:
            size, off = size_at(self._led(start, bonds))
            for done in range(_MAX_NEWTON):
                if size <= tolerance:
                    self.context.setVelocities(velocities)
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
        except Exception:
            self._put(start, velocities)
            raise
        self._put(start, velocities)
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
        """Where Newton's method begins: for far targets of plain rows groups are moved whole first."""
        miss = self.worst_miss(velocities=False)
        pairs = bonds_of(self.context.getSystem(), start) if bonds is None else np.asarray(bonds)
        if miss is None or miss.near or not len(pairs):
            return start
        forces = [forces_in(self.context.getSystem(), group) for group in self.rows._groups]
        only = [found[0] if len(found) == 1 else None for found in forces]
        led = near_targets(self.context, only, self.sigma(), self.targets(), pairs)
        return start if led is None else led

    def _put(self, positions: FloatArray, velocities: FloatArray) -> None:
        self.context.setPositions(positions)
        self.context.setVelocities(velocities)

    def apply_velocities(self) -> None:
        """See `CollectiveRows.apply_velocities`."""
        if self.context.getSystem().getNumConstraints():
            self.context.applyVelocityConstraints(self.context.getIntegrator().getConstraintTolerance())
        here = ContextRows(self.rows, self.context)
        velocities = here.velocities
        gradients, directions, gram = here.gram()
        slopes = np.einsum("kai,ai->k", gradients, velocities) - here.target_rates()
        change = np.einsum("k,kai->ai", np.linalg.solve(gram, slopes), directions)
        self.context.setVelocities(velocities - change)

    # -- multipliers ----------------------------------------------------------------------------

    def multipliers(self) -> FloatArray:
        """See `CollectiveRows.multipliers_at`."""
        _, directions, gram = self.gram()
        applied = self._force(applied_groups(self.rows, self.context))
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
        rows, system = self.rows, self.context.getSystem()
        present = {force.getForceGroup() for force in system.getForces()}
        for k, group in enumerate(rows._groups):
            if group not in present:
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
            refuse_motion_remover(system, "a collective row")
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
        gradients, v = self.gradients(), self.velocities
        demanded = self.target_rates()
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
