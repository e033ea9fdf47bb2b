"""The command `kcons freeenergy`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.cli.scan import INCOMPLETE
from kcons.cli.terminal import console, say_written, show
from kcons.errors import InputError

if TYPE_CHECKING:
    from kcons.free_energy.windows.plan_file import PlanFile


def add(commands: Any) -> None:
    """Its options."""
    made = commands.add_parser(
        "freeenergy",
        help="free energy along held coordinates, from a plan",
        description="Samples windows with coordinates held, and integrates their mean force. The plan is a TOML file; "
        "see the page on free energies. Goes on where it stopped: finished windows are kept one by one. Exit status 0; "
        "2 for wrong use; 3 if some windows failed.",
    )
    made.add_argument("plan", type=Path, help="TOML file with structure, forces, coordinates and sampling")
    made.add_argument("--out", type=Path, help="folder of the windows and results (default ./PLAN without its ending)")
    made.add_argument("--workers", type=int, help="processes of this machine (default: of the plan, or one a core)")
    made.add_argument("--scheduler", help="address of a Dask scheduler, such as tcp://host:8786, in place of processes")
    made.add_argument(
        "--allow-module",
        action="append",
        default=[],
        metavar="MODULE",
        help="let the plan take a calculator of this Python module, whose code then runs; may be repeated",
    )
    made.add_argument("--list", action="store_true", help="say what would be run, and leave")
    made.set_defaults(run=_free_energy, kept="windows")


def _free_energy(chosen: argparse.Namespace) -> int:
    from dataclasses import replace

    from kcons.cli.progress import Bars
    from kcons.free_energy import Windows, read_plan, windows_report
    from kcons.steppers.files import in_one_piece, text

    plan = read_plan(chosen.plan, allow_modules=chosen.allow_module)
    if chosen.list:
        return _list(plan)
    if plan.scheduler is not None and chosen.scheduler is None:
        raise InputError(
            f"the plan is to run at {plan.scheduler}, a scheduler whose answers may run code here; if you trust it, "
            f"say so: --scheduler {plan.scheduler}",
            item="scheduler",
        )
    plan = replace(plan, scheduler=chosen.scheduler)
    folder: Path = chosen.out or Path(chosen.plan.stem)
    windows = Windows(plan.sampler, folder, plan.settings, **plan.options)
    # A folder belongs to settings, and pulls are slower than the way to a window.
    slow = replace(plan.settings, pull=plan.pull_steps)
    pulls = Windows(plan.sampler, folder / "pulls", slow, **plan.options) if plan.pulls else None
    with windows.taken(), Bars() as watcher, plan.executor() as executor:

        def progress(done: int, total: int, seconds: float) -> None:
            each = seconds / (total - done) if done < total else 0.0
            watcher.overall("windows", done * each, total * each)

        how: dict[str, Any] = {
            "executor": executor,
            "workers": plan.processes if chosen.workers is None else chosen.workers,
            "progress": progress,
        }
        found = windows.run(plan.targets, **how)
        if plan.improve and not found.failed:
            found = windows.improve(**plan.improve, **how)
        # Before pulls, which may fail.
        written = windows_report.write(found, folder, windows.angles)
        said = ""
        if plan.pulls is not None and pulls is not None:
            pulled = pulls.pull(**plan.pulls, **how)
            numbers, said = windows_report.of_pulls(found, pulled, plan.pulls["start"], plan.pulls["end"])
            written.append(folder / "pulls.json")
            with in_one_piece(written[-1]) as opened:
                opened.write(text(numbers).encode())
    show(windows_report.table(found, windows.angles), windows_report.summary(found), console())
    if said:
        print(said)
    say_written(written)
    return INCOMPLETE if found.failed else 0


def _list(plan: PlanFile) -> int:
    """Say what would be run. Coordinates are looked at, calculators are not."""
    plan.sampler.begin()
    sides = 2 if plan.options.get("both_sides", True) else 1
    parts = {name: getattr(plan.settings, name) for name in ("pull", "equilibration", "production")}
    told = ", ".join(f"{name} {steps:,}" for name, steps in parts.items())
    runs = f"{sides} runs" if sides > 1 else "a run"
    print(f"{len(plan.targets)} windows of {', '.join(plan.sampler.names)}, {runs} each")
    print(f"{sum(parts.values()):,} steps a run: {told}; a sample every {plan.settings.every}")
    if plan.pulls:
        ways = "both ways" if plan.pulls.get("both_ways", True) else "one way"
        print(f"{plan.pulls.get('count', 20)} pulls {ways} of {plan.pull_steps:,} steps each")
    return 0
