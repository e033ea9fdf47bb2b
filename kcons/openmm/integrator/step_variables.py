"""The variables by which a step knows where it is: one list for all that write programs.

What begins and ends a step, and what may be left out of it, goes by a few numbers:

- A call of `step(n)` sets `between` to 1 for all steps but the last ones, and back to 0. A step whose end nobody looks
  at ends without the second half of its kick and without a projection; it says so in `behind`, and the next one makes
  up for it. `looked` is 1 where a call begins: then x and v may be others' (`moved`), and `behind` holds only if they
  are not.
- `failed` is set by the part whose solve failed. Nothing moves then until Python has read it and set it back to 0; x
  and v go back to `x_last` and `v_last`, the forces are computed anew (`stale`), and `loose` says whether v had been
  complete.
- `ending` is 1 in the last step of a call, which sums `motion` for `Guard.look`.
- `phase` is other than 0 where virtual sites are placed at the end of an execution of the program only: each execution
  is then the part of a step from one force evaluation to the next, and counts on by itself.
- `first_stage` and `end_stage` are other than 0 and the number of drifts only while constraints are applied outside of
  steps: then the program starts at a drift without kicks, or behind it.

Controls have their value again between any two calls of `step`; see `Program.control`.
"""

from __future__ import annotations

from typing import NamedTuple

from kcons.openmm.integrator.program import Program


class Variable(NamedTuple):
    """What a name in a program stands for."""

    kind: str
    words: str
    value: float = 0.0


VARIABLES = {
    # where a step is
    "phase": Variable("control", "0 for a whole step; else the number of the part of it that is made"),
    "stage": Variable("number", "number of the drift"),
    "stop": Variable("number", "the drift that is left to the next part"),
    "h": Variable("number", "length of the drift"),
    "per_h": Variable("number", "1/h after the drift"),
    "kick": Variable("number", "length of a kick as a fraction of the step, with what the last step left out"),
    "ending": Variable("control", "1 in the last step of a call"),
    "motion": Variable("number", "sum of squares of velocities where a call ended"),
    "first_stage": Variable("control", "0; more to apply the constraints alone, outside of steps"),
    "end_stage": Variable("setting", "where the stages end"),
    "good_steps": Variable("number", "steps done since the integrator was made"),
    # what failed
    "failed": Variable("control", "number of the part whose solve failed, 0 for none"),
    "loose": Variable("number", "1 where v was taken back to a step at whose end nobody looked: it is not tangent"),
    # what was left out, and what is known
    "between": Variable("control", "1 if nobody looks at the velocities after this step"),
    "lean": Variable("control", "1 where v may do without half a kick between steps"),
    "behind": Variable("number", "1 where v (or raw, where a call has ended) lacks what ends a step"),
    "led": Variable("number", "the same when the last drift began"),
    "looked": Variable("number", "1 if somebody may have looked since the last step", 1.0),
    "coarse": Variable("number", "1 in single precision: rounding of x, divided by a time step, is much beside a kick"),
    "moving": Variable("control", "1 where barostats may move x between steps"),
    "moved": Variable("number", "how far others have moved x or v since the last step"),
    "stale": Variable("number", "1 at a fresh start, and when forces must be computed anew", 1.0),
    "dt_last": Variable("number", "length of the last step"),
    # positions, velocities, forces
    "xu": Variable("vector", "positions before constraints act on them"),
    "u": Variable("vector", "velocities of the drift"),
    "raw": Variable("vector", "v at the end of the last call, with half a kick and a projection to come"),
    "x_last": Variable("vector", "positions to come back to"),
    "v_last": Variable("vector", "velocities to come back to"),
    "x_start": Variable("vector", "positions where the drift began"),
    "v_middle": Variable("vector", "velocities after friction and noise, with which x moved last"),
    "v_end": Variable("vector", "v at the end of the step that has this v_middle"),
    "v_next": Variable("vector", "velocities with all of (x-xu)/h"),
    "force": Variable("vector", "applied forces at x, kept where OpenMM would compute them again"),
    "impulse": Variable("vector", "change of v by the constraints in the last drift"),
}


def use(program: Program, *names: str, value: float | None = None) -> str:
    """Declare variables of the list; returns the name of the last.

    Parameters
    ----------
    program : Program
    *names : str
        Keys of `VARIABLES`.
    value : float, optional
        At the beginning; that of the list unless given.
    """
    for name in names:
        kind, words, first = VARIABLES[name]
        if kind == "vector":
            program.vector(name, words)
        else:
            getattr(program, kind)(name, words, first if value is None else value)
    return names[-1]
