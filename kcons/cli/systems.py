"""The test system or file that a command is asked for, and what is said about its molecules."""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from kcons.comparison.test_systems import TestSystem


def check_name(chosen: argparse.Namespace) -> None:
    from kcons.comparison import test_systems

    known = ", ".join(test_systems.SYSTEMS)
    if chosen.scene is None:
        raise InputError(f"name a test system: {known}; or a PDB file", item="scene")
    if test_systems.is_file(chosen.scene) or test_systems.is_other_file(chosen.scene):
        if not Path(chosen.scene).is_file():
            raise InputError(f"there is no file {chosen.scene}", item="scene")
        if chosen.size is not None:
            raise InputError("a file has the size it has; leave --size out", item="size")
    elif chosen.scene not in test_systems.SYSTEMS:
        raise InputError(
            f"there is no test system {chosen.scene!r}"
            f"{did_you_mean(chosen.scene, test_systems.SYSTEMS)}; "
            f"there are {known}; or give a PDB file",
            item="scene",
        )
    if chosen.seed < 0:
        raise InputError(f"the seed is {chosen.seed}; give a non-negative number", item="seed")


def owner(scene: str) -> str:
    """What results belong to: a test system by name, or a file by its path."""
    return str(Path(scene).resolve()) if Path(scene).is_file() else scene


def molecules(chosen: argparse.Namespace) -> dict[str, Any]:
    """What was said about molecules in OpenMM."""
    said = {
        "constrain": chosen.constrain,
        "force_field": chosen.forcefield,
        "add_hydrogens": chosen.add_hydrogens or None,
        "platform": chosen.platform,
        "coordinates": None if chosen.coordinates is None else str(chosen.coordinates),
        "forces": chosen.forces,
        "select": chosen.select,
        "rigid_residues": chosen.rigid_residues,
    }
    return {name: value for name, value in said.items() if value is not None}


def test_system(chosen: argparse.Namespace, *, quick: bool = False) -> TestSystem:
    from kcons.comparison import test_systems

    if test_systems.is_file(chosen.scene) or test_systems.is_other_file(chosen.scene):
        if chosen.add_hydrogens and test_systems.by_mdanalysis(chosen.scene, molecules(chosen)):
            raise InputError("--add-hydrogens is for PDB and mmCIF files with OpenMM", item="add_hydrogens")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            found = test_systems.from_file(chosen.scene, chosen.seed, quick=quick, **molecules(chosen))
        for text in dict.fromkeys(str(w.message) for w in said if w.category is UserWarning):
            print(f"kcons: {text}", file=sys.stderr)
        return found
    if chosen.add_hydrogens:
        raise InputError("--add-hydrogens is for files; the built-in molecules have theirs", item="add_hydrogens")
    for name in sorted(test_systems.FILE_OPTIONS & set(molecules(chosen))):
        raise InputError(f"--{name.replace('_', '-')} is for files, not for built-in test systems", item=name)
    return test_systems.build(chosen.scene, chosen.size, chosen.seed, quick=quick, **molecules(chosen))
