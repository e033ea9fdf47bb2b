"""Which method, and which step? Measured on test systems and on the user's own.

- `study`: pages, machines and progress of all studies
- `test_systems`: the test systems
- `methods`: everything that runs them
- `work_precision`: cost against error, and what follows from it
- `averages`: thermostats and the averages they give
"""

from importlib import import_module
from typing import Any

from kcons.errors import with_extra

#: What documents and examples use, by the module that has it; imported when it is asked for.
_MODULES = {
    "averages": ("layers", "long_steps", "long_steps_report", "sampling", "volumes"),
    "test_systems": ("fluid",),
    "study": ("json_files", "scripts"),
    "work_precision": ("answer", "fronts", "measure", "recommendation", "report"),
}
_NAMES = {
    "averages.step_zero": ("extrapolate",),
    "methods.methods": ("METHODS", "CoreStepper"),
    "test_systems": ("Reference", "TestSystem"),
    "test_systems.fluid": ("Fluid",),
    "test_systems.lennard_jones": ("LennardJones",),
    "test_systems.openmm_engine": ("system_of",),
    "test_systems.system": ("ASE_UNITS",),
    "test_systems.potential": ("Potential", "PotentialCalculator"),
    "study.machine": ("environment", "processor_of"),
    "study.study": ("work_off",),
    "work_precision.measurement": ("Comparison", "Measurement"),
}

__all__ = sorted(name for names in (*_MODULES.values(), *_NAMES.values()) for name in names)


def __getattr__(name: str) -> Any:
    try:
        return _found(name)
    except ModuleNotFoundError as error:
        raise with_extra(error, f"{__name__}.{name}") from error


def _found(name: str) -> Any:
    for folder, modules in _MODULES.items():
        if name in modules:
            return import_module(f"{__name__}.{folder}.{name}")
    for module, names in _NAMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
