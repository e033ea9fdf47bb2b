"""Built-in test systems with known solutions, small or at size N; each module registers its own.

- `system`, `registry`: the contract, and how one is registered
- `potential`, `openmm_engine`: forces, and OpenMM's
- `minimal`: solutions in minimal coordinates
- `sphere`, `pendulums`, `rotor`, `dumbbells`: particles, pendulums and bodies
- `butane`, `chain`, `ethanol`, `slab`, `water`: molecules
- `files`: structures that come with the package, and any file
"""

from importlib import import_module
from pkgutil import iter_modules

from kcons.comparison.test_systems.files import from_file, is_file, plan
from kcons.comparison.test_systems.registry import SYSTEMS, add_system, build
from kcons.comparison.test_systems.system import Reference, TestSystem, Units

__all__ = ["SYSTEMS", "Reference", "TestSystem", "Units", "add_system", "build", "from_file", "is_file", "plan"]

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
