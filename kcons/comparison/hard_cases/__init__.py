"""Hard cases: what kcons, ASE and OpenMM do where constraints are difficult.

Cases are functions in the modules named in `case.THEMES`; `run` takes them through all programs, `pages` shows what
came of it. A person's own case is one more function::

    from kcons.comparison.hard_cases import Problem, case, outcome

    @case("Y01", "Two dumbbells", "residual 1e-10")
    def dumbbells(program, quick):
        problem = Problem(positions, masses, pairs=[(0, 1), (2, 3)], velocities=velocities)
        end = program.run(problem, dt=0.01, steps=100)
        return outcome(("residual", problem.residual(end.x), 1e-10))
"""

from kcons.comparison.hard_cases.case import (
    OURS,
    SYSTEMS,
    CannotExpressError,
    Case,
    Cell,
    Outcome,
    all_cases,
    case,
    judge,
    outcome,
)
from kcons.comparison.hard_cases.problem import Problem
from kcons.comparison.hard_cases.programs import PROGRAMS, Program
from kcons.comparison.hard_cases.study import chosen, load, run
from kcons.comparison.hard_cases.worker import run_cell

__all__ = [
    "OURS",
    "PROGRAMS",
    "SYSTEMS",
    "CannotExpressError",
    "Case",
    "Cell",
    "Outcome",
    "Problem",
    "Program",
    "all_cases",
    "case",
    "chosen",
    "judge",
    "load",
    "outcome",
    "run",
    "run_cell",
]
