"""`kcons plan`: what the engine will do for a system, before any run."""

from __future__ import annotations

import argparse
from typing import Any

from kcons.cli import listing
from kcons.cli.parser import Command
from kcons.cli.systems import SYSTEM, check_name, molecules, test_system
from kcons.errors import InputError


def run(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return listing.of_everything()
    from kcons.comparison import test_systems

    check_name(chosen)
    given = molecules(chosen)
    if test_systems.is_other_file(chosen.system) and test_systems.by_mdanalysis(chosen.system, given):
        return plan_file(chosen, given)
    system = test_system(chosen)
    print(system.title)
    print(system.motion.report(system.positions, system.velocities))
    return 0


def plan_file(chosen: argparse.Namespace, given: dict[str, Any]) -> int:
    """Nothing but the rows: no forces are needed."""
    from kcons.comparison.test_systems import any_file

    for name in ("forces", "force_field", "platform", "add_hydrogens"):
        if name in given:
            option = name.replace("_", "-") if name == "add_hydrogens" else name.replace("_", "")
            raise InputError(f"a plan needs no forces; leave --{option} out", item=name)
    found = any_file.plan(chosen.system, **given)
    print(found.title)
    for note in found.notes:
        print(note)
    sites = len(found.rows.virtual_sites)
    if sites:
        print(f"{sites:,} virtual sites, placed by their molecules")
    print(found.motion.report(found.positions))
    return 0


COMMAND = Command(
    "plan",
    "clusters, rank, degrees of freedom and the solver picked for each kind of cluster",
    "What the engine will do for a system, before any run.",
    (*SYSTEM,),
    run,
)
