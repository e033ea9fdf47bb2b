"""Steppers: maps from one state on the constraints to the next.

A stepper never changes its input. Where it raises, nothing has happened.

- `state`: where a system is, and what acts on it
- `files`: its files, and folders of results that belong to one run
- `operations`: a time step as data
- `program`, `interpreter`: operations as rows of numbers, and who makes them
- `stages`: what steps are made of
- `stepper`: what a stepper is
- `splitting`: kicks and drifts in turn, of orders 2, 4 and 6
- `running`, `reversibility_check`: steps one after another, and taken back
"""

from kcons.steppers.reversibility_check import ReversibilityCheck
from kcons.steppers.running import Observer, Trajectory, run
from kcons.steppers.splitting import (
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoan6a,
    Composition,
    Geodesic,
    KahanLi6,
    Rattle,
    RungeKuttaNystrom,
    Splitting,
    Suzuki4,
    Yoshida4,
)
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper

__all__ = [
    "BlanesMoan4",
    "BlanesMoan6",
    "BlanesMoan6a",
    "Composition",
    "Geodesic",
    "KahanLi6",
    "Observer",
    "Rattle",
    "ReversibilityCheck",
    "RungeKuttaNystrom",
    "Splitting",
    "State",
    "Stepper",
    "Suzuki4",
    "System",
    "Trajectory",
    "Yoshida4",
    "run",
]
