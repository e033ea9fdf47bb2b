"""kcons holds things fixed in molecular dynamics, exactly and cheaply.

- `errors`: what is raised
- `constraints`, `projection`: what can be held; the theory, dense and literal
- `topology`: what files say of a system
- `solvers`, `plan`: constraint solvers, and which one holds what
- `motion`: the engine
- `steppers`, `thermostats`: dynamics on constraints
- `models`: flows and growth under constraints
- `ase`, `openmm`, `mdanalysis`: MD engines and files, imported by name: ``from kcons.ase import constrain``
- `comparison`, `cli`: which method and which step; the command
"""

from kcons import constraints, errors
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, System, run

__version__ = "0.1.0"

__all__ = ["ConstraintSet", "Motion", "Rattle", "State", "System", "__version__", "constraints", "errors", "run"]
