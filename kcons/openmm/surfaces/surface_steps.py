"""The step of particles on surfaces: fewer computations, and velocities from multipliers.

A particle on a surface is a problem of its own, so that the landing is known before anything moves: with the impulse
that it takes, v changes first and x += h v ends on the surface. No velocity is a difference of positions, whose
rounding grows as 1/h.
"""

from __future__ import annotations

from kcons.openmm.integrator.ensemble import ConstantEnergy, Step, use
from kcons.openmm.integrator.steps import see_who_moved
from kcons.openmm.surfaces.closed_forms import QuadricRows
from kcons.openmm.surfaces.surface_rows import SurfaceRows
from kcons.steppers.splitting import Rattle


def surface_step(step: Step) -> bool:
    """Write a step at constant energy where all parts are surfaces; False, and nothing, for others.

    Within a call the program leaves out the projection of velocities: only who looks needs it.
    """
    surfaces = [part for part in step.parts if isinstance(part, SurfaceRows)]
    constant = step.scheme is not None and type(step.ensemble) is ConstantEnergy
    if not constant or len(surfaces) < len(step.parts):
        return False
    p = step.program
    step.lean, step.lazy, step.observed = False, True, 1
    step.kept = any(part.evaluates for part in surfaces)
    bonded = any(part.bonded for part in surfaces)
    circles = _circles(step, bonded)
    if circles is not None and step.scheme is not None:
        circles.circles = True
        step.drifts, step.kicks = _without_flight(step.drifts, step.kicks, len(step.scheme.flight))
    # x and v stay as they are until the only landing of the step is known: nothing to come back to.
    untouched = isinstance(step.scheme, Rattle) and not step.kept and circles is None
    use(p, "between")
    use(p, "failed", "good_steps", "stale", *["call", "moved"] * step.kept, *["xu"] * bonded)
    if untouched:
        use(p, "behind", "kick")
    else:
        use(p, "stage", "h", "x_last", "v_last")
        p.table("drift_share", step.drifts, "length of drift k as a fraction of the step")
        p.table("kick_share", step.kicks, "length of the kick before drift k as a fraction of the step")
    if step.kept:
        step.force = use(p, "force")
    for part in surfaces:
        part.declare(p)
    # Blocks are few: OpenMM follows every way through them when a Context is made.
    with p.when("failed = 0", "nothing failed before"):
        p.let_others_act()
    if step.kept:
        see_who_moved(step)
    with p.when("failed = 0", "after a failure nothing moves"):
        if step.kept:
            with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
                p.each("force", "f", "applied forces")
            p.let("call", "select(call, 2, 0)", "forces are known in this call")
        p.let("stale", "0", "what is kept belongs to x")
        if untouched:
            _one_drift(step, surfaces, bonded)
        else:
            p.each("x_last", "x", "to come back to")
            p.each("v_last", "v", "to come back to")
            _drifts(step, surfaces, bonded, circles)
            with p.when("failed != 0", "a solve failed"):
                p.each("x", "x_last", "back to where the step began")
                p.each("v", "v_last", "back to where the step began")
                p.let("stale", "1", "what is kept belongs to elsewhere")
        p.let("good_steps", "good_steps+select(failed, 0, 1)", "count good steps")
        with p.when("select(failed, 0, between) = 0", "somebody looks at the velocities"):
            # Otherwise the next drift absorbs what they have across the surfaces.
            if untouched:
                p.let("kick", "select(failed, 0.5*behind, 0.5)", "what they lack")
                p.each("v", "select(kick, v+kick*dt*f/m, v)", "the rest of the kick")
            step.project()
        if untouched:
            p.let("behind", "select(failed, 0, between)", "the next step makes up for it")
        if step.kept:
            p.each("x_last", "x", "where forces were computed")
    return True


def _circles(step: Step, bonded: bool) -> QuadricRows | None:
    """The spheres, if drifts can follow great circles."""
    part = step.parts[0]
    exact = step.scheme is not None and step.scheme.exact_flight and not bonded
    if exact and len(step.parts) == 1 and isinstance(part, QuadricRows) and part.spheres:
        return part
    return None


def _one_drift(step: Step, surfaces: list[SurfaceRows], bonded: bool) -> None:
    p = step.program
    p.let("kick", "0.5+0.5*behind", "with the half kick that is missing")
    u = "v+kick*dt*f/m"  # x and v stay until the landing is known
    if any(part.moves for part in surfaces):
        p.each(use(p, "u"), u, "kick")
        u = "u"
    _fly(step, surfaces, bonded, u if u == "u" else f"({u})", "dt")


def _drifts(step: Step, surfaces: list[SurfaceRows], bonded: bool, circles: QuadricRows | None) -> None:
    p = step.program
    if step.kicks[0]:
        p.each("v", f"v+dt*kick_share(0)*{step.force}/m", "kick")
    p.let("stage", "0", "first drift")
    with p.loop(f"stage < {len(step.drifts)}*step(0.5-failed)", "all drifts and kicks of the scheme"):
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        if circles is not None:
            circles.circle(p, "h")
        else:
            _fly(step, surfaces, bonded, "v", "h")
        p.let("stage", "stage+1", "what follows")
        with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
            if step.kept:
                p.each("force", "f", "applied forces")
            p.each("v", f"v+dt*kick_share(stage)*{step.force}/m", "kick")


def _fly(step: Step, surfaces: list[SurfaceRows], bonded: bool, u: str, h: str) -> None:
    """From x with velocity `u` along the surfaces; where there is no landing, x and v stay."""
    p = step.program
    if len(surfaces) == 1:
        surfaces[0].fly_alone(p, u, h)
    else:
        for part in surfaces:
            part.fly(p, u, h)
        impulses = "".join(f"+{part.impulse(h)}" for part in surfaces)
        p.each("v", f"select(failed, v, {u}{impulses})", "impulse of the surfaces")
        p.each("x", f"select(failed, x, x+{h}*v)", "fly onto the surfaces")
    if bonded:
        p.each("xu", "x", "before the constraints of the System act")
        p.hold_positions("onto the constraints of the System")
        p.each("v", f"v+(x-xu)/{h}", "impulse of the constraints")


def _without_flight(drifts: list[float], kicks: list[float], pieces: int) -> tuple[list[float], list[float]]:
    """Stages with each drift in one piece."""
    whole = [sum(drifts[k : k + pieces]) for k in range(0, len(drifts), pieces)]
    return whole, kicks[::pieces]
