"""Steppers: maps from one state on the constraints to the next.

A stepper never changes its input. Where it raises, nothing has happened.

- `state`: where a system is, and what acts on it
- `files`: its files, and folders of results that belong to one run
- `operations`: a time step as data, and as rows of numbers
- `interpreter`: who makes them
- `compiled_operations`: as many as there are in one compiled call
- `packed_system`: what compiled operations know of a system
- `stepper`: what a stepper is, and a check that each step can be taken back
- `splitting`: kicks and drifts in turn, of orders 2, 4 and 6
- `running`: steps one after another
"""

from kcons.steppers import splitting
from kcons.steppers.running import Observer, run
from kcons.steppers.splitting import *
from kcons.steppers.state import State, System
from kcons.steppers.stepper import ReversibilityCheck, Stepper

__all__ = ["Observer", "ReversibilityCheck", "State", "Stepper", "System", "run"]
__all__ += splitting.__all__
