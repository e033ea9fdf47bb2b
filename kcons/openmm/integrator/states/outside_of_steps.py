"""Constraints applied outside of steps, and the temperature of what they leave free."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import openmm
from openmm import unit

from kcons.errors import InputError, KconsError
from kcons.openmm.integrator.ensemble import Ensemble
from kcons.openmm.integrator.guard import Guard, positions_of, velocities_of
from kcons.openmm.integrator.interface import Integrator
from kcons.openmm.integrator.states.states_on_constraints import StatesOnConstraints
from kcons.openmm.quantities import relative_tolerance

if TYPE_CHECKING:
    from kcons.openmm.integrator.lean_step_writer import LeanStepWriter


class OutsideOfSteps(StatesOnConstraints, Integrator):
    """What an integrator with a program does with positions and velocities besides making steps."""

    ensemble: Ensemble
    _plan: LeanStepWriter

    def _failure(self, code: int, step: int) -> KconsError:
        raise NotImplementedError

    def refresh(self) -> None:
        """Compute the forces anew at the next step."""
        raise NotImplementedError

    def applyConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """Bring positions onto all constraints, those of the parts as well.

        Raises
        ------
        KconsError
            They cannot be reached from here; positions are unchanged.
        """
        guard = self._watch(context)
        context = guard.context
        start, velocities = positions_of(context), velocities_of(context)
        tolerance = self._tolerance(tolerance)
        try:
            guard.constraints.hold_positions(tolerance)
            if not all(part.solves_alone for part in self.parts):
                for part in self.parts:
                    part.apply_positions(context)
            elif self.parts:
                context.setVelocities(np.zeros_like(velocities))
                self._run_alone(guard, self._plan.alone, self._plan.alone + 1)
            guard.constraints.check(positions_of(context), None)
            for part in self.parts:
                guard.certify(part.worst_miss(context, velocities=False))
        except KconsError:
            context.setPositions(start)
            raise
        finally:
            context.setVelocities(velocities)

    def applyVelocityConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """Make velocities tangent to all constraints, those of the parts as well.

        Raises
        ------
        KconsError
            A part cannot do it; velocities are unchanged.
        """
        guard = self._watch(context)
        context = guard.context
        velocities, tolerance = velocities_of(context), self._tolerance(tolerance)
        by_program = bool(self.parts) and all(part.solves_alone for part in self.parts)
        try:
            if not by_program:
                context.applyVelocityConstraints(tolerance)
                for part in self.parts:
                    part.apply_velocities(context)
                return
            self._run_alone(guard, self._plan.alone, self._plan.alone)
        except KconsError:
            context.setVelocities(velocities)
            raise

    def _tolerance(self, given: float | None) -> float:
        return relative_tolerance(self.getConstraintTolerance() if given is None else given)

    def _run_alone(self, guard: Guard, first: int, end: int) -> None:
        """The stages from `first` to `end` and the projection, as no step: clock and counts stay."""
        context = guard.context
        if not guard.started:  # what Forces tell here is not known yet
            for part in self.parts:
                part.take_place(self.program, context)
        time, count, good = context.getTime(), context.getStepCount(), self.getGlobalVariableByName("good_steps")
        self.refresh()
        program = self.program
        program.write("first_stage", first)
        program.write("end_stage", end)
        try:
            openmm.CustomIntegrator.step(self, 1)
        finally:
            for name in ("first_stage", "end_stage"):
                program.write(name, (program.settings | program.idle)[name])
            program.write("good_steps", good)
            self.refresh()
            context.setTime(time)
            context.setStepCount(count)
        code = int(self.getGlobalVariableByName("failed"))
        if code:
            raise self._failure(code, count)

    # -- temperature that is found --------------------------------------------------------------

    def kinetic_energy(self, context: openmm.Context | None = None) -> unit.Quantity:
        """As a State has it: of the velocities at x; with a bath that has noise, of those in the middle of the step.

        With such a bath, and with the leapfrog, the next step computes forces anew, as after any State with energies.
        """
        guard = self._watch(context)
        if self.scheme is None or self.ensemble.noisy:
            groups = self.getIntegrationForceGroups() if self.scheme is None else 0
            return guard.context.getState(energy=True, groups=groups).getKineticEnergy()
        v = velocities_of(guard.context)
        return 0.5 * float(guard.rows.masses @ np.einsum("ij,ij->i", v, v)) * unit.kilojoule_per_mole

    def computeSystemTemperature(self) -> unit.Quantity:
        """2 K/(g k), with g the degrees of freedom that constraints leave; StateDataReporter asks for it.

        With `Isokinetic`, whose K does not fluctuate, the temperature of the configurations.

        Raises
        ------
        InputError
            No degree of freedom is left.
        """
        freedom = self.degrees_of_freedom()
        if freedom <= 0:
            raise InputError("the constraints leave no degree of freedom: there is no temperature", item="constraints")
        warmth = self.ensemble.warmth(self)
        return (2 * warmth * self.kinetic_energy() / (freedom * unit.MOLAR_GAS_CONSTANT_R)).in_units_of(unit.kelvin)
