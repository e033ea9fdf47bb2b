"""The integrator: kicks and constrained drifts in turn, to order 2, 4 or 6."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.openmm.integrator.ensemble import ConstantEnergy, Ensemble
from kcons.openmm.integrator.guard import Guard, find_context
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import DOUBLE
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import to_scheme
from kcons.openmm.integrator.states.calls import Calls
from kcons.openmm.integrator.states.copies import Copies
from kcons.openmm.integrator.states.hearing import listen, listeners
from kcons.openmm.integrator.states.outside_of_steps import OutsideOfSteps
from kcons.openmm.integrator.states.settings import Settings, picoseconds
from kcons.openmm.integrator.step_counts import StepCounts, count_step
from kcons.openmm.integrator.system_checks import require_context
from kcons.openmm.quantities import relative_tolerance
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting


class ProjectedIntegrator(OutsideOfSteps, Calls, Settings, Copies):
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

    Warns
    -----
    UserWarning
        A time step above 20 fs that has no unit.

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
        self.asked_tolerance = None if tolerance is None else relative_tolerance(tolerance)
        openmm.CustomIntegrator.setConstraintTolerance(self, self.asked_tolerance or DOUBLE.tolerance)
        if check_every is not None:
            self.check_every = check_every
        #: None for the leapfrog.
        self.scheme = to_scheme(scheme)
        self._ensemble: Ensemble = ConstantEnergy() if ensemble is None else ensemble
        if isinstance(ensemble, type) or not hasattr(self._ensemble, "check"):
            raise InputError(
                f"ensemble is {ensemble!r}; give one of kcons.openmm, such as Langevin(temperature, friction)",
                item="ensemble",
            )
        self._ensemble.check(self.scheme)
        self.parts = _listed(parts)
        if sum(part.meets_system for part in self.parts) > 1:
            raise UnsupportedError("only one part may share atoms with the constraints of the System")
        _refuse_shared(self.parts)
        for k, part in enumerate(self.parts, start=1):
            part.forget()
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
        self._plan.write_look()
        #: What parts know as this integrator, and what its program has set in each.
        self.identity = object()
        self._notes = [part.notes() for part in self.parts]
        for part in self.parts:
            part.serves = self.identity
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
        lean = {"between": float(not seen), "behind": float(not seen), "lean": 1.0}
        known = {name: value for name, value in lean.items() if name in self.program.numbers}
        for name in {"exact", "coarse"} & set(self.program.numbers):
            known[name] = self.getGlobalVariableByName(name)
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
        InputError
            What is set is no Context, or that of another integrator.
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
            require_context(context)
            if not any(one is self for one in listeners(context)):
                raise InputError(
                    f"the Context was made with another integrator than {self!r}; give the Context of this one",
                    item="context",
                )
            self._guard = Guard(context, self)

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        served = [part.serves for part in self.parts if part.serves is not self.identity]
        if served:
            for part, notes in zip(self.parts, self._notes, strict=True):
                part.serve(self, notes)
                part.serves = self.identity
        if context is None:
            context = self.context
        self.context = context
        assert self._guard is not None
        if self._written:
            self._take_written()
        if served:
            self.take_precision(self._guard.constraints.precision)
            self._guard.disturbed = True
            for before in listeners(self._guard.context):
                if isinstance(before, ProjectedIntegrator) and any(before.identity is one for one in served):
                    for part, notes in zip(before.parts, before._notes, strict=True):
                        if any(part is own for own in self.parts):
                            part.continue_from(before, notes, self.program)
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


def _refuse_shared(parts: Sequence[Part]) -> None:
    """Refuse particles that two parts hold: each would undo what the other does."""
    known: set[int] = set()
    for part in parts:
        atoms = {int(a) for held in getattr(part, "atoms", ()) for a in np.ravel(held)}
        if known & atoms:
            raise UnsupportedError(
                f"two parts hold particle {min(known & atoms)}; give all rows that share particles to one call of "
                "kcons.openmm.hold"
            )
        known |= atoms
