"""Rows that kernels hold, as the part of an integrator: what is looked at, measured and told between steps."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import openmm

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.openmm.callback_rows import CarriedConstraints, Engine, refuse_virtual_sites
from kcons.openmm.device.held_rows import constraints_of
from kcons.openmm.device.rows import DeviceRows
from kcons.openmm.integrator.guard import SystemRows, settled_rows
from kcons.openmm.integrator.part import Precision, Solver
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import accepted, masses_of, positions_of


class KernelRows(CarriedConstraints):
    """All rows of a Context that its kernels hold: those of parts and the System's constraints.

    Parameters
    ----------
    parts : sequence of Constraint or CarriedConstraints
        What ``ProjectedIntegrator(..., parts=[...], device=True)`` was given; numbers of nm, ps, dalton, radian.
        Targets left at None are taken from the positions at the first step.

    Notes
    -----
    A target that is a function is asked before each call of `step`, and at every half step that the call will make: it
    may read a context parameter.
    """

    def __init__(self, parts: Sequence[Any]) -> None:
        self._parts = parts
        carried = [part for part in parts if isinstance(part, CarriedConstraints)]
        self.given = list(accepted(constraints_of(parts)))
        self.groups = frozenset().union(*(getattr(part, "groups", ()) for part in parts))
        for part in carried:
            part._engine.served = True
        #: Whether rows take periodic images: as `hold` was told, else as the System.
        self._wraps = None if not carried else any(part.motion.lattice is not None for part in carried)
        self._bound: tuple[DeviceRows, Engine] | None = None
        self._of: tuple[Any, ...] = ()
        self._context: Callable[[], openmm.Context | None] = lambda: None
        self.code = 0
        #: Time at which sums of multipliers began, and where the last call of `step` left it, ps.
        self._since = self.left = math.nan

    # -- a Context ------------------------------------------------------------------------------

    def rows_at(
        self,
        masses: FloatArray,
        pairs: IntArray,
        lengths: FloatArray,
        positions: FloatArray,
        cell: FloatArray | None,
        time: float,
    ) -> DeviceRows:
        """The rows for a System; made where they are asked for first.

        Raises
        ------
        KconsError
            As `DeviceRows`.
        """
        # What OpenMM's own solvers hold, to whom checks and `applyConstraints` leave them.
        moving = (masses[pairs] > 0).any(axis=1)  # between others OpenMM holds nothing
        pairs, lengths = pairs[moving], lengths[moving]
        lengths = np.where(settled_rows(pairs, lengths, len(masses)), lengths.astype(np.float32), lengths)
        made_of = tuple(array.tobytes() for array in (masses, pairs, lengths))
        if self._bound is None or self._of != made_of:
            cell = None if self._wraps is False else cell
            rows = DeviceRows(masses, (pairs, lengths), self.given, positions, cell, time)
            self._bound, self._of = (rows, Engine(rows.motion, masses, cell)), made_of
            self._slopes = None
        return self._bound[0]

    def bind(self, context: openmm.Context) -> DeviceRows:
        """The rows for a Context, at its positions."""
        if self._context() is not context:
            system, program = context.getSystem(), self.program
            assert program is not None
            refuse_virtual_sites(system, self.atoms, masses_of(system))
            program.integrator.read("seed")  # makes the plan, which asks `rows_at`
            self._context = weakref.ref(context)
        assert self._bound is not None
        return self._bound[0]

    @property
    def atoms(self) -> IntArray:
        """Particles that a row of the parts touches, and of the System's constraints once they are known."""
        if self._bound is not None:
            return self._bound[1].atoms
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(item.atoms.ravel() for item in self.given)]))

    @property
    def _engine(self) -> Any:  # type: ignore[override]
        if self._bound is None:
            raise InputError(
                "these rows are known at the first step of a Context; call integrator.attach(context) after its "
                "positions were set",
                item="context",
            )
        return self._bound[1]

    @property
    def driven(self) -> bool:
        return any(item.moving or not item.holonomic for item in self.given)

    def attach(self, program: Program, context: openmm.Context) -> None:
        self.bind(context)

    def solver_at(self, context: openmm.Context) -> Solver:
        self.bind(context)
        return super().solver_at(context)

    def _state(self, context: openmm.Context) -> tuple[FloatArray, FloatArray, float]:
        self.bind(context)
        self._engine.precision = Precision.of(context)
        return super()._state(context)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Whatever the precision is: residuals are what it can hold."""

    def _check_system(self, system: openmm.System) -> None:
        """Kernels are made for the System of a Context."""

    def check_masses(self, system: openmm.System) -> None:
        """Kernels are made for the masses of a Context."""

    def rank(self, context: openmm.Context | None = None) -> int:
        """Degrees of freedom that the rows take, beyond the constraints of the System."""
        assert context is not None
        rows = self.bind(context)
        fixed = int(np.count_nonzero(rows.motion.masses[self.atoms] == 0))
        return rows.motion.rank - 3 * fixed - SystemRows.of(context.getSystem()).rank(positions_of(context))

    # -- results --------------------------------------------------------------------------------

    def mean_multipliers(self, integrator: Any) -> FloatArray:
        """Multipliers averaged over all steps since they were reset, by row of ``motion.constraint_set``.

        Where the time was set, or a State or checkpoint of another time loaded, they begin anew.

        Impulses that the kernels have summed over the time: kJ/mol over the unit of the row; NaN for constraints of the
        System, and before the first step. The weights of `Series.weights`, which blue-moon averages over
        configurations need, are not in them: take samples by `HeldCoordinatesReporter` where masses enter det Z.

        Parameters
        ----------
        integrator : ProjectedIntegrator
            The one that has made the steps.
        """
        rows, time = self.bind(integrator.context), float(integrator.context.getTime()._value) - self._since
        sums = integrator.read("rows_sums")
        return rows.multipliers(sums, time) if time > 0 else np.full(rows.set.n_rows, np.nan)

    def reset_multipliers(self, integrator: Any) -> None:
        """Begin the sums of `mean_multipliers` anew, as the first step does, and one after the time was set."""
        integrator.write("rows_sums", np.zeros(len(integrator.read("rows_sums"))))
        self._since = self.left = float(integrator.context.getTime()._value)

    def __deepcopy__(self, memo: dict[int, object]) -> KernelRows:
        return KernelRows(self._parts)

    def __reduce__(self) -> tuple[Any, ...]:
        return KernelRows, (self._parts,)

    def __repr__(self) -> str:
        return f"<KernelRows: {sum(item.n_rows for item in self.given)} rows and the constraints of the System>"
