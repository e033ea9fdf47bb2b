"""What OpenMM asks the engine in a step: gradients, positions on the rows, tangent velocities."""

from __future__ import annotations

from typing import Any, Self

import openmm

from kcons.errors import UnsupportedError
from kcons.openmm.carried.callbacks import LOW_SCALE, SPEED_SCALE, Engine
from kcons.openmm.carried.passage import CARRY_SCALE
from kcons.openmm.carried.requirements import refuse_single_precision
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.precision import Precision
from kcons.openmm.integrator.program import Program


class CarriedProgram(Part):
    """What carried rows write into a program, and when it runs."""

    evaluates = True
    lands_last = True
    written = (*Part.written, "_early")
    _engine: Engine
    #: Of each phase, the force group whose evaluation calls the engine.
    _groups: dict[str, int]

    def declare(self, program: Program) -> None:
        self._engine.follow(program.integrator, self.lean)
        #: Where a step may end without a projection, the solve for positions must tell of failures itself.
        self._early = self.lean or getattr(program.integrator, "scheme", None) is None

    def serve(self, integrator: openmm.CustomIntegrator, notes: dict[str, Any]) -> None:
        """Times, stages and lengths of drifts are those of the integrator that makes steps."""
        super().serve(integrator, notes)
        self._engine.follow(integrator, self.lean)

    def take_precision(self, program: Program, precision: Precision) -> None:
        """Refuse single precision; what passes through OpenMM is known now."""
        refuse_single_precision(precision)
        self._engine.take_precision(precision)
        if f"rest{self.code}" in program.settings:
            program.set(f"rest{self.code}", float(self._engine.carries_rest))

    def begin_early(self, program: Program) -> None:
        """Where x is not where the last step ended, and velocities are projected before the first drift."""
        self.remember(program)

    def _guard(self, program: Program, phase: str, words: str) -> None:
        group = self._groups[phase]
        program.let("failed", f"select(energy{group}, {self.code}, failed)", words)

    def begin_run(self) -> None:
        self._engine.begin_run()

    def remember(self, program: Program) -> None:
        words = "carried rows: positions whose gradients are taken"
        if not self.lean or self._engine.timed:
            self._guard(program, "remember", words)
            return
        with program.when("looked+moving != 0", "x need not be where the last drift ended"):
            self._guard(program, "remember", words)

    def land(self, program: Program, h: str) -> None:
        change = f"f{self._groups['land']}"
        if self._early:
            self._guard(program, "land", "carried rows: solve for positions")
            force, change = change, program.vector(f"change{self.code}", "what brings carried particles onto the rows")
            program.each(change, force, "from the evaluation that tells of failures")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*{change}", "carried rows: onto them")

    def land_alone(self, program: Program, u: str, h: str) -> None:
        """The drift with velocity u and its impulse, where nothing else acts on x: x and v change."""
        group = self._groups["land"]
        program.each("x", f"x+{h}*{u}", "move freely (drift)")
        self._guard(program, "land", "carried rows: solve for positions")
        # Force and energy come from one evaluation, for this moves no x.
        program.each("v", f"{u}+{1 / CARRY_SCALE!r}*f{group}/{h}", "the constraint forces act on v as well")
        program.each("x", f"x+{1 / CARRY_SCALE!r}*f{group}", "carried rows: onto them")

    def project(self, program: Program) -> None:
        change = f"f{self._groups['project']}"
        # Thermostats stir more than rounding does.
        rest = self._engine.carries_rest
        program.each("xu", "x", "to come back to")
        program.each("x", f"x+{1 / SPEED_SCALE!r}*v", "carries v, exactly as far as it can be told from x")
        self._guard(program, "project", "carried rows: solve for velocities")
        carried = f"(x-xu)*{SPEED_SCALE!r}"
        if rest:
            program.setting(f"rest{self.code}", "1 where the rest of v matters: forces are double", 1.0)
            program.vector("v_low", "what of v was too small to be carried together with x")
            program.each("v_low", f"select({change}, v-{carried}, 0)", "the rest of v")
        program.each("v", f"select({change}, {carried}+{1 / CARRY_SCALE!r}*{change}, v)", "tangent to the carried rows")
        if rest:
            with program.when(f"rest{self.code} != 0", "all digits"):
                program.each("x", f"xu+{LOW_SCALE!r}*v_low", "carries the rest")
                self._guard(program, "project", "carried rows: the same for the rest")
                back = 1 / (CARRY_SCALE * SPEED_SCALE * LOW_SCALE)
                program.each("v", f"v+v_low+{back!r}*{change}", "tangent, all of it")
        program.each("x", "xu", "back")

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """The same: the forces of the System call this engine, whichever integrator makes steps."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        raise UnsupportedError(
            "rows of hold belong to their System and cannot be pickled with an integrator; pickle the System, and make "
            "another integrator with parts=[CarriedConstraints.of(system)]"
        )
