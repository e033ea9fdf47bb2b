"""The program of a step for particles on surfaces: fewer computations, and velocities from multipliers.

A particle on a surface is a problem of its own, so that the landing is known before anything moves: with the impulse
that it takes, v changes first and x += h v ends on the surface. No velocity is a difference of positions, whose
rounding grows as 1/h.
"""

from __future__ import annotations

from kcons.openmm.integrator.ensemble import ConstantEnergy
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.step_variables import use
from kcons.openmm.surfaces.closed_forms import QuadricRows
from kcons.openmm.surfaces.surface_rows import SurfaceRows
from kcons.steppers.rattle import Rattle


class SurfaceStepWriter(LeanStepWriter):
    """One step where all parts are surfaces; anything else is written as for other parts.

    Attributes
    ----------
    bonded : bool
        Whether the System may have constraints of its own.
    lazy : bool
        Whether the program can leave out the projection of velocities: only who looks needs it.
    """

    bonded = True
    lazy = False

    def write(self) -> None:
        fused = self.scheme is not None and type(self.ensemble) is ConstantEnergy
        if not fused or not all(isinstance(part, SurfaceRows) for part in self.parts):
            super().write()
            return
        p = self.program
        self.lazy, self.lean = True, False
        self.surfaces = [part for part in self.parts if isinstance(part, SurfaceRows)]
        self.bonded = any(part.bonded for part in self.surfaces)
        circles = self._circles()
        if circles is not None and self.scheme is not None:
            circles.circles = True
            self.drifts, self.kicks = _without_flight(self.drifts, self.kicks, len(self.scheme.flight))
            self.alone = len(self.drifts) + 1
        self.circles = circles
        self.force = use(p, "force") if self.kept else "f"
        #: x and v stay as they are until the only landing of the step is known: nothing to come back to.
        self.untouched = isinstance(self.scheme, Rattle) and not self.kept and circles is None
        self._declare_run()
        if self.bonded:
            use(p, "xu")
        for part in self.surfaces:
            part.declare(p)
        self._write_surfaces()

    def _circles(self) -> QuadricRows | None:
        """The spheres, if drifts can follow great circles."""
        part = self.parts[0]
        exact = self.scheme is not None and self.scheme.exact_flight and not self.bonded
        if exact and len(self.parts) == 1 and isinstance(part, QuadricRows) and part.spheres:
            return part
        return None

    # Blocks are few: OpenMM follows every way through them when a Context is made.

    def _declare_run(self) -> None:
        p, n = self.program, len(self.drifts)
        use(p, "failed", "good_steps", "first_stage")
        use(p, "end_stage", value=n)
        use(p, "stage", "between", "stale")
        p.table("kick_share", [*self.kicks, 0.0, 0.0], "length of the kick before drift k as a fraction of the step")
        if self.untouched:
            use(p, "behind", "kick")
            if any(part.moves for part in self.surfaces):
                use(p, "u")
            return
        use(p, "h")
        p.table("drift_share", [*self.drifts, 0.0, 1.0], "length of drift k as a fraction of the step")
        use(p, "x_last", "v_last")
        if self.kept:
            use(p, "moved")

    def _write_surfaces(self) -> None:
        """As for other parts: `first_stage` makes the program bring positions, or velocities alone, onto surfaces."""
        p = self.program
        with p.when("first_stage+failed = 0", "a step, and nothing failed before"):
            p.let_others_act()
        with p.when("failed = 0", "after a failure nothing moves"):
            if self.kept:
                p.sum("moved", "(x-x_last)^2", "barostats and setPositions move x between steps")
                with p.when("moved+stale != 0", "others did"):
                    p.each("force", "f", "applied forces")
            p.let("stale", "0", "forces belong to x")
            if self.untouched:
                self._write_one_drift()
            else:
                p.each("x_last", "x", "to come back to")
                p.each("v_last", "v", "to come back to")
                self._write_drifts()
                with p.when("failed != 0", "a solve failed"):
                    p.each("x", "x_last", "back to where the step began")
                    p.each("v", "v_last", "back to where the step began")
                    p.let("stale", "1", "forces are those of elsewhere")
            p.let("good_steps", "good_steps+select(failed, 0, 1)", "count good steps")
            with p.when("select(failed, 0, between) = 0", "somebody looks at the velocities"):
                # Otherwise the next drift absorbs what they have across the surfaces.
                if self.untouched:
                    p.let("kick", "select(failed, 0.5*behind, kick_share(stage))", "what they lack")
                    p.each("v", "select(kick, v+kick*dt*f/m, v)", "the rest of the kick")
                self._project()
            if self.untouched:
                p.let("behind", "select(failed, 0, between)", "the next step makes up for it")
            if self.kept:
                p.each("x_last", "x", "where forces were computed")

    def _write_one_drift(self) -> None:
        p = self.program
        p.let("stage", "first_stage", "the drift, or constraints alone")
        with p.when("stage < end_stage", "a drift"):
            p.let("kick", "select(behind, 1, kick_share(first_stage))", "with the half kick that is missing")
            u = "v+kick*dt*f/m"  # x and v stay until the landing is known
            if any(part.moves for part in self.surfaces):
                p.each("u", u, "kick")
                u = "u"
            self._fly(u if u == "u" else f"({u})", "dt")
            p.let("stage", "stage+1", "what follows")

    def _write_drifts(self) -> None:
        p = self.program
        if self.kicks[0]:
            p.each("v", f"v+dt*kick_share(first_stage)*{self.force}/m", "kick")
        p.let("stage", "first_stage", "first drift")
        with p.loop("stage < end_stage*step(0.5-failed)", "all drifts and kicks of the scheme"):
            p.let("h", "dt*drift_share(stage)", "length of this drift")
            if self.circles is not None:
                self.circles.circle(p, "h")
            else:
                self._fly("v", "h")
            p.let("stage", "stage+1", "what follows")
            with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
                if self.kept:
                    p.each("force", "f", "applied forces")
                p.each("v", f"v+dt*kick_share(stage)*{self.force}/m", "kick")

    def _fly(self, u: str, h: str) -> None:
        """From x with velocity `u` along the surfaces; where there is no landing, x and v stay."""
        p = self.program
        if len(self.surfaces) == 1:
            self.surfaces[0].fly_alone(p, u, h)
        else:
            for part in self.surfaces:
                part.fly(p, u, h)
            impulses = "".join(f"+{part.impulse(h)}" for part in self.surfaces)
            p.each("v", f"select(failed, v, {u}{impulses})", "impulse of the surfaces")
            p.each("x", f"select(failed, x, x+{h}*v)", "fly onto the surfaces")
        self._hold_bonds(h)

    def _hold_bonds(self, h: str) -> None:
        p = self.program
        if self.bonded:
            p.each("xu", "x", "before the constraints of the System act")
            p.hold_positions("onto the constraints of the System")
            p.each("v", f"v+(x-xu)/{h}", "impulse of the constraints")


def _without_flight(drifts: list[float], kicks: list[float], pieces: int) -> tuple[list[float], list[float]]:
    """Stages with each drift in one piece."""
    whole = [sum(drifts[k : k + pieces]) for k in range(0, len(drifts), pieces)]
    return whole, kicks[::pieces]
