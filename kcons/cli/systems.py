"""The test system or file that a command is asked for, what is said about its molecules, and `kcons plan`."""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.cli.parser import Command, Option
from kcons.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from kcons.comparison.test_systems import TestSystem


#: Options of `compare` and `plan` about the system.
_MOLECULES = "molecules: alanine, dhfr, dhfr-water, villin, and files"
_FILES = "files"
SYSTEM = (
    Option("system", "a built-in test system (--list), or a file: PDB, mmCIF, what MDAnalysis reads", nargs="?"),
    Option("--size", "number of molecules, bonds or particles", type=int),
    Option("--list", "list test systems and methods, and leave", action="store_true"),
    Option(
        "--constrain",
        "beside rigid water (default hbonds for files)",
        choices=("hbonds", "allbonds", "hangles", "allangles", "none"),
        group=_MOLECULES,
    ),
    Option(
        "--forcefield",
        "files of OpenMM (default amber14-all.xml amber14/tip3pfb.xml)",
        nargs="+",
        dest="force_field",
        metavar="XML",
        group=_MOLECULES,
    ),
    Option("--platform", "of OpenMM (default: Reference up to 200 atoms, CPU above)", group=_MOLECULES),
    Option(
        "--add-hydrogens",
        "add hydrogens that a PDB or mmCIF file lacks, at pH 7",
        action="store_const",
        const=True,
        group=_FILES,
    ),
    Option("--coordinates", "coordinates, where the topology file has none", metavar="FILE", group=_FILES),
    Option(
        "--forces",
        "openmm (default), force fields of OpenMM by name, comma separated (amber14-all,amber14/tip3p), or emt, "
        "lj, tip3p, gfn1, gfn2, or another calculator of ASE; not for plan",
        group=_FILES,
    ),
    Option("--select", "hold only what is within this selection of MDAnalysis", metavar="WORDS", group=_FILES),
)
#: Options that are arguments of `from_file`, by the same names, and those of them that `plan` takes.
GIVEN = ("constrain", "force_field", "add_hydrogens", "platform", "coordinates", "forces", "select")
HELD = ("constrain", "coordinates", "select")


def option_of(name: str) -> str:
    """The option that an argument is given by."""
    return "--" + {"force_field": "forcefield"}.get(name, name.replace("_", "-"))


def check_name(chosen: argparse.Namespace) -> None:
    from kcons.comparison import test_systems

    known = ", ".join(test_systems.SYSTEMS)
    if chosen.system is None:
        raise InputError(f"name a test system: {known}; or a PDB file", item="system")
    if test_systems.is_file(chosen.system):
        if not Path(chosen.system).is_file():
            raise InputError(f"there is no file {chosen.system}", item="system")
        if chosen.size is not None:
            raise InputError("a file has the size it has; leave --size out", item="size")
    elif chosen.system not in test_systems.SYSTEMS:
        raise InputError(
            f"there is no test system {chosen.system!r}{did_you_mean(chosen.system, test_systems.SYSTEMS)}; there are "
            f"{known}; or give a PDB file",
            item="system",
        )


def molecules(chosen: argparse.Namespace) -> dict[str, Any]:
    """What was said about molecules."""
    return {name: value for name in GIVEN if (value := getattr(chosen, name)) is not None}


def test_system(chosen: argparse.Namespace, *, quick: bool = False) -> TestSystem:
    from kcons.comparison import test_systems

    if not test_systems.is_file(chosen.system):
        return test_systems.build(chosen.system, chosen.size, quick=quick, **molecules(chosen))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        found = test_systems.from_file(chosen.system, quick=quick, **molecules(chosen))
    for text in dict.fromkeys(str(w.message) for w in said if w.category is UserWarning):
        print(f"kcons: {text}", file=sys.stderr)
    return found


def list_everything() -> int:
    """Print the names of test systems and methods."""
    from kcons.comparison import averages, methods, test_systems

    def when(method: methods.Method) -> str:
        if not method.usual:
            return " (only when named)"
        everywhere = method.engine != "OpenMM" or method.name in methods.GUESTS
        return "" if everywhere else " (in OpenMM's test systems, or when named)"

    print("test systems")
    for name, entry in test_systems.SYSTEMS.items():
        print(f"  {name:<16} {entry.text} (default {entry.size} {entry.unit})")
    print(f"  {'FILE':<16} your own molecules; --constrain, --forces, --forcefield, --coordinates, --select")
    print("methods")
    for name, method in methods.METHODS.items():
        print(f"  {name:<27} {method.title}{when(method)}")
    print("thermostats (--criterion temperature)")
    for name, sampler in averages.SAMPLERS.items():
        print(f"  {name:<21} {sampler.title}{' (--slow, --fast)' if sampler.several else ''}")
    return 0


def _plan(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return list_everything()
    from kcons.comparison import test_systems

    check_name(chosen)
    given = molecules(chosen)
    if not test_systems.is_file(chosen.system):
        system = test_system(chosen)
        print(system.title)
        print(system.motion.report(system.positions, system.velocities))
        return 0
    for name in (name for name in given if name not in HELD):
        raise InputError(f"a plan needs no forces; leave {option_of(name)} out", item=name)
    found = test_systems.plan(chosen.system, **given)
    print("\n".join([found.title, *found.notes]))
    if sites := len(found.rows.virtual_sites):
        print(f"{sites:,} virtual sites, placed by their molecules")
    print(found.motion.report(found.positions))
    return 0


PLAN = Command(
    "plan",
    "clusters, rank, degrees of freedom and the solver picked for each kind of cluster",
    "What the engine will do for a system, before any run.",
    SYSTEM,
    _plan,
)
