"""kcons holds things fixed in molecular dynamics, exactly and cheaply.

- `errors`: what is raised
- `constraints`: what can be held
- `topology`: what files say of a system
- `solvers`, `plan`: constraint solvers, and which one holds what
- `motion`: the engine
- `steppers`, `thermostats`: dynamics on constraints
- `models`: flows and growth under constraints
- `ase`, `openmm`, `mdanalysis`: MD engines and files, imported by name: ``from kcons.ase import constrain``
- `batched`, `torchsim`: many copies at once on PyTorch, with gradients; TorchSim
- `free_energy`: free energies along held coordinates, and relaxed scans
- `comparison`, `cli`: which method and which step; the command
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kcons import constraints as constraints
    from kcons import errors as errors
    from kcons.constraints.constraint_set import ConstraintSet as ConstraintSet
    from kcons.motion.motion import Motion as Motion
    from kcons.steppers import Rattle as Rattle
    from kcons.steppers import State as State
    from kcons.steppers import System as System
    from kcons.steppers import run as run

__version__ = "0.1.0"

__all__ = ["ConstraintSet", "Motion", "Rattle", "State", "System", "__version__", "constraints", "errors", "run"]

#: What is imported when it is first asked for, and where it is: the command needs none of it to print its help.
_FOLDERS = {"constraints", "errors", "models", "motion", "plan", "solvers", "steppers", "thermostats", "topology"}
_LATE = {
    "ConstraintSet": "kcons.constraints.constraint_set",
    "Motion": "kcons.motion.motion",
    **dict.fromkeys(("Rattle", "State", "System", "run"), "kcons.steppers"),
}


def __getattr__(name: str) -> Any:
    """Of modules: PEP 562."""
    if name in _FOLDERS:
        return import_module(f"{__name__}.{name}")
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(_LATE[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
