"""Thermostats on constraints. Each is a stepper.

- `freedom`: which degrees of freedom a thermostat acts on
- `thermal_velocities`: velocities drawn on the constraints
- `langevin`, `nose_hoover`, `isokinetic`: the thermostats
- `pressure`: barostats beside them
- `configurational_temperature`: the temperature of configurations
"""

from kcons.thermostats.configurational_temperature import (
    Estimate,
    configurational_sample,
    configurational_temperature,
    mean,
)
from kcons.thermostats.freedom import Freedom, freedom
from kcons.thermostats.isokinetic.isokinetic import Isokinetic
from kcons.thermostats.langevin import Langevin
from kcons.thermostats.nose_hoover import NoseHooverChain
from kcons.thermostats.thermal_velocities import thermal_velocities

__all__ = [
    "Estimate",
    "Freedom",
    "Isokinetic",
    "Langevin",
    "NoseHooverChain",
    "configurational_sample",
    "configurational_temperature",
    "freedom",
    "mean",
    "thermal_velocities",
]
