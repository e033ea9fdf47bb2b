"""A calculator that gives the forces that are left on the constraints."""

from __future__ import annotations

from collections.abc import Iterable
from operator import is_
from typing import Any

import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, PropertyNotImplementedError, all_changes
from numpy.typing import NDArray

from kcons.ase.binding import refuse_taken_along
from kcons.ase.constraints_object import Constraints
from kcons.constraints import Constraint
from kcons.constraints.arguments import as_float_array

#: Residual, in units of what double precision can reach, up to which positions are taken as they are.
_ON_SURFACE = 4.0


class ConstrainedCalculator(Calculator):
    """Energies and forces of another calculator on the constraints.

    On the constraints, forces are f + z with b = 0 (no momenta enter: ASE caches by positions) and everything else
    is the inner calculator's. Positions off the constraints are first brought onto them along the rows'
    gradients there (in the mass metric), and energy and forces are those at that point: so the energy is a
    function of the constrained motions alone, and finite differences of the forces (`Vibrations`, `Phonons`)
    give the Hessian of the energy *on* the constraints, curvature of the constraints included, with
    zeros along the held directions.

    For optimizers, saddle searches and phonons. For dynamics attach the constraints to the atoms, or use
    `ConstrainedDynamics`.

    Parameters
    ----------
    inner : ase calculator
    constraints : Constraints or sequence of Constraint
        Targets that are open are taken from the positions at the first calculation. Rows must not depend on
        time or velocities.

    Raises
    ------
    UnsupportedError
        At the first use: rows that need time or velocities.
    ConvergenceError
        Positions from which the constraints cannot be reached.

    Notes
    -----
    Stress is the inner one plus the static part of the constraints: the derivative of the energy under a
    strain after which the constraints are restored. Per-atom properties are passed on.
    """

    def __init__(self, inner: Any, constraints: Constraints | Constraint | Iterable[Constraint]) -> None:
        super().__init__()
        self.inner = inner
        given = constraints if isinstance(constraints, Constraints) else Constraints(constraints)
        self.constraints = given.copy()
        #: What the results belong to, beside the atoms.
        self._known = self._asked()
        #: Positions and cell at which stress was asked for last.
        self._stressed: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def _asked(self) -> tuple[Any, ...]:
        """What gives the results, and where the inner calculator keeps what it found: another object after a reset."""
        return self.inner, self.constraints, getattr(self.inner, "results", None)

    @property
    def implemented_properties(self) -> list[str]:  # type: ignore[override]
        """Those of the inner calculator."""
        return list(self.inner.implemented_properties)

    def check_state(self, atoms: Atoms, tol: float = 1e-15) -> list[str]:
        """What has changed since the last calculation: also masses, which share out forces, and settings."""
        changes = list(super().check_state(atoms, tol))
        if self.atoms is not None and not np.array_equal(self.atoms.get_masses(), atoms.get_masses()):
            changes.append("masses")
        if not all(map(is_, self._asked(), self._known)):
            changes.append("inner")
        return changes

    def calculate(
        self,
        atoms: Atoms | None = None,
        properties: Iterable[str] = ("energy", "forces"),
        system_changes: Iterable[str] = all_changes,
    ) -> None:
        """Fill `results`; called by ASE where its cache does not hold the properties."""
        super().calculate(atoms, list(properties), list(system_changes))
        assert self.atoms is not None
        work = self.atoms.copy()
        work.arrays.pop("momenta", None)
        work.calc = self.inner
        work.set_constraint([self.constraints])
        motion = self.constraints.engine(work)
        held = motion.constraint_set
        x = work.arrays["positions"]
        if "stress" in properties:
            before, self._stressed = self._stressed, (x.copy(), work.cell.array.copy())
            if before is not None:
                refuse_taken_along(motion, *before, *self._stressed)
        if held.n_rows and not np.all(np.abs(held.value(x)) <= _ON_SURFACE * held.tolerance(x)):
            motion.project_positions(x, x.copy(), out=x)
        found = {name: self.inner.get_property(name, work) for name in sorted({*properties})}
        known = getattr(self.inner, "results", {})
        for name in ("energy", "free_energy", "forces"):
            if name not in found and name in known and not self.inner.calculation_required(work, [name]):
                found[name] = known[name]
        missing = [name for name, value in found.items() if value is None]
        if missing:
            raise PropertyNotImplementedError(f"{type(self.inner).__name__} has no {', '.join(missing)}")
        if "forces" in found:
            found["forces"] = np.array(as_float_array(found["forces"], "forces of the calculator"))
            self.constraints.adjust_forces(work, found["forces"])
        if "stress" in found:
            found["stress"] = work.get_stress()
        self.results |= found
        self._known = self._asked()

    def restore(self, atoms: Atoms) -> None:
        """Move `atoms` to the point on the constraints that energy and forces belong to."""
        x = atoms.get_positions()
        motion = self.constraints.engine(atoms)
        atoms.set_positions(motion.project_positions(x, x.copy()), apply_constraint=False)
