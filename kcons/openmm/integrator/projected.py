"""The integrator: kicks and constrained drifts in turn, to order 2, 4 or 6."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.openmm.integrator.ensemble import ConstantEnergy, Ensemble
from kcons.openmm.integrator.guard import Guard, find_context, positions_of, velocities_of
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import LEAPFROG, to_scheme
from kcons.openmm.integrator.states.calls import Calls
from kcons.openmm.integrator.states.copies import as_projected, remade, settings_of
from kcons.openmm.integrator.states.hearing import listen
from kcons.openmm.integrator.states.serialization import ensemble_in, note_in, note_of, note_of_ensemble, read_plain
from kcons.openmm.integrator.states.settings import Settings, picoseconds
from kcons.openmm.integrator.states.states_on_constraints import StatesOnConstraints
from kcons.openmm.integrator.step_counts import StepCounts, count_step
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting


class ProjectedIntegrator(StatesOnConstraints, Calls, Settings):
    """Dynamics at constant energy on the constraints of the System, and on more where asked.

    One step is that of the same stepper in `kcons.steppers`: kicks v += h f/m, drifts along the constraints, and a
    projection of v at the end. The System's own constraints are solved by OpenMM (SETTLE, CCMA, SHAKE): its
    `constrainVelocities` is the projector M_par^+ M, its `constrainPositions` the drift's solve. Only the tolerance
    limits the accuracy.

    At the first step the integrator looks at the System and its Context: what it cannot propagate it refuses, and
    velocities are made tangent to the constraints. Later it checks at every `check_every` steps that positions and
    velocities are on all that is held, by the constraints of the System and the rows themselves: whether its solvers
    did converge OpenMM does not tell.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float; more than 0. OpenMM refuses negative steps: to go back, turn the velocities round.
    scheme : str or Splitting
        'rattle' (velocity Verlet), 'geodesic', 'suzuki4', 'yoshida4', 'kahan-li6', 'blanes-moan4', 'blanes-moan6',
        'blanes-moan6a', or a splitting of kcons.steppers; 'leapfrog', with velocities half a step behind as in
        openmm.VerletIntegrator.
    parts : sequence of Part
        What else to hold: collective variables, surfaces, constraint objects of kcons.
    tolerance : float, optional
        Relative tolerance of the System's constraints. Left open, what the platform of the Context can hold: 1e-10 in
        double, 1e-8 in mixed and 1e-5 in single precision.
    check_every : int, optional
        Steps between two checks; 0 for none but the first. Left open, 100, and later, up to 10,000, where checks would
        take more than a hundredth of the time.
    ensemble : Ensemble, optional
        How velocities change between drifts; constant energy by default.

    Raises
    ------
    InputError, UnsupportedError
        A time step that is no positive number, an unknown scheme, parts that do not go together.

    Notes
    -----
    A member of a CompoundIntegrator makes its steps with all its checks, as long as kcons is imported.
    """

    #: Steps between two checks, if nothing else is asked for, ...
    _check_every = 100
    #: ... when checks come later where they would take more than a hundredth of the time.
    spare = True
    #: How often forces were no longer those that were known.
    refreshed = 0
    #: What writes the program.
    _writer: type[LeanStepWriter] = LeanStepWriter

    def __init__(
        self,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        parts: Sequence[Part] = (),
        tolerance: float | None = None,
        check_every: int | None = None,
        ensemble: Ensemble | None = None,
    ) -> None:
        super().__init__(picoseconds(timestep))
        openmm.CustomIntegrator.setConstraintTolerance(self, Precision("", "double").tolerance)
        if tolerance is not None:
            self.setConstraintTolerance(tolerance)
        if check_every is not None:
            self.check_every = check_every
        #: None for the leapfrog.
        self.scheme = to_scheme(scheme)
        self._ensemble: Ensemble = ConstantEnergy() if ensemble is None else ensemble
        if not hasattr(self._ensemble, "check"):
            raise InputError(
                f"ensemble is {ensemble!r}; give one of kcons.openmm, such as Langevin(temperature, friction)",
                item="ensemble",
            )
        self._ensemble.check(self.scheme)
        self.parts = _listed(parts)
        if sum(part.meets_system for part in self.parts) > 1:
            raise UnsupportedError("only one part may share atoms with the constraints of the System")
        for k, part in enumerate(self.parts, start=1):
            part.code = k
        #: Force groups that carry rows, not forces.
        self.row_groups: frozenset[int] = frozenset().union(*(part.groups for part in self.parts))
        self._guard: Guard | None = None
        if self.row_groups:
            self.setIntegrationForceGroups(-1)
        self.program = Program(self)
        writer: type[LeanStepWriter] = getattr(self._ensemble, "writer", None) or self._writer
        self._plan = writer(self.program, self.scheme, self.parts, self.ensemble)
        self._plan.write()
        listen(self)

    def __repr__(self) -> str:
        scheme = "leapfrog" if self.scheme is None else repr(self.scheme)
        held = "".join(f", {part!r}" for part in self.parts)
        return f"<ProjectedIntegrator: {scheme}, {self._dt * 1e3:g} fs{held}>"

    def __str__(self) -> str:
        return f"{self!r}\n{self.listing()}"

    def listing(self) -> str:
        """What is held and how closely, the variables, and the steps of the integrator, in words."""
        held = f"constraints of the System to {self.getConstraintTolerance():g} (relative)"
        guard = self._guard
        if guard is not None:
            held += f", {guard.constraints.precision}"
        elif self.asked_tolerance is None:
            held += ", or what the precision of the Context allows"
        step = "\n".join(f"  {operation}" for operation in self.operations())
        return f"{held}\na step of {self!r}\n{step}\n{self.program.listing()}"

    def operations(self) -> tuple[Operation, ...]:
        """What a step consists of, as for steppers on arrays; `listing` adds how OpenMM computes it."""
        return self._plan.operations

    def counts(self, *, seen: bool = True, iterations: int = 2) -> StepCounts:
        """What a step makes OpenMM do, where all goes well.

        Parameters
        ----------
        seen : bool
            Steps at whose end somebody looks; False for those within a call of `step`.
        iterations : int
            How often loops run that solve for positions.
        """
        lean = {"between": float(not seen), "lean": 1.0}
        known = {name: value for name, value in lean.items() if name in self.program.numbers}
        return count_step(self.program, iterations=iterations, **known)

    # -- running --------------------------------------------------------------------------------

    @property
    def check_every(self) -> int:
        """Steps between two checks; 0 for none but the first."""
        return self._check_every

    @check_every.setter
    def check_every(self, steps: int) -> None:
        self._check_every, self.spare = whole_number(steps, "check_every", 0), False

    @property
    def context(self) -> openmm.Context:
        """The Context that this integrator belongs to.

        Found by itself; set it where this fails.

        Raises
        ------
        UnsupportedError
            There is none.
        """
        guard = self._guard
        context = None if guard is None else guard.alive
        if context is None:
            context = find_context(self)
            if context is None:
                raise UnsupportedError("this integrator belongs to no Context; create one with it first")
            self.context = context
        return context

    @context.setter
    def context(self, context: openmm.Context) -> None:
        if self._guard is None or self._guard.alive is not context:
            self._guard = Guard(context, self)

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        if context is None:
            context = self.context
        self.context = context
        assert self._guard is not None
        return self._guard

    def _failure(self, code: int, step: int) -> KconsError:
        error = self.parts[code - 1].failure(self, step)
        self.program.write("failed", 0.0)
        return error

    def refresh(self) -> None:
        """Compute the forces anew at the next step.

        Where parts are held, forces are kept from one step to the next. What changes them is seen: positions,
        parameters, boxes, `updateParametersInContext`.
        """
        self.refreshed += 1
        if self.parts:
            self.program.write("stale", 1.0)
        if "behind" in self.program.numbers:
            self.program.write("behind", 0.0)

    def check(self, context: openmm.Context | None = None) -> None:
        """Whether all is well: the System, its constraints and the parts, at the present state.

        Nothing is returned where it is; `kcons.openmm.worst_length` tells how well lengths are kept.

        Raises
        ------
        KconsError
            What is wrong. Also a failure in a step that ran within a CompoundIntegrator.
        """
        guard = self._watch(context)
        if self.parts:
            code = int(self.getGlobalVariableByName("failed"))
            if code:
                raise self._failure(code, int(self.getGlobalVariableByName("good_steps")) + 1)
        for part in self.parts if guard.disturbed else ():
            part.check(guard.context, velocities=not guard.late)
        guard.check()
        for part in self.parts:
            part.check(guard.context, velocities=not guard.late)

    # -- constraints outside of steps -----------------------------------------------------------

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
        tolerance = self.getConstraintTolerance() if tolerance is None else tolerance
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
        velocities = velocities_of(context)
        by_program = bool(self.parts) and all(part.solves_alone for part in self.parts)
        try:
            if not by_program:
                context.applyVelocityConstraints(self.getConstraintTolerance() if tolerance is None else tolerance)
                for part in self.parts:
                    part.apply_velocities(context)
                return
            self._run_alone(guard, self._plan.alone, self._plan.alone)
        except KconsError:
            context.setVelocities(velocities)
            raise

    def _run_alone(self, guard: Guard, first: int, end: int) -> None:
        """The stages from `first` to `end` and the projection, as no step: clock and counts stay."""
        context = guard.context
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
        """Of the velocities at x; no forces are computed unless the scheme is the leapfrog."""
        guard = self._watch(context)
        if self.scheme is None:
            state = guard.context.getState(energy=True, groups=self.getIntegrationForceGroups())
            return state.getKineticEnergy()
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

    # -- settings -------------------------------------------------------------------------------

    def setIntegrationForceGroups(self, groups: int | Iterable[int]) -> None:
        """Choose the force groups that act; groups that carry rows never do.

        Parameters
        ----------
        groups : int or iterable of int
            A bit mask or group numbers. -1 and all 32 groups mean: all but the groups of rows.

        Raises
        ------
        InputError
            Groups that carry rows are among those given.
        UnsupportedError
            The Context exists; it has read the groups and would ignore the change.
        """
        if getattr(self, "_guard", None) is not None or (getattr(self, "program", None) and find_context(self)):
            raise UnsupportedError("the Context has read the force groups already; set them before it is created")
        wanted = {g for g in range(32) if (groups >> g) & 1} if isinstance(groups, int) else set(groups)
        rows = self.row_groups
        if len(wanted) == 32:
            wanted -= rows
        if wanted & rows:
            raise InputError(
                f"force groups {sorted(wanted & rows)} carry constraint rows, their forces are gradients and must not "
                "act; leave them out",
                item="groups",
            )
        super().setIntegrationForceGroups(wanted)

    # -- copies and files -----------------------------------------------------------------------

    @classmethod
    def from_xml(cls, xml: str, **arguments: Any) -> ProjectedIntegrator:
        """The integrator that XmlSerializer wrote, with its parts.

        Without parts XmlSerializer.deserialize does the same.

        Parameters
        ----------
        xml : str
            The text of the file.
        **arguments
            `parts`, which the file does not contain; `check_every` and `ensemble` where they are to be others.

        Raises
        ------
        InputError
            The file has no program of this class with these parts.
        """
        return cls._of_note(read_plain(xml), note_in(xml) or {}, **arguments)

    def _note(self) -> dict[str, Any]:
        return note_of(self, ensemble=note_of_ensemble(self.ensemble), parts=len(self.parts))

    @classmethod
    def _of_note(cls, plain: openmm.CustomIntegrator, note: dict[str, Any], **arguments: Any) -> ProjectedIntegrator:
        if not note:
            return as_projected(cls, plain, **arguments)
        if note["parts"] and not arguments.get("parts"):
            raise InputError(
                f"the integrator in the file holds {note['parts']} parts, which no file contains; read it by "
                "ProjectedIntegrator.from_xml(text, parts=[...]) with the same parts as when it was made",
                item="parts",
            )
        made = as_projected(
            cls, plain, **{"check_every": note["check_every"], "ensemble": ensemble_in(note), **arguments}
        )
        made.asked_tolerance = note["tolerance"]
        return made

    @classmethod
    def as_projected(cls, integrator: openmm.CustomIntegrator, **arguments: Any) -> ProjectedIntegrator:
        """A plain CustomIntegrator that was one of these once, see `from_xml`."""
        return as_projected(cls, integrator, **arguments)

    def _making(self) -> tuple[Any, ...]:
        scheme = LEAPFROG if self.scheme is None else self.scheme
        every = None if self.spare else self.check_every
        return self._dt, scheme, self.parts, self.asked_tolerance, every, self.ensemble

    def __reduce__(self) -> tuple[Any, ...]:
        return remade, (type(self), self._making(), settings_of(self))

    def __copy__(self) -> ProjectedIntegrator:
        """Without the Context, and with copies of the parts: an integrator and its parts serve one Context."""
        return remade(type(self), deepcopy(self._making()), settings_of(self))

    def __deepcopy__(self, memo: dict[int, Any]) -> ProjectedIntegrator:
        return self.__copy__()


def _listed(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Parts, or a single one, as a tuple; `InputError` for what is none."""
    given = tuple(parts) if isinstance(parts, Iterable) else (parts,)
    for part in given:
        if not isinstance(part, Part):
            raise InputError(
                f"parts has {part!r:.80}, which is no part of an integrator; kcons.openmm.hold(system, constraints, "
                "positions) makes one of constraints, CollectiveRows of Forces, surface_parts of surfaces",
                item="parts",
            )
    return given
