"""The time of targets that move, where a step that failed does not count; what an integrator knows of it."""

from __future__ import annotations

import openmm

from kcons.errors import InputError
from kcons.openmm.integrator.program import Program


class Clock:
    """Variables and computations for the time of the targets of one part.

    Parameters
    ----------
    code : int
        Of the part; in every name.
    """

    def __init__(self, code: int) -> None:
        self.code = code

    def declare(self, p: Program) -> None:
        c = self.code
        p.number(f"clock{c}", "time of the targets")
        p.number(f"clock_start{c}", "the same at the start of the step")
        p.number(f"clock_end{c}", "the same at its end")
        p.number(f"pending{c}", "whether a step began")
        p.number(f"step_start{c}", "good_steps when it began")

    def now(self, variables: dict[str, float]) -> float:
        """The time between steps."""
        c = self.code
        kept = variables[f"pending{c}"] and variables[f"step_start{c}"] != variables["good_steps"]
        return variables[f"clock_end{c}" if kept else f"clock_start{c}"]

    def set(self, p: Program, time: float) -> None:
        """Let it be this time, between steps."""
        p.write(f"clock_start{self.code}", time)
        p.write(f"pending{self.code}", 0.0)

    def begin(self, p: Program) -> None:
        """At the first drift of a step. A step that failed is not counted in good_steps, and its time is not kept."""
        c = self.code
        p.let(f"held{c}", "delta(stage-first_stage)", "does a step begin?")
        kept = f"held{c}*pending{c}*(1-delta(step_start{c}-good_steps))"
        p.let(f"clock_start{c}", f"select({kept}, clock_end{c}, clock_start{c})", "the step before was kept")
        p.let(f"pending{c}", f"select({kept}, 0, pending{c})", "and is over")
        p.let(f"clock{c}", f"select(held{c}, clock_start{c}, clock{c})", "time of the targets")
        begins = f"held{c}*delta(first_stage)"
        p.let(f"pending{c}", f"select({begins}, 1, pending{c})", "a step begins, and not constraints alone")
        p.let(f"step_start{c}", f"select({begins}, good_steps, step_start{c})", "to see whether it is kept")
        p.let(f"clock_end{c}", f"select({begins}, clock_start{c}+dt, clock_end{c})", "time at its end")

    def drift(self, p: Program, h: str) -> None:
        p.let(f"clock{self.code}", f"clock{self.code}+select(first_stage, 0, {h})", "targets at the end of the drift")


def require_holder(integrator: openmm.CustomIntegrator) -> None:
    """Refuse a Context, a Simulation or whatever else is given for the integrator that holds the rows."""
    if not isinstance(integrator, openmm.CustomIntegrator):
        raise InputError(
            f"integrator is a {type(integrator).__name__}; give the integrator that holds the rows", item="integrator"
        )


def variables_of(integrator: openmm.CustomIntegrator) -> dict[str, float]:
    """All global variables of the integrator by name."""
    require_holder(integrator)
    numbers = range(integrator.getNumGlobalVariables())
    return {integrator.getGlobalVariableName(k): integrator.getGlobalVariable(k) for k in numbers}
