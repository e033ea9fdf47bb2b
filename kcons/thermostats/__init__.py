"""Thermostats on constraints. Each is a stepper.

- `freedom`: which degrees of freedom a thermostat acts on, and what rows tie together
- `thermal_velocities`: velocities drawn on the constraints
- `langevin`, `nose_hoover`, `isokinetic`: the thermostats
- `noise`: normal numbers drawn in kernels
- `pressure`: barostats beside them
- `monte_carlo`: without any error of the time step
- `multistep`: several time steps, and isokinetic spheres
- `correlated_series`: errors of means and of slopes along a run
- `configurational_temperature`: the temperature of configurations, whole and by kind of motion
- `slow_share`: the stiffness that slow forces carry
"""

from kcons.thermostats.configurational_temperature import SplitTemperatures, TemperatureSplit
from kcons.thermostats.correlated_series import Estimate, mean
from kcons.thermostats.freedom import Freedom, freedom
from kcons.thermostats.isokinetic.isokinetic import Isokinetic
from kcons.thermostats.langevin import Langevin
from kcons.thermostats.monte_carlo import Counts, HamiltonianMonteCarlo, Tuned, best_acceptance, exchange, tune
from kcons.thermostats.multistep import (
    ForceGroups,
    IsokineticSpheres,
    LangevinRespa,
)
from kcons.thermostats.nose_hoover import NoseHooverChain
from kcons.thermostats.pressure import (
    Barostat,
    CellRescaling,
    CellSystem,
    ConstantPressure,
    MonteCarloBarostat,
    find_pieces,
    instantaneous_pressure,
)
from kcons.thermostats.slow_share import slow_share
from kcons.thermostats.thermal_velocities import thermal_velocities

__all__ = [
    "Barostat",
    "CellRescaling",
    "CellSystem",
    "ConstantPressure",
    "Counts",
    "Estimate",
    "ForceGroups",
    "Freedom",
    "HamiltonianMonteCarlo",
    "Isokinetic",
    "IsokineticSpheres",
    "Langevin",
    "LangevinRespa",
    "MonteCarloBarostat",
    "NoseHooverChain",
    "SplitTemperatures",
    "TemperatureSplit",
    "Tuned",
    "best_acceptance",
    "exchange",
    "find_pieces",
    "freedom",
    "instantaneous_pressure",
    "mean",
    "slow_share",
    "thermal_velocities",
    "tune",
]
