"""kcons holds things fixed in molecular dynamics, exactly and cheaply.

The names here are those of the core; the hosts are imported by name: ``from kcons.ase import constrain``.
"""

from kcons import constraints, errors
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, System, run

__version__ = "0.1.0"

__all__ = ["ConstraintSet", "Motion", "Rattle", "State", "System", "__version__", "constraints", "errors", "run"]
