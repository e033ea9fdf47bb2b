"""What rows report: values, targets, multipliers, work, and why a step failed."""

from __future__ import annotations

import math

import numpy as np
import openmm

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, KconsError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.openmm.collective.clock import require_holder
from kcons.openmm.collective.context_rows import ContextRows
from kcons.openmm.collective.row_program import GroupRows
from kcons.openmm.integrator.part import Miss
from kcons.steppers.compositions import Composition
from kcons.steppers.rattle import Rattle


class ReportedRows(GroupRows):
    """Rows that are asked how they are: at the state of a context, or of an integrator after its last step."""

    # -- at the state of a context --------------------------------------------------------------

    def at(self, context: openmm.Context) -> ContextRows:
        """The rows at the state of a context: gradients, Gram matrix, projections."""
        return ContextRows(self, context)

    def values(self, context: openmm.Context) -> FloatArray:
        """q of each row, shape (n_rows,)."""
        return self.at(context).values()

    def residuals(self, context: openmm.Context) -> FloatArray:
        """sigma = q - target of each row, shape (n_rows,), to the nearest image."""
        return self.at(context).sigma()

    def rates(self, context: openmm.Context) -> FloatArray:
        """A v less the rate of the targets, shape (n_rows,), per ps."""
        return self.at(context).slopes()

    def rank(self, context: openmm.Context) -> int:
        """How many degrees of freedom the rows take, beyond the constraints of the System."""
        return self.at(context).rank()

    def multipliers_at(self, context: openmm.Context) -> FloatArray:
        """lambda at the positions and velocities of the context, as accurate as these; shape (n_rows,).

        (A M_par^+ A^T) lambda = target'' - d(A v)/dt - A M_par^+ f (notes, eq. 104), M_par^+ that of the System's
        constraints. d(A v)/dt along their free flight by central differences; needs nine evaluations of every row.
        """
        return self.at(context).multipliers()

    def targets(self, context: openmm.Context) -> FloatArray:
        """Where each target is now, shape (n_rows,)."""
        return self.at(context).targets()

    def worst_miss(self, context: openmm.Context, velocities: bool = True) -> Miss | None:
        """sigma and A v from the Forces themselves, at the state of the context."""
        return self.at(context).worst_miss(velocities)

    # -- of an integrator, after its last step --------------------------------------------------

    def multipliers(self, integrator: openmm.CustomIntegrator) -> FloatArray:
        """lambda at the positions where the last step began, to second order in the step; shape (n_rows,).

        In kJ/mol per unit of q, z = A^T lambda. It is the mean of 2 L/h^2 of the first drift and 2 mu/h of the
        velocity projection before it, at the same positions; after a start, or when somebody moved x, only the former,
        to first order. NaN before the first step.

        Raises
        ------
        UnsupportedError
            Schemes in which these are not impulses of the same force; see `mean_multipliers`, `multipliers_at`.
        """
        scheme = getattr(integrator, "scheme", None)
        if getattr(integrator, "thermostatted", False):
            raise UnsupportedError(
                "with a thermostat the impulses of a step are not those of the forces alone; read "
                "multipliers_at(context)"
            )
        if scheme is not None and not isinstance(scheme, Rattle | Composition):
            raise UnsupportedError(
                f"{scheme!r} has no multipliers at a single point of the step; read mean_multipliers(integrator), the "
                "mean over the last step, or multipliers_at(context), those at the state of a context"
            )
        return self._read(integrator, "lambda")

    def mean_multipliers(self, integrator: openmm.CustomIntegrator) -> FloatArray:
        """Impulses of the last step over its length, shape (n_rows,): lambda averaged over it, every scheme.

        NaN before the first step.
        """
        return self._read(integrator, "mean")

    def work(self, integrator: openmm.CustomIntegrator) -> FloatArray:
        """What moving each target has added to the energy, in kJ/mol, shape (n_rows,): sum of lambda rate dt."""
        return self._read(integrator, "work")

    def _read(self, integrator: openmm.CustomIntegrator, name: str) -> FloatArray:
        require_holder(integrator)
        return np.array([integrator.getGlobalVariableByName(self._of(name, k, integrator)) for k in range(self.n_rows)])

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        """The error for a step in which the rows failed."""
        c = self.code
        singular = int(integrator.getGlobalVariableByName(f"singular{c}"))
        if singular:
            row = singular - 1
            return SingularGeometryError(
                f"step {step}: row {row} ({self.names[row]}) vanishes, or depends on the rows before it or on the "
                "constraints of the System. Leave out a row that others imply; a dihedral over a straight angle or an "
                "RMSD of 0 has no direction",
                rows=[row],
            )
        off = np.abs(self._read(integrator, "sigma")) / np.array(self.scales)
        residual = integrator.getGlobalVariableByName(f"residual{c}")
        row = int(np.argmax(np.where(np.isfinite(off), off, math.inf)))
        if not math.isfinite(residual):
            return NonFiniteError(
                f"step {step}: row {row} ({self.names[row]}) is not a number; forces or time step too large",
                item="position",
                step=step,
            )
        if residual <= self.tolerance:
            return NonFiniteError(
                f"step {step}: forces or velocities are not finite; the time step is too large",
                item="velocity",
                step=step,
            )
        iterations = int(integrator.getGlobalVariableByName(f"iterations{c}"))
        return ConvergenceError(
            f"step {step}: row {row} ({self.names[row]}) is off by {off[row] * self.scales[row]:.3g} after "
            f"{iterations} iterations (tolerance {self.tolerance:.3g}){self._digits(integrator.context)}; time step "
            f"too large (dt = {integrator.getStepSize()}), or a start that is not on the rows: call restore(context)",
            residual=float(residual),
            tolerance=self.tolerance,
            iterations=iterations,
            row=row,
            step=step,
        )

    def _digits(self, context: openmm.Context) -> str:
        """What to do where the tolerance asks for more digits than Forces have."""
        here = self.at(context)
        if not self.tolerance < here.finest:
            return ""
        return f", but Forces tell no more than {here.finest:.0e} here in {here.precision}: leave the tolerance open"
