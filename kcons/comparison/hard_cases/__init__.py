"""Hard cases: what kcons, ASE and OpenMM do where constraints are difficult.

A case is a function with `case` as its decorator, as in `examples/13_hard_cases.py`.

- `case`, `problem`, `truths`: a case, its problem, and what is right
- `contract`, `programs`, `worker`: the programs side by side
- `motions`, `bodies`, `rings`, `chains`: difficult molecules
- `starts`, `steps`, `inputs`: difficult starts, steps and input
- `invariance`, `long_runs`, `thermostats`, `growth_models`: what must not matter; long runs; other models
- `study`, `report`: all cases, and their table
"""

from kcons.comparison.hard_cases.case import OURS, SYSTEMS, Case, Cell, Outcome, all_cases, case, judge, outcome
from kcons.comparison.hard_cases.contract import CannotExpressError, Program
from kcons.comparison.hard_cases.problem import Problem
from kcons.comparison.hard_cases.programs import PROGRAMS
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
