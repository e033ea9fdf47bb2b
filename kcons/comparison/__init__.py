"""Which method, and which step? Measured on test systems and on the user's own.

- `machine`, `progress`: where something was measured, and how far it is
- `test_systems`: the test systems
- `projected_equation`: the equation of motion without multipliers, to be compared with
- `runs`, `methods`: everything that runs them
- `measure`: a test system through methods, a row a method and setting
- `ranking`, `report`: what follows from the table, and what is shown of it
- `averages`: a test system through thermostats and long steps, a row a run
- `production`: which step is right for averages
- `trajectory_temperatures`: temperatures of configurations along a trajectory of any engine
"""

from kcons.errors import imported_late

#: Names by the module that has them; imported when they are asked for.
_NAMES = {
    "averages": ("AVERAGES", "SAMPLERS", "add_sampler", "compare_averages"),
    "machine": ("environment", "processor_of"),
    "measure": ("COLUMNS", "compare"),
    "methods": ("METHODS", "Method", "add_method", "code"),
    "ranking": ("Ranking", "find_steps", "observed_orders", "rank"),
    "report": ("figure", "read_csv", "text", "write_csv"),
    "runs": ("Run",),
    "test_systems": ("Reference", "TestSystem", "add_system"),
    "test_systems.openmm_engine": ("system_of",),
    "test_systems.potential": ("Potential", "PotentialCalculator"),
    "test_systems.system": ("ASE_UNITS",),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)
__getattr__ = imported_late(__name__, _NAMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
