"""Built-in test systems with known solutions, small or at size N; each module registers its own.

- `system`, `registry`: the contract, and how one is registered
- `potential`, `openmm_engine`: forces, and OpenMM's
- `minimal`: solutions in minimal coordinates
- `sphere`, `pendulums`, `rotor`, `dumbbells`: particles, pendulums and bodies
- `butane`, `chain`, `ethanol`, `slab`, `water`: molecules
- `structure`, `any_file`: PDB files, any file
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from kcons.comparison.test_systems.registry import SYSTEMS, add_system, build
from kcons.comparison.test_systems.system import Reference, TestSystem, Units
from kcons.constraints.arguments import Rng, seed_from

__all__ = [
    "SYSTEMS",
    "Reference",
    "TestSystem",
    "Units",
    "add_system",
    "build",
    "by_mdanalysis",
    "from_file",
    "is_file",
    "is_other_file",
]

#: Files that are read as molecules.
SUFFIXES = (".pdb", ".ent", ".cif", ".pdbx", ".mmcif")
#: What can be chosen for files that MDAnalysis reads only.
FILE_OPTIONS = frozenset({"coordinates", "forces", "select"})

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")


def from_file(path: Path | str, rng: Rng = 1, *, quick: bool = False, **options: Any) -> TestSystem:
    """The molecules of a PDB or mmCIF file with forces of OpenMM, or of any file that MDAnalysis reads.

    Parameters
    ----------
    path : path
    rng : int, numpy.random.Generator or None
    quick : bool
        Half the horizon.
    **options
        What `structure.from_file` takes: constrain, force_field, add_hydrogens, platform, relax; or, for
        other files and where one of coordinates, forces, select is given, what
        `kcons.comparison.test_systems.any_file.from_file` takes.

    Raises
    ------
    InputError, UnsupportedError
        The file cannot be read, or does not fit the force field.
    """
    module = "any_file" if by_mdanalysis(str(path), options) else "structure"
    system: TestSystem = import_module(f"{__name__}.{module}").from_file(path, seed_from(rng), **options)
    return system.shortened(2) if quick else system


def by_mdanalysis(name: str, options: Mapping[str, Any]) -> bool:
    """Whether MDAnalysis reads the file, and not OpenMM."""
    return not is_file(name) or bool(FILE_OPTIONS & set(options))


def is_file(name: str) -> bool:
    """Whether a name is that of a structure file and not of a test system."""
    return name not in SYSTEMS and Path(name).suffix.lower() in SUFFIXES


def is_other_file(name: str) -> bool:
    """Whether a name is that of a file that MDAnalysis may read: it exists, or has a suffix and is no test system."""
    return name not in SYSTEMS and (Path(name).is_file() or Path(name).suffix != "")
