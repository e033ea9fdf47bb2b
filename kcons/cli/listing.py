"""What `kcons compare --list` and `kcons plan --list` print: all names that can be given."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kcons.comparison.methods import Method


def of_everything() -> int:
    """Print the names of test systems and methods."""
    from kcons.comparison import averages, methods, test_systems

    print("test systems")
    for name, entry in test_systems.SYSTEMS.items():
        print(f"  {name:<16} {entry.text} (default {entry.size} {entry.unit})")
    print(f"  {'FILE.pdb, .cif':<16} your own molecules; OpenMM, --forcefield, --constrain")
    print(f"  {'FILE':<16} any topology that MDAnalysis reads; --coordinates, --constrain, --select, --forces")
    print("methods")
    for name, method in methods.METHODS.items():
        print(f"  {name:<27} {method.title}{_when(method)}")
    print("thermostats (--criterion temperature)")
    for name, sampler in averages.SAMPLERS.items():
        print(f"  {name:<21} {sampler.title}{' (--slow, --fast)' if sampler.several else ''}")
    return 0


def _when(method: Method) -> str:
    """When a method runs."""
    if not method.usual:
        return " (only when named)"
    from kcons.comparison.methods import GUESTS

    return "" if method.engine != "OpenMM" or method.name in GUESTS else " (in OpenMM's test systems, or when named)"
