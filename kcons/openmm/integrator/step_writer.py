"""Writes the program of one step: kicks, drifts along the constraints, projections."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from kcons.openmm.integrator.ensemble import Ensemble
from kcons.openmm.integrator.part import Part
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import stages_of
from kcons.openmm.integrator.step_variables import use
from kcons.steppers.operations import Exchange
from kcons.steppers.splitting import Splitting


class StepWriter:
    """One step of a scheme, with what is held.

    Attributes
    ----------
    operations : tuple of Operation
        What a step consists of.
    drifts, kicks : list of float
        Its stages as fractions of the step; see `stages_of`.
    halves : bool
        Whether a bath acts between two halves of the only drift.
    alone : int
        With parts: number of the stage that is a drift without kicks, for applying constraints outside of steps.
    kept : bool
        Whether the applied forces are kept in a variable: where parts evaluate row groups, OpenMM remembers the
        forces of the last groups only.
    sited, divided : bool
        Whether parts stand beside virtual sites; whether steps can be made in two executions then.
    """

    def __init__(self, program: Program, scheme: Splitting | None, parts: Sequence[Part], ensemble: Ensemble) -> None:
        self.program, self.scheme, self.parts, self.ensemble = program, scheme, tuple(parts), ensemble
        self.operations = ensemble.operations(scheme)
        self.drifts, self.kicks = stages_of(self.operations)
        self.halves = any(isinstance(operation, Exchange) for operation in self.operations)
        self.alone = len(self.drifts) + 1
        self.kept = scheme is not None and any(part.evaluates for part in self.parts)
        self.sited = scheme is not None and any(part.sited for part in self.parts)
        self.divided = self.sited and self._last_drift_apart

    def write(self) -> None:
        p = self.program
        self.force = use(p, "force") if self.kept else "f"
        use(p, "xu")
        if self.scheme is None:
            # v belongs to half a step before x. As in VerletIntegrator the kinetic energy is that at x: half the
            # impulse of the forces at x is added, and half that of the constraints in the drift to x.
            p.integrator.setKineticEnergyExpression("m*u*u/2; u=v+0.5*dt*f/m+0.5*impulse")
            p.memory.add(use(p, "impulse"))
        self._declare_ensemble()
        if self.parts:
            self._declare_guards()
            for part in self.parts:
                part.declare(p)
            self._write_guarded()
        else:
            self._write_plain()

    def write_look(self) -> None:
        """What `Guard.look` asks for at the end of a call on some platforms."""
        p = self.program
        use(p, "ending", "motion")
        with p.when("ending != 0", "a call ends"):
            p.sum("motion", "v*v", "are velocities finite?")

    # -- the kinetic energy that is reported ----------------------------------------------------

    def _declare_ensemble(self) -> None:
        p = self.program
        self.ensemble.declare(p)
        if self.ensemble.noisy:
            use(p, "v_middle", "v_end")
            # Where others have set v since, it is theirs that counts.
            p.integrator.setKineticEnergyExpression("m*u*u/2; u=select(spread*delta(v-v_end), v_middle, v)")

    def _note_middle(self, velocities: str) -> None:
        """The velocities between the last drift of a step and the kick that ends it."""
        if self.ensemble.noisy:
            self.program.each("v_middle", self._of_step(velocities, "v_middle"), "its kinetic energy is reported")

    def _note_end(self) -> None:
        """The step that has this `v_middle` ends."""
        if self.ensemble.noisy:
            self.program.each("v_end", self._of_step("v", "v_end"), "to see whether others change v")

    def _of_step(self, value: str, kept: str) -> str:
        """Constraints that are applied alone, outside of steps, leave a variable as it is."""
        return f"select(first_stage, {kept}, {value})" if self.parts else value

    # -- a step without parts -------------------------------------------------------------------

    def _write_plain(self) -> None:
        p = self.program
        use(p, "phase")
        if len(self.drifts) == 1 or self.halves:
            self._write_plain_single()
        else:
            self._write_plain_loop()
        p.let("phase", f"select(phase, select({self.phases}-phase, phase+1, 1), 0)", "what follows")

    @property
    def phases(self) -> int:
        """Executions of the program that a step takes where virtual sites are placed at the end of each only."""
        return 2 if self.halves or self.parts else len(self.drifts) + 1

    def _write_plain_single(self) -> None:
        p, kicks = self.program, self.kicks
        h = "(0.5*dt)" if self.halves else "dt"
        with p.when("phase != 2", "up to the new positions"):
            p.let_others_act()
            self.ensemble.open(p)
            if kicks[0]:
                self._kick(_of_dt(kicks[0]), tangent=True)
            if self.halves:
                # The second half absorbs what is across the constraints.
                project = self._project if self.ensemble.measures else lambda: None
                self.ensemble.middle(p, f"v+{self._drift(h)}", project)
            impulse = self._drift(h)
        with p.when("phase != 1", "with the forces there"):
            self._note_middle(f"v+{impulse}")
            if kicks[-1]:
                self._kick(_of_dt(kicks[-1]), impulse)
            else:
                p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
            if self.scheme is not None and not self._ends_tangent:
                self._project()
            self._note_end()
            self.ensemble.close(p)

    def _write_plain_loop(self) -> None:
        p, n = self.program, len(self.drifts)
        p.table("drift_share", self.drifts, "length of drift k as a fraction of the step")
        p.table("kick_share", self.kicks, "length of the kick before drift k as a fraction of the step")
        use(p, "stage", "stop", "h")
        p.let("stage", "select(phase, phase-1, 0)", "first drift")
        p.let("stop", f"select(phase, min(phase, {n}), {n})", "where to stop")
        with p.when("stage = 0", "a step begins"):
            p.let_others_act()
            self.ensemble.open(p)
        # One loop over tables: unrolled, or with more blocks, the set-up of OpenMM takes long.
        with p.loop("stage < stop", "all drifts and kicks of the scheme"):
            with p.when("kick_share(stage) != 0", "a kick comes first"):
                self._kick("dt*kick_share(stage)")
            p.let("h", "dt*drift_share(stage)", "length of this drift")
            p.each("v", f"v+{self._drift('h')}", "the constraint forces act on v as well")
            p.let("stage", "stage+1", "what follows")
        with p.when(f"phase*({self.phases}-phase) = 0", "the step ends"):
            if self.kicks[-1]:
                self._kick(_of_dt(self.kicks[-1]))
            if not self._ends_tangent:
                self._project()
            self.ensemble.close(p)

    # -- a step that is taken back when a part fails --------------------------------------------

    def _declare_guards(self) -> None:
        p, n = self.program, len(self.drifts)
        use(p, "failed", "good_steps", "first_stage")
        use(p, "end_stage", value=n)
        use(p, "stage", "h", *["per_h"] * self._last_drift_apart, *["phase"] * self.divided)
        p.table("drift_share", [*self.drifts, 0.0, 1.0], "length of drift k as a fraction of the step")
        p.table("kick_share", [*self.kicks, 0.0, 0.0], "length of the kick before drift k as a fraction of the step")
        use(p, "x_last", "v_last", "stale", *["moved"] * self.kept)

    def _write_guarded(self) -> None:
        """The same program brings positions, or velocities alone, onto the constraints.

        It starts at the last stage of the tables then, a drift without kicks, or behind it.
        """
        p = self.program
        if not self.divided:
            self._write_up_to_forces(self._write_with_forces)
            return
        with p.when("phase != 2", "up to the new positions"):
            self._write_up_to_forces()
        with p.when("phase != 1", "with the forces there"):
            self._write_with_forces()
        p.let("phase", "select(phase, 3-phase, 0)", "what follows")

    def _write_up_to_forces(self, then: Callable[[], None] = lambda: None) -> None:
        p = self.program
        with p.when("first_stage+failed = 0", "a step, and nothing failed before"):
            p.let_others_act()
        with p.when("failed = 0", "after a failure nothing moves"):
            if self.kept:
                p.sum("moved", "(x-x_last)^2", "barostats and setPositions move x between steps")
                with p.when("moved+stale != 0", "others did"):
                    p.each("x_last", "x", "start here")
                    p.each("force", "f", "applied forces")
                    for part in self.parts:
                        part.begin(p)
            else:
                p.each("x_last", "x", "to come back to")
            p.let("stale", "0", "forces belong to x")
            p.each("v_last", "v", "to come back to")
            self.ensemble.open(p)
            if self.kicks[0]:
                self._kick("dt*kick_share(first_stage)", tangent=True)
            p.let("stage", "first_stage", "first drift")
            if self.halves:
                with p.when("first_stage = 0", "a step"):
                    p.let("h", "dt*drift_share(0)", "length of the first drift")
                    # Multipliers are those of the drifts: what noise has across the constraints is none of theirs.
                    self.ensemble.middle(p, f"v+{self._drift('h')}", self._project)
                    p.let("stage", "1", "what follows")
            if self._last_drift_apart:
                self._write_single()
            else:
                self._write_loop()
            then()

    def _write_with_forces(self) -> None:
        p = self.program
        if self.scheme is None:
            # The leapfrog has velocities of half a step ago, which belong to no x.
            with p.when("first_stage*step(0.5-failed) != 0", "constraints alone"):
                self._project()
            with p.when("failed = 0", "the step is good"):
                p.let("good_steps", "good_steps+1", "count it")
        else:
            with p.when("failed = 0", "all solves converged"):
                if self._last_drift_apart:
                    self._note_middle("v+per_h*(x-xu)")
                    self._kick_after("per_h*(x-xu)")
                if not self._ends_tangent:
                    self._project()
                self._note_end()
                self.ensemble.close(p)
                p.let("good_steps", "good_steps+delta(failed)", "count it")
                if self.kept:
                    p.each("x_last", "select(failed, x_last, x)", "where forces were computed")
        with p.when("failed != 0", "a solve failed"):
            p.each("x", "x_last", "back to where the step began")
            p.each("v", "v_last", "back to where the step began")
            self.ensemble.take_back(p)
            p.let("stale", "1", "forces are those of elsewhere")

    def _write_single(self) -> None:
        """One drift needs no loop; set-up takes 15 times as long for each block within a loop."""
        p = self.program
        p.let("per_h", "0", "no drift yet")
        with p.when("stage < end_stage*step(0.5-failed)", "unless velocities are projected alone"):
            p.let("h", "dt*drift_share(stage)", "length of the drift")
            impulse = self._drift("h")
            if self.scheme is None:
                p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
            p.let("per_h", "1/h", "the constraint forces act on v as well, with the kick that follows")
            p.let("stage", "stage+1", "what follows")

    def _write_loop(self) -> None:
        p = self.program
        with p.loop("stage < end_stage*step(0.5-failed)", "all drifts and kicks of the scheme"):
            p.let("h", "dt*drift_share(stage)", "length of this drift")
            if self.single:
                # From (x-xu)/h, the shortest of many drifts would have most of the digits of v.
                self.parts[0].remember(p)
                self.parts[0].land_alone(p, "v", "h")
            else:
                p.each("v", f"v+{self._drift('h')}", "the constraint forces act on v as well")
            p.let("stage", "stage+1", "what follows")
            # Without the block set-up is faster, but forces are then computed after a failure as well.
            if all(self.kicks[1:]) and all(part.stays_finite for part in self.parts):
                self._kick_after()
            else:
                with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
                    self._kick_after()

    # -- what both are made of ------------------------------------------------------------------

    @property
    def single(self) -> bool:
        """Whether there is one part, whose rows are all there is."""
        return len(self.parts) == 1 and self.parts[0].alone and not self.sited

    @property
    def _last_drift_apart(self) -> bool:
        """Whether the last drift is written outside of a loop."""
        return len(self.drifts) == 1 or self.halves

    @property
    def _ends_tangent(self) -> bool:
        """Whether the last kick leaves v tangent, so that no projection is needed."""
        # In a loop, the last kick may be left out, where constraints are applied alone.
        return self.ensemble.stays_tangent and self.kicks[-1] != 0 and (not self.parts or self._last_drift_apart)

    def _kick_after(self, impulse: str = "") -> None:
        """The kick that follows drift `stage`, with the forces at x."""
        if self.kept:
            self.program.each("force", "f", "applied forces")
        self._kick("dt*kick_share(stage)", impulse)

    def _kick(self, h: str, impulse: str = "", tangent: bool = False) -> None:
        words = "constraint forces act, then the applied ones" if impulse else "applied forces act"
        self.program.each("v", self._kicked(h, impulse, tangent), f"the {words} (kick)")

    def _kicked(self, h: str, impulse: str = "", tangent: bool = False, unseen: bool = False) -> str:
        """The velocities after a kick, which a drift may begin with."""
        tangent = tangent and self.scheme is not None  # the leapfrog's velocities belong to half a step before
        own = {"unseen": True} if unseen else {}
        return self.ensemble.kick(self.program, h, self.force, impulse, self._project, tangent, **own)

    def _drift(self, h: str, u: str = "v") -> str:
        """Fly h along all constraints with velocities u; returns the impulse that keeps x on them, to be added to u."""
        p = self.program
        for part in self.parts:
            part.remember(p)
        self._land(u, h)
        if self.scheme is None:
            p.each("impulse", f"(x-xu)/{h}", "what the constraint forces do to v")
            return "impulse"
        return f"(x-xu)/{h}"

    def _land(self, u: str, h: str) -> None:
        """Fly freely for h with velocities u, and go from there back onto all constraints."""
        p = self.program
        u = u if u.isidentifier() else f"({u})"
        p.each("x", f"x+{h}*{u}", "move freely (drift)")
        p.each("xu", "x", "where that leads")
        for part in self.parts:
            if not (part.meets_system or part.lands_last):
                part.land(p, h)
        together = [part for part in self.parts if part.meets_system]
        if together:
            together[0].land(p, h)
        else:
            p.hold_positions("back onto the constraints of the System")
        # Until then GPUs keep x as a difference, and forces do not see it.
        for part in self.parts:
            if part.lands_last:
                part.land(p, h)
        if self.sited and any(part.lands_last for part in self.parts):
            p.hold_positions("GPUs place virtual sites")

    def _project(self) -> None:
        p = self.program
        p.hold_velocities("tangent to the constraints of the System")
        for part in self.parts:
            part.project(p)


def _of_dt(share: float) -> str:
    return "dt" if share == 1 else f"{share!r}*dt"
