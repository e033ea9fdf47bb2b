"""Constraints on ASE `Atoms`: one object that owns everything that is held.

ASE applies constraint objects one after another, so that two objects on the same atoms undo each other's
work. `Constraints` therefore holds the whole set and solves it as one. Units are ASE's (Angstrom, eV,
amu); targets are in Angstrom and radian.

Importing this package registers the object with ASE, which makes files that contain it readable.
"""

from kcons.ase.calculator import ConstrainedCalculator
from kcons.ase.constraint import Constraints, constrain
from kcons.ase.dynamics import ConstrainedDynamics
from kcons.ase.thermostats import ConstrainedLangevin, ConstrainedNoseHoover, IsokineticDynamics, draw_velocities
from kcons.ase.topology import constraints_of, mend_elements
from kcons.ase.translation import from_ase_constraints
from kcons.ase.water import rigid_water

__all__ = [
    "ConstrainedCalculator",
    "ConstrainedDynamics",
    "ConstrainedLangevin",
    "ConstrainedNoseHoover",
    "Constraints",
    "IsokineticDynamics",
    "constrain",
    "constraints_of",
    "draw_velocities",
    "from_ase_constraints",
    "mend_elements",
    "rigid_water",
]
