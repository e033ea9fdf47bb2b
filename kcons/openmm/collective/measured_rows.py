"""Rows at the state of a context, seen from Python: values, targets, gradients, their Gram matrix and its rank."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.errors import SingularGeometryError
from kcons.openmm.collective.clock import variables_of
from kcons.openmm.collective.row_forces import energy
from kcons.openmm.integrator.guard import positions_of, velocities_of, width
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.system_checks import groups_in, require_context
from kcons.openmm.quantities import masses_of

if TYPE_CHECKING:
    from kcons.openmm.collective.row_program import GroupRows

#: Rows whose part beside the others is smaller than this (of their own norm) are dependent.
DEPENDENT = 1e-5
#: Tolerance of rows in double precision.
TOLERANCE = 1e-13
#: Tolerance of the System's constraints where differences are taken, in double precision.
_TIGHT = 1e-13


class MeasuredRows:
    """Rows as they are at the state of a context; make a new one when that changes.

    Parameters
    ----------
    rows : GroupRows
    context : openmm.Context
        Its integrator need not be the one that holds the rows, but then targets are those the rows were made with.
    """

    def __init__(self, rows: GroupRows, context: openmm.Context) -> None:
        require_context(context)
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
        return 0.0 if self._owner is None else self.rows._clock(self._owner)

    def targets(self) -> FloatArray:
        """Where each target is now, shape (n_rows,)."""
        rows, found = self.rows, []
        for k, target in enumerate(rows._targets):
            if isinstance(target, str):
                found.append(self.context.getParameter(target))
            elif self._settings:
                moved = self.target_rates()[k] * self._clock if rows._rates[k] != 0.0 else 0.0
                found.append(self._settings[rows._of("target", k, self._owner)] + moved)
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
                found.append(self._settings.get(rows._of("rate", k, self._owner), rate))
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
    def finest(self) -> float:
        """The smallest relative residual that is held: what Forces tell, of coordinates as they see them.

        Where those are single numbers, a row is off by the gradient times what rounding took of them, at random: twice
        its standard deviation is met by nearly each push.
        """
        precision = self.precision
        if precision.name == "double":
            return TOLERANCE
        wide = width(self.context) if self.context.getSystem().usesPeriodicBoundaryConditions() else 0.0
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
        return max(_TIGHT, self.precision.solvers) if self.precision.name != "double" else _TIGHT


def owner(rows: GroupRows, context: openmm.Context) -> openmm.CustomIntegrator | None:
    """The integrator of the context that holds the rows, None if it has none."""
    integrator = context.getIntegrator()
    if rows._of("push", 0, integrator) in getattr(getattr(integrator, "program", None), "numbers", ()):
        return integrator
    found = [integrator]
    if isinstance(integrator, openmm.CompoundIntegrator):
        found = [integrator.getIntegrator(k) for k in range(integrator.getNumIntegrators())]
    name = rows._of("push", 0)
    for one in found:
        if isinstance(one, openmm.CustomIntegrator) and name in variables_of(one):
            return one
    return None


def applied_groups(rows: GroupRows, context: openmm.Context) -> set[int]:
    """The force groups that move the System."""
    return groups_in(context.getIntegrator()) - rows.groups
