"""Thermostats on constraints. Each is a stepper.

- `freedom`: which degrees of freedom a thermostat acts on, what rows tie together, velocities drawn on the constraints
- `noise`: random numbers of a seed and a step, also in kernels
- `force_groups`: several time steps
- `langevin`, `nose_hoover`, `isokinetic`: the thermostats
- `spheres`, `sphere_kernels`: stochastic isokinetic baths
- `cells`, `barostats`: constant pressure beside them
- `monte_carlo`: without any error of the time step
- `correlated_series`: errors of means and of slopes along a run
- `configurational_temperature`: the temperature of configurations, and the stiffness that slow forces carry
"""

from kcons.thermostats.barostats import Barostat, CellRescaling, ConstantPressure, MonteCarloBarostat
from kcons.thermostats.cells import CellSystem, find_pieces, instantaneous_pressure
from kcons.thermostats.configurational_temperature import SplitTemperatures, TemperatureSplit, slow_share
from kcons.thermostats.correlated_series import Estimate, mean
from kcons.thermostats.force_groups import ForceGroups
from kcons.thermostats.freedom import Freedom, freedom, thermal_velocities
from kcons.thermostats.isokinetic import Isokinetic
from kcons.thermostats.langevin import Langevin, LangevinRespa
from kcons.thermostats.monte_carlo import Counts, HamiltonianMonteCarlo, Tuned, exchange, tune
from kcons.thermostats.nose_hoover import NoseHooverChain
from kcons.thermostats.spheres import IsokineticSpheres

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
    "exchange",
    "find_pieces",
    "freedom",
    "instantaneous_pressure",
    "mean",
    "slow_share",
    "thermal_velocities",
    "tune",
]
