"""Constant pressure on constraints: cells that change, and what moves along with them.

- `cell_system`: a system whose cell can change
- `pieces`: what moves as one: clusters tied by constraints, molecules, free atoms
- `barostat`: the ways in which a cell may change, trial cells, and the rule by which they are accepted
- `constant_pressure`: a stepper with a barostat
- `measured`: the pressure of a state
"""

from kcons.thermostats.pressure.barostat import Barostat, CellRescaling, MonteCarloBarostat, require_barostat
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.constant_pressure import ConstantPressure
from kcons.thermostats.pressure.measured import constraint_virial, instantaneous_pressure
from kcons.thermostats.pressure.pieces import BarostatBodies, find_pieces

__all__ = [
    "Barostat",
    "BarostatBodies",
    "CellRescaling",
    "CellSystem",
    "ConstantPressure",
    "MonteCarloBarostat",
    "constraint_virial",
    "find_pieces",
    "instantaneous_pressure",
    "require_barostat",
]
