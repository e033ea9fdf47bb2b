"""Constant pressure on constraints: cells that change, and what moves along with them.

- `cell_system`: a system whose cell can change
- `pieces`: what moves as one: clusters tied by constraints, molecules, free atoms
- `centre_moves`: pieces moved by their centres, compiled
- `strains`: the ways in which a cell may change
- `barostat`: trial cells, and the rule by which they are accepted
- `monte_carlo_barostat`, `cell_rescaling`: where trial cells come from
- `constant_pressure`: a stepper with a barostat
- `measured`: the pressure of a state
"""

from kcons.thermostats.pressure.barostat import Barostat, require_barostat
from kcons.thermostats.pressure.cell_rescaling import CellRescaling
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.constant_pressure import ConstantPressure
from kcons.thermostats.pressure.measured import PressureObserver, constraint_virial, instantaneous_pressure
from kcons.thermostats.pressure.monte_carlo_barostat import MonteCarloBarostat
from kcons.thermostats.pressure.pieces import Pieces, find_pieces

__all__ = [
    "Barostat",
    "CellRescaling",
    "CellSystem",
    "ConstantPressure",
    "MonteCarloBarostat",
    "Pieces",
    "PressureObserver",
    "constraint_virial",
    "find_pieces",
    "instantaneous_pressure",
    "require_barostat",
]
