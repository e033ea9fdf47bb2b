"""Steppers: maps from one state on the constraints to the next.

A stepper is a pure function of the state. It never changes its input, and where it raises, nothing
has happened: the state that was passed in is still the last good one.
"""

from kcons.steppers.compositions import Composition, KahanLi6, Suzuki4, Yoshida4
from kcons.steppers.extrapolation import Extrapolation
from kcons.steppers.geodesic import Geodesic
from kcons.steppers.projected_ode import Baumgarte, ProjectedRungeKutta4, ProjectedVerlet
from kcons.steppers.rattle import Rattle
from kcons.steppers.runge_kutta_nystrom import BlanesMoan4, BlanesMoan6, BlanesMoan6a, RungeKuttaNystrom
from kcons.steppers.splitting import Splitting
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Observer, ReversibilityCheck, Stepper, run

__all__ = [
    "Baumgarte",
    "BlanesMoan4",
    "BlanesMoan6",
    "BlanesMoan6a",
    "Composition",
    "Extrapolation",
    "Geodesic",
    "KahanLi6",
    "Observer",
    "ProjectedRungeKutta4",
    "ProjectedVerlet",
    "Rattle",
    "ReversibilityCheck",
    "RungeKuttaNystrom",
    "Splitting",
    "State",
    "Stepper",
    "Suzuki4",
    "System",
    "Yoshida4",
    "run",
]
