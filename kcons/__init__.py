"""kcons holds things fixed in molecular dynamics, exactly and cheaply.

- `errors`: what is raised
- `constraints`: what can be held
- `topology`: what files say of a system
- `solvers`, `plan`: constraint solvers, and which one holds what
- `motion`: the engine
- `steppers`, `thermostats`: dynamics on constraints
- `models`: flows and growth under constraints
- `ase`, `openmm`, `mdanalysis`: MD engines and files, imported by name: ``from kcons.ase import constrain``
- `free_energy`: free energies along held coordinates, and relaxed scans
- `comparison`, `cli`: which method and which step; the command
"""

import sys
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
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


#: Where modules are that scripts may still import by the names they had at the top of the package.
MOVED = {
    "compare": "comparison.work_precision.measure",
    "constraint_set": "constraints.constraint_set",
    "flows": "models.flows",
    "fronts": "comparison.work_precision.fronts",
    "growth": "models.growth",
    "hard_cases": "comparison.hard_cases",
    "projection": "constraints.projection",
    "recommendation": "comparison.work_precision.recommendation",
    "report": "comparison.work_precision.report",
    "sampling": "comparison.averages.sampling",
    "scenes": "comparison.test_systems",
    "stability": "comparison.stability",
}


class _Moved(MetaPathFinder, Loader):
    """Gives the modules of `MOVED`, and what is in them, under both names."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        package, _, inside = name.partition(".")
        if package != __name__ or inside.partition(".")[0] not in MOVED:
            return None
        return ModuleSpec(name, self)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        first, dot, rest = spec.name.partition(".")[2].partition(".")
        module = import_module(f"{__name__}.{MOVED[first]}{dot}{rest}")
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        spec = module.__spec__
        if spec is not None and spec.loader is self:
            module.__spec__ = spec.loader_state  # one module, that of its new name


# Before the finder of files, which would load what lies in a moved folder a second time.
sys.meta_path.insert(0, _Moved())
