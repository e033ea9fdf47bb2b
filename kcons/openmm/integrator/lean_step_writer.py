"""The program of a step without operations that only serve a state that is read.

Between two steps of one call of `step` velocities are not read. The second half kick of a step and the first of the
next are then one, and the velocities are not made tangent: the next drift starts where they would be, pushes along
the same gradients, and absorbs what they have across. The motion is the same; see notes on RATTLE and leapfrog.

At the end of a call velocities are completed. What they were before is kept (`raw`), and the next call goes on from
there unless somebody has changed x or v: how many steps a call makes does not change a bit of the motion.
"""

from __future__ import annotations

import numpy as np

from kcons.openmm.integrator.ensemble import ConstantEnergy
from kcons.openmm.integrator.step_variables import use
from kcons.openmm.integrator.step_writer import StepWriter
from kcons.steppers.rattle import Rattle

#: Schemes whose shortest drifts are less than this part of a step: what rounding does to x, divided by the length of
#: the drift, must be kept out of v there.
SHORT_DRIFT = 1 / 30


class LeanStepWriter(StepWriter):
    """As `StepWriter`; velocity Verlet with parts, and the leapfrog without, omit what only readers of the state need.

    With an ensemble, velocity Verlet without parts does so, too: two kicks of half a step are made as one.

    Attributes
    ----------
    lazy : bool
        Whether the program does so, when the global `between` is 1.
    observed : int
        How many steps at the end of a call must be complete, for multipliers of a step to be there.
    filtered : bool
        Whether drifts change v by impulses without the rounding errors of positions.
    """

    lazy = False
    lean = False
    joined = False
    observed = 1
    filtered = False

    def write(self) -> None:
        plain = type(self.ensemble) is ConstantEnergy
        self.lean = plain and bool(self.parts) and isinstance(self.scheme, Rattle) and not self.sited
        #: Without parts: the kick that ends a step is made with that which begins the next.
        self.joined = self.ensemble.adds_up and not self.parts and isinstance(self.scheme, Rattle)
        owing = self.ensemble.owes and not self.parts
        self.lazy = self.lean or self.joined or owing or (self.scheme is None and not self.parts)
        self.observed = 2 if self.lean else 1
        self.filtered = not self.parts and bool(np.abs(self.drifts).min() < SHORT_DRIFT)
        if self.lazy:
            use(self.program, "between")
        super().write()

    # -- the leapfrog without parts -------------------------------------------------------------

    def _write_plain(self) -> None:
        if self.joined:
            self._write_joined()
            return
        if self.scheme is not None:
            super()._write_plain()
            return
        p = self.program
        p.let_others_act()
        self._kick("dt")
        p.each("x", "x+dt*v", "move freely (drift)")
        p.each("xu", "x", "where that leads")
        p.hold_positions("back onto the constraints of the System")
        with p.when("between = 0", "somebody asks for the kinetic energy"):
            p.each("impulse", "(x-xu)/dt", "what the constraint forces do to v")
        p.each("v", "v+(x-xu)/dt", "the constraint forces act on v as well")

    # -- velocity Verlet whose kicks or projections are dear ------------------------------------

    def _write_joined(self) -> None:
        p, ensemble = self.program, self.ensemble
        use(p, "behind", "kick", "phase", "x_start", "coarse")
        with p.when("phase != 2", "up to the new positions"):
            p.let_others_act()
            p.let("kick", "0.5+0.5*behind", "with the half kick that is missing")
            h = "(0.5*dt)" if self.halves else "dt"
            u = self._kicked("kick*dt", tangent=True, unseen=True)
            with p.when("coarse != 0", "where a drift leads does not tell v: the impulse alone is read from it"):
                p.each("v", u, "the applied forces act (kick)")
                if self.halves:
                    ensemble.middle(p, f"v+{self._drift(h)}", lambda: None)
                else:
                    p.each("v", f"v+{self._drift(h)}", "the constraint forces act on v as well")
            with p.when("coarse = 0", "v need not be written: it follows from where the drift leads"):
                p.each("x_start", "x", "where the drift begins")
                p.each("x", f"x+{h}*({u})", "the applied forces act, then move freely (drift)")
                p.hold_positions("back onto the constraints of the System")
                if self.halves:
                    ensemble.middle(p, f"(x-x_start)/{h}", lambda: None)
                else:
                    p.each("v", f"(x-x_start)/{h}", "as the drift went")
            if self.halves:  # this half absorbs what noise has across the constraints
                p.each("v", f"v+{self._drift(h)}", "the constraint forces act on v as well")
            if ensemble.stays_tangent:
                with p.when("exact+1-between != 0", "kicks need it"):
                    self._project()
        with p.when("between+delta(phase-1) = 0", "somebody looks at the velocities"):
            self._note_middle("v")
            self._kick("0.5*dt", tangent=True)
            if not ensemble.stays_tangent:  # otherwise the next drift absorbs what v has across
                self._project()
            self._note_end()
        p.let("behind", "between", "the next step makes up for it")
        p.let("phase", "select(phase, 3-phase, 0)", "what follows")

    # -- impulses without rounding --------------------------------------------------------------

    def _drift(self, h: str, u: str = "v") -> str:
        """As there. What a drift does to v lies along the gradients where it began: the rest of (x-xu)/h is rounding.

        (x-xu)/h has the rounding errors of x, divided by h. The projector where the drift began tells what of it is
        along the constraints.
        """
        if not self.filtered:
            return super()._drift(h, u)
        p = self.program
        use(p, "x_start", "v_next")
        # u is v: only velocity Verlet begins with another, and its drift is long.
        p.each("x_start", "x", "where the drift begins")
        p.each("x", f"x+{h}*v", "move freely (drift)")
        p.each("xu", "x", "where that leads")
        p.hold_positions("back onto the constraints of the System")
        p.each("v_next", f"v+(x-xu)/{h}", "the constraint forces act on v as well, and rounding errors of x")
        p.each("v", f"(x-xu)/{h}", "to be split")
        p.each("xu", "x", "where the drift ends")
        p.each("x", "x_start", "back, for a moment")
        p.hold_positions("only tells the System's constraints where x is")
        p.hold_velocities("what is along the constraints: rounding")
        p.each("x", "xu", "where the drift ends")
        p.hold_positions("only tells the System's constraints where x is")
        return "v_next-2*v"

    # -- velocity Verlet with parts -------------------------------------------------------------

    def _declare_guards(self) -> None:
        for part in self.parts:
            part.lean = self.lean
        super()._declare_guards()
        if not self.lean:
            return
        p = self.program
        self.force = use(p, "force")
        use(p, "u", "raw", "moved", "moving", "looked", "lean", "behind", "led", "dt_last", "loose")

    def _write_guarded(self) -> None:
        if not self.lean:
            super()._write_guarded()
            return
        p = self.program
        with p.when("failed = 0", "after a failure nothing moves"):
            with p.when("looked != 0", "x and v may have been changed"):
                p.sum("moved", "(x-x_last)^2+(v-v_last)^2", "by whom ever")
                p.let("behind", "select(moved+abs(dt-dt_last), 0, behind)", "then v is what it is")
                p.each("v_last", "v", "to come back to")
                p.each("v", "select(behind, raw, v)", "go on as if nobody had looked")
                with p.when("first_stage = 0", "a step"):
                    p.let_others_act()
                p.sum("moved", "(x-x_last)^2", "barostats and setPositions move x between steps")
                with p.when("moved+stale != 0", "others did"):
                    p.each("x_last", "x", "start here")
                    p.each("force", "f", "applied forces")
                    across = any(part.meets_system for part in self.parts)
                    if across:
                        p.each("u", "v", "v is needed to project the rows")
                    for part in self.parts:
                        part.begin(p)
                    if across:
                        p.each("v", "u", "v again")
                p.each("u", "v+select(behind, 1, kick_share(first_stage))*dt*force/m", "the applied forces act (kick)")
            with p.when("looked = 0", "in the middle of many steps"):
                p.let_others_act()
                p.each("x_last", "x", "to come back to")
                p.each("u", "v+dt*f/m", "the applied forces act (both half kicks)")
                for part in self.parts:
                    part.renew(p)
            p.let("stale", "0", "forces belong to x")
            p.let("led", "behind", "for multipliers")
            p.let("dt_last", "dt", "to see whether it is changed")
            p.let("stage", "first_stage", "the drift")
            p.let("per_h", "0", "no drift yet")
            with p.when("stage < end_stage*step(0.5-failed)", "unless velocities are projected alone"):
                p.let("h", "dt*drift_share(stage)", "length of the drift")
                self._drift_with("u", "h")
                p.let("per_h", "1/h", "the constraint forces act on v as well")
                p.let("stage", "stage+1", "what follows")
            with p.when("select(failed, 0, 1-between) != 0", "somebody looks at the velocities"):
                p.each("force", "f", "applied forces")
                p.each("raw", "v" if self.single else "u+per_h*(x-xu)", "the constraint forces act")
                p.each("v", "raw+dt*kick_share(stage)*force/m", "the applied forces act (kick)")
                self._project()
                p.let("behind", "0", "unless all is well")
                p.each("x_last", "select(failed, x_last, x)", "where forces were computed")
                p.each("v_last", "select(failed, v_last, v)", "to see whether others change it")
            with p.when("select(failed, 0, between) != 0", "nobody looks"):
                if not self.single:
                    p.each("v", "u+per_h*(x-xu)", "the constraint forces act on v as well")
                for part in self.parts:
                    part.passed(p)
            # Without blocks: the set-up of OpenMM goes along each way through them.
            p.let("good_steps", "good_steps+delta(failed)", "count it if all solves converged")
            p.let("behind", "select(failed, behind, lean)", "v, or raw, lacks half a kick")
            p.let("looked", "select(failed, looked, 1-between)", "does somebody look?")
            with p.when("failed != 0", "a solve failed"):
                p.each("x", "x_last", "back to where the step began")
                p.each("v", "select(looked, v_last, u-0.5*dt*f/m)", "back to where the step began")
                p.let("loose", "1-looked", "was it complete?")
                p.let("behind", "select(looked, behind, 0)", "can it go on as if nobody had looked?")
                p.let("looked", "1", "somebody does")
                p.let("stale", "1", "forces are those of elsewhere")

    def _drift_with(self, u: str, h: str) -> None:
        p = self.program
        for part in self.parts:
            part.remember(p)
        if self.single:
            self.parts[0].land_alone(p, u, h)
            return
        self._land(u, h)
