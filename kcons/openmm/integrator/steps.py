"""The programs of a step: a function for each kind of step."""

from __future__ import annotations

from collections.abc import Callable

from kcons.openmm.integrator.ensemble import Step, use

# -- kinds of step --------------------------------------------------------------------------------


def write_step(step: Step) -> None:
    """Write the program of a step."""
    p, ensemble = step.program, step.ensemble
    if step.lazy:
        use(p, "between")
    ensemble.declare(p)
    if ensemble.noisy:
        use(p, "v_middle", "v_end")
        # Where others have set v since, it is theirs that counts.
        p.kinetic_energy = "m*u*u/2; u=select(spread*delta(v-v_end), v_middle, v)"
    use(p, "xu")
    if not ensemble.write(step):
        _kind(step)(step)
    use(p, "ending", "motion")
    with p.when("ending != 0", "a call ends"):
        p.sum("motion", "v*v", "are velocities finite?")


def _kind(step: Step) -> Callable[[Step], None]:
    if step.parts:
        return _lean_step if step.lean else _guarded_step
    if step.joined:
        return _joined_step
    return _single_step if step.one_drift else _loop_step


def _single_step(step: Step) -> None:
    """One drift, or two halves with a bath between them, without parts."""
    p, kicks, ensemble = step.program, step.kicks, step.ensemble
    use(p, "phase")
    h = "(0.5*dt)" if step.halves else "dt"
    with p.when("phase != 2", "up to the new positions"):
        p.let_others_act()
        ensemble.open(p)
        if kicks[0]:
            step.kick(_of_dt(kicks[0]), tangent=True)
        if step.halves:
            # The second half absorbs what is across the constraints.
            ensemble.middle(step, f"v+{step.drift(h)}")
        impulse = step.drift(h)
    with p.when("phase != 1", "with the forces there"):
        step.note_middle(f"v+{impulse}")
        if kicks[-1]:
            step.kick(_of_dt(kicks[-1]), impulse)
        else:
            p.each("v", f"v+{impulse}", "the constraint forces act on v as well")
        if not step.ends_tangent:
            step.project()
        step.note_end()
        ensemble.close(p)
    p.let("phase", f"select(phase, select({step.phases}-phase, phase+1, 1), 0)", "what follows")


def _loop_step(step: Step) -> None:
    """Several drifts, without parts."""
    p, n = step.program, len(step.drifts)
    p.table("drift_share", step.drifts, "length of drift k as a fraction of the step")
    p.table("kick_share", step.kicks, "length of the kick before drift k as a fraction of the step")
    use(p, "phase", "stage", "stop", "h")
    p.let("stage", "select(phase, phase-1, 0)", "first drift")
    p.let("stop", f"select(phase, min(phase, {n}), {n})", "where to stop")
    with p.when("stage = 0", "a step begins"):
        p.let_others_act()
        step.ensemble.open(p)
    # One loop over tables: unrolled, or with more blocks, the set-up of OpenMM takes long.
    with p.loop("stage < stop", "all drifts and kicks of the scheme"):
        with p.when("kick_share(stage) != 0", "a kick comes first"):
            step.kick("dt*kick_share(stage)")
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        p.each("v", f"v+{step.drift('h')}", "the constraint forces act on v as well")
        p.let("stage", "stage+1", "what follows")
    with p.when(f"phase*({step.phases}-phase) = 0", "the step ends"):
        if step.kicks[-1]:
            step.kick(_of_dt(step.kicks[-1]))
        if not step.ends_tangent:
            step.project()
        step.ensemble.close(p)
    p.let("phase", f"select(phase, select({step.phases}-phase, phase+1, 1), 0)", "what follows")


def _joined_step(step: Step) -> None:
    """Velocity Verlet without parts, of which two kicks between drifts are made as one where v is not read."""
    p, ensemble = step.program, step.ensemble
    use(p, "behind", "kick", "phase", "x_start", "coarse")
    h = "(0.5*dt)" if step.halves else "dt"
    with p.when("phase != 2", "up to the new positions"):
        p.let_others_act()
        p.let("kick", "0.5+0.5*behind", "with the half kick that is missing")
        u = step.kicked("kick*dt", tangent=True, unseen=True)
        with p.when("coarse != 0", "where a drift leads does not tell v: the impulse alone is read from it"):
            p.each("v", u, "the applied forces act (kick)")
            if step.halves:
                ensemble.middle(step, f"v+{step.drift(h)}")
            else:
                p.each("v", f"v+{step.drift(h)}", "the constraint forces act on v as well")
        with p.when("coarse = 0", "v need not be written: it follows from where the drift leads"):
            p.each("x_start", "x", "where the drift begins")
            p.each("x", f"x+{h}*({u})", "the applied forces act, then move freely (drift)")
            p.hold_positions("back onto the constraints of the System")
            if step.halves:
                ensemble.middle(step, f"(x-x_start)/{h}")
            else:
                p.each("v", f"(x-x_start)/{h}", "as the drift went")
        if step.halves:  # this half absorbs what noise has across the constraints
            p.each("v", f"v+{step.drift(h)}", "the constraint forces act on v as well")
        if ensemble.stays_tangent:
            with p.when("exact+1-between != 0", "kicks need it"):
                step.project()
    with p.when("between+delta(phase-1) = 0", "somebody looks at the velocities"):
        step.note_middle("v")
        step.kick("0.5*dt", tangent=True)
        if not ensemble.stays_tangent:  # otherwise the next drift absorbs what v has across
            step.project()
        step.note_end()
    p.let("behind", "between", "the next step makes up for it")
    p.let("phase", "select(phase, 3-phase, 0)", "what follows")


# -- steps that are taken back when a part fails --------------------------------------------------


def _declare_guards(step: Step) -> None:
    """Variables of steps with parts, and their stages."""
    p = step.program
    use(p, "failed", "good_steps", "stage", "stale", "call", "moved")
    p.table("drift_share", step.drifts, "length of drift k as a fraction of the step")
    p.table("kick_share", step.kicks, "length of the kick before drift k as a fraction of the step")


def _see_who_moved(step: Step) -> None:
    """How far x is from where the last step ended; where a call begins, Python has to look at what others moved."""
    p = step.program
    p.sum("moved", "(x-x_last)^2", "barostats, setPositions and minimizers move x between steps")
    asks = "select(call-1, failed, select(moved, -1, 0))"
    p.let("failed", f"select(failed+stale, failed, {asks})", "a call begins: ask Python to look at x")


def _guarded_step(step: Step) -> None:
    """Any scheme with parts."""
    p = step.program
    divided = step.sited and step.one_drift
    _declare_guards(step)
    use(p, "h", *["per_h"] * step.one_drift, *["phase"] * divided, "x_last", "v_last")
    # Parts evaluate row groups, and OpenMM remembers the forces of the last groups only.
    step.force = use(p, "force")
    for part in step.parts:
        part.lean = False
        part.declare(p)
    if not divided:
        _up_to_forces(step, _with_forces)
        return
    with p.when("phase != 2", "up to the new positions"):
        _up_to_forces(step, lambda _: None)
    with p.when("phase != 1", "with the forces there"):
        _with_forces(step)
    p.let("phase", "select(phase, 3-phase, 0)", "what follows")


def _up_to_forces(step: Step, then: Callable[[Step], None]) -> None:
    p, ensemble = step.program, step.ensemble
    with p.when("failed = 0", "a step, and nothing failed before"):
        p.let_others_act()
    _see_who_moved(step)
    with p.when("failed = 0", "after a failure nothing moves"):
        with p.when("moved+stale != 0", "others did"):
            p.each("x_last", "x", "start here")
        with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
            p.each("force", "f", "applied forces")
        if ensemble.noisy:
            # Reference and CPU draw random numbers with each computation: how steps are divided into calls must not
            # change the noise.
            with p.when("moved+stale+abs(call-2) = 0", "forces are known"):
                p.each("force", "force", "as many random numbers are drawn")
        p.let("call", "select(call, 2, 0)", "forces are known in this call")
        with p.when("moved+stale != 0", "others did"):
            for part in step.parts:
                part.begin(p)
        p.let("stale", "0", "what is kept belongs to x")
        p.each("v_last", "v", "to come back to")
        ensemble.open(p)
        if step.kicks[0]:
            step.kick("dt*kick_share(0)", tangent=True)
        p.let("stage", "0", "first drift")
        if step.halves:
            p.let("h", "dt*drift_share(0)", "length of the first drift")
            ensemble.middle(step, f"v+{step.drift('h')}")
            p.let("stage", "1", "what follows")
        if step.one_drift:
            _only_drift(step)
        else:
            _all_drifts(step)
        then(step)


def _only_drift(step: Step) -> None:
    """One drift needs no loop; set-up takes 15 times as long for each block within a loop."""
    p = step.program
    p.let("per_h", "0", "no drift yet")
    with p.when("failed = 0", "rows are independent"):
        p.let("h", "dt*drift_share(stage)", "length of the drift")
        step.drift("h")
        p.let("per_h", "1/h", "the constraint forces act on v as well, with the kick that follows")
        p.let("stage", "stage+1", "what follows")


def _all_drifts(step: Step) -> None:
    p = step.program
    with p.loop(f"stage < {len(step.drifts)}*step(0.5-failed)", "all drifts and kicks of the scheme"):
        p.let("h", "dt*drift_share(stage)", "length of this drift")
        if step.single:
            # From (x-xu)/h, the shortest of many drifts would have most of the digits of v.
            step.parts[0].land_alone(p, "v", "h")
        else:
            p.each("v", f"v+{step.drift('h')}", "the constraint forces act on v as well")
        p.let("stage", "stage+1", "what follows")
        # Without the block set-up is faster, but forces are then computed after a failure as well.
        if all(step.kicks[1:]) and all(part.stays_finite for part in step.parts):
            _kick_after(step)
        else:
            with p.when("kick_share(stage)*step(0.5-failed) != 0", "a kick follows"):
                _kick_after(step)


def _kick_after(step: Step, impulse: str = "") -> None:
    """The kick that follows drift `stage`, with the forces at x."""
    step.program.each("force", "f", "applied forces")
    step.kick("dt*kick_share(stage)", impulse)


def _with_forces(step: Step) -> None:
    p = step.program
    with p.when("failed = 0", "all solves converged"):
        if step.one_drift:
            step.note_middle("v+per_h*(x-xu)")
            _kick_after(step, "per_h*(x-xu)")
        if not step.ends_tangent:
            step.project()
        step.note_end()
        step.ensemble.close(p)
        p.let("good_steps", "good_steps+delta(failed)", "count it")
        p.each("x_last", "select(failed, x_last, x)", "where forces were computed")
    with p.when("failed > 0", "a solve failed"):
        p.each("x", "x_last", "back to where the step began")
        p.each("v", "v_last", "back to where the step began")
        step.ensemble.take_back(p)
        p.let("stale", "1", "what is kept belongs to elsewhere")


def _lean_step(step: Step) -> None:
    """Velocity Verlet with parts.

    Between two steps of one call velocities are not read. The second half kick of a step and the first of the next are
    then one, and the velocities are not made tangent: the next drift starts where they would be, pushes along the same
    gradients, and absorbs what they have across. The motion is the same; see notes on RATTLE and leapfrog.
    """
    p = step.program
    _declare_guards(step)
    use(p, "h", "per_h", "x_last", "v_last", "u", "force", "moving", "looked", "behind", "loose")
    for part in step.parts:
        part.lean = True
        part.declare(p)
    with p.when("select(failed, 0, looked) != 0", "x and v may have been changed"):
        p.each("v_last", "v", "to come back to")
        p.let_others_act()
        _see_who_moved(step)
    with p.when("failed = 0", "after a failure nothing moves"):
        with p.when("looked != 0", "x and v may have been changed"):
            with p.when("moved+stale+abs(call-2) != 0", "others did, or a call begins"):
                p.each("force", "f", "applied forces")
            p.let("call", "select(call, 2, 0)", "forces are known in this call")
            with p.when("moved+stale != 0", "others did"):
                p.each("x_last", "x", "start here")
                across = any(part.meets_system for part in step.parts)
                if across:
                    p.each("u", "v", "v is needed to project the rows")
                for part in step.parts:
                    part.begin(p)
                if across:
                    p.each("v", "u", "v again")
            p.each("u", "v+kick_share(0)*dt*force/m", "the applied forces act (kick)")
        with p.when("looked = 0", "in the middle of many steps"):
            p.let_others_act()
            p.each("x_last", "x", "to come back to")
            p.each("u", "v+dt*f/m", "the applied forces act (both half kicks)")
            for part in step.parts:
                part.renew(p)
        p.let("stale", "0", "what is kept belongs to x")
        p.let("stage", "0", "the drift")
        p.let("per_h", "0", "no drift yet")
        with p.when("failed = 0", "rows are independent"):
            p.let("h", "dt*drift_share(stage)", "length of the drift")
            if step.single:
                step.parts[0].land_alone(p, "u", "h")
            else:
                for part in step.parts:
                    part.remember(p)
                step.land("u", "h")
            p.let("per_h", "1/h", "the constraint forces act on v as well")
            p.let("stage", "stage+1", "what follows")
        with p.when("select(failed, 0, 1-between) != 0", "somebody looks at the velocities"):
            landed = "v" if step.single else "u+per_h*(x-xu)"
            p.each("force", "f", "applied forces")
            p.each("v", f"{landed}+dt*kick_share(stage)*force/m", "constraint forces act, then the applied ones (kick)")
            step.project()
            p.each("x_last", "select(failed, x_last, x)", "where the step ended")
        with p.when("select(failed, 0, between) != 0", "nobody looks"):
            if not step.single:
                p.each("v", "u+per_h*(x-xu)", "the constraint forces act on v as well")
            for part in step.parts:
                part.passed(p)
        # Without blocks: the set-up of OpenMM goes along each way through them.
        p.let("good_steps", "good_steps+delta(failed)", "count it if all solves converged")
        with p.when("failed != 0", "a solve failed"):
            p.each("x", "x_last", "back to where the step began")
            p.each("v", "select(looked, v_last, u-0.5*dt*f/m)", "back to where the step began")
            p.let("loose", "1-looked", "was it complete?")
            p.let("stale", "1", "what is kept belongs to elsewhere")
        p.let("looked", "select(failed, 1, 1-between)", "does somebody look?")
        p.let("behind", "1-looked", "v lacks half a kick")


def _of_dt(share: float) -> str:
    return "dt" if share == 1 else f"{share!r}*dt"
