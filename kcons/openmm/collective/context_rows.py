"""Rows at the state of a context, seen from Python: Gram matrix, projections, multipliers, checks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import openmm
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.errors import ConstraintError, ConvergenceError, InputError, SingularGeometryError
from kcons.openmm.collective.plain_rows import near_targets
from kcons.openmm.collective.row_forces import energy, forces_in
from kcons.openmm.integrator.guard import positions_of, velocities_of
from kcons.openmm.integrator.part import BOND, NEAR, Miss
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.states.hearing import listeners
from kcons.openmm.integrator.system_checks import refuse_barostat, refuse_motion_remover
from kcons.openmm.quantities import masses_of
from kcons.openmm.topology import bonds_of

if TYPE_CHECKING:
    from kcons.openmm.collective.row_program import GroupRows

#: Rows whose part beside the others is smaller than this (of their own norm) are dependent.
DEPENDENT = 1e-5
#: Off the rows by more than this (relative to the scale of a row, or to its rate): not on them.
START_TOLERANCE = 1e-9
_MAX_NEWTON = 60
#: Tolerance of the System's constraints where differences are taken, in double precision.
_TIGHT = 1e-13


class ContextRows:
    """Gradients and projections of rows at the state of a context; make a new one when that changes.

    Parameters
    ----------
    rows : GroupRows
    context : openmm.Context
        Its integrator need not be the one that holds the rows, but then targets are those the rows were made with.
    """

    def __init__(self, rows: GroupRows, context: openmm.Context) -> None:
        self.rows = rows
        self.context = context
        self._numbers = range(rows.n_rows)

    # -- the state ------------------------------------------------------------------------------

    @cached_property
    def masses(self) -> FloatArray:
        return masses_of(self.context.getSystem())

    @cached_property
    def _inverse_masses(self) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.where(self.masses > 0, 1.0 / self.masses, 0.0)[:, None]

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
        return 0.0 if self._owner is None else self.rows._clock(variables_of(self._owner))

    def targets(self) -> FloatArray:
        """Where each target is now, shape (n_rows,)."""
        rows, found = self.rows, []
        for k, target in enumerate(rows._targets):
            if isinstance(target, str):
                found.append(self.context.getParameter(target))
            elif self._settings:
                moved = self.target_rates()[k] * self._clock if rows._rates[k] != 0.0 else 0.0
                found.append(self._settings[rows._of("target", k)] + moved)
            else:
                assert target is not None
                found.append(target)
        return np.array(found)

    def target_rates(self) -> FloatArray:
        rows, found = self.rows, []
        for k, rate in enumerate(rows._rates):
            if isinstance(rate, str):
                found.append(self.context.getParameter(rate))
            else:
                found.append(self._settings.get(rows._of("rate", k), rate))
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

    def directions(self, gradients: FloatArray) -> FloatArray:
        """M_par^+ A^T, M_par^+ that of the System's constraints, shape (n_rows, n_particles, 3)."""
        pushed = gradients * self._inverse_masses
        if self.rows.meets_system:
            with self._kept(positions=False):
                for k in self._numbers:
                    pushed[k] = self._tangent(pushed[k])
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

    def gram(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(A, M_par^+ A^T, A M_par^+ A^T).

        Raises
        ------
        SingularGeometryError
            Rows that vanish, or depend on others or on the System's constraints.
        """
        gradients = self.gradients()
        directions = self.directions(gradients)
        gram = np.einsum("jai,kai->jk", gradients, directions)
        gram = 0.5 * (gram + gram.T)
        row = self._dependent(gradients, gram)
        if row is not None:
            raise SingularGeometryError(
                f"row {row} ({self.rows.names[row]}) vanishes, or depends on the rows before it or on the constraints "
                "of the System. Leave out a row that others imply; a dihedral over a straight angle or an RMSD of 0 "
                "has no direction",
                rows=[row],
            )
        return gradients, directions, gram

    def _dependent(self, gradients: FloatArray, gram: FloatArray) -> int | None:
        """The first row that adds nothing, None if all do."""
        own = np.einsum("kai,kai->k", gradients**2, np.broadcast_to(self._inverse_masses, gradients.shape))
        for k in self._numbers:
            if not (np.isfinite(own[k]) and own[k] > 0):
                return k
        scaled = gram / np.sqrt(own[:, None] * own)
        for k in self._numbers:
            left = scaled[k, k]
            if k:
                left -= scaled[k, :k] @ np.linalg.lstsq(scaled[:k, :k], scaled[:k, k], rcond=None)[0]
            if not left > self._small:
                return k
        return None

    def rank(self) -> int:
        """Number of rows that are independent of one another and of the System's constraints."""
        gradients = self.gradients()
        gram = np.einsum("jai,kai->jk", gradients, self.directions(gradients))
        own = np.einsum("kai,kai->k", gradients**2, np.broadcast_to(self._inverse_masses, gradients.shape))
        size = np.sqrt(np.where(own > 0, own, 1.0))
        return int(np.sum(np.linalg.eigvalsh(0.5 * (gram + gram.T) / (size[:, None] * size)) > self._small))

    @cached_property
    def precision(self) -> Precision:
        """That of the platform."""
        return Precision.of(self.context)

    @property
    def _small(self) -> float:
        """Squares of parts beside other rows that are rounding."""
        return max(DEPENDENT**2, 10 * self.precision.forces)

    @property
    def _tight(self) -> float:
        """Tolerance of the System's constraints where differences are taken."""
        return max(_TIGHT, self.precision.solvers) if self.precision.name != "double" else _TIGHT

    # -- projections ----------------------------------------------------------------------------

    def apply_positions(self, tolerance: float, bonds: ArrayLike | None = None) -> int:
        """See `CollectiveRows.apply_positions`."""
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
            raise ConstraintError(f"the {miss}; call restore(context)", rows=[miss.row], atoms=miss.atoms)

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


def owner(rows: GroupRows, context: openmm.Context) -> openmm.CustomIntegrator | None:
    """The integrator of the context that holds the rows, None if it has none."""
    for ours in listeners(context):
        if rows._of("push", 0) in ours.program.numbers:
            return ours
    integrator = context.getIntegrator()
    found = [integrator]
    if isinstance(integrator, openmm.CompoundIntegrator):
        found = [integrator.getIntegrator(k) for k in range(integrator.getNumIntegrators())]
    name = rows._of("push", 0)
    for one in found:
        if isinstance(one, openmm.CustomIntegrator) and name in _names(one):
            return one
    return None


def _names(integrator: openmm.CustomIntegrator) -> list[str]:
    return [integrator.getGlobalVariableName(k) for k in range(integrator.getNumGlobalVariables())]


def variables_of(integrator: openmm.CustomIntegrator) -> dict[str, float]:
    """All global variables of the integrator by name."""
    return {name: integrator.getGlobalVariable(k) for k, name in enumerate(_names(integrator))}


def applied_groups(rows: GroupRows, context: openmm.Context) -> set[int]:
    """The force groups that move the System."""
    groups = context.getIntegrator().getIntegrationForceGroups()
    chosen = groups if isinstance(groups, set | frozenset) else {g for g in range(32) if int(groups) >> g & 1}
    return set(chosen) - rows.groups
