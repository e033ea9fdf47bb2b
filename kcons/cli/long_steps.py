"""`kcons compare --slow --fast`: expensive and cheap forces."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from kcons.cli.systems import owner, test_system
from kcons.cli.terminal import console, rendered, say_written, show
from kcons.errors import InputError

if TYPE_CHECKING:
    from kcons.comparison.averages.layers import Layers


def add(compare: argparse.ArgumentParser) -> None:
    """Options of `kcons compare` for expensive and cheap forces."""
    layers = compare.add_argument_group(
        "expensive and cheap forces: how long may the step be? For fluids how far molecules reach (--fast 6), for "
        "files forces as in --forces (--slow gfn2 --fast amber14-all,amber14/tip3p)"
    )
    layers.add_argument("--slow", metavar="FORCES", help="the expensive ones (default for fluids: half the box)")
    layers.add_argument("--fast", metavar="FORCES", help="the cheap ones")


def run(chosen: argparse.Namespace, budget: float, folder: Path) -> int:
    """Bias against evaluations of the expensive forces."""
    from kcons.cli.progress import Bars
    from kcons.comparison.averages import long_steps
    from kcons.comparison.averages import long_steps_report as report
    from kcons.comparison.study import report_files

    long_steps.chosen(chosen.methods)  # complain before any work
    if chosen.fast is None:
        raise InputError("--slow needs --fast: give the cheap forces, too", item="fast")
    if chosen.slow == chosen.fast:
        raise InputError(f"--slow and --fast are both {chosen.fast}: give cheaper forces to --fast", item="fast")
    system = owner(chosen.scene)
    results = report_files.results(folder, "compare", system)
    results.refuse_others()
    with Bars() as watcher:
        with watcher.piece("building the system", 1):
            layers = _layers(chosen)
        unit = layers.units.time_unit
        steps = None if chosen.dt is None else [dt * unit for dt in chosen.dt]
        folder.mkdir(parents=True, exist_ok=True)  # complain before the long part
        asked = {"system": system, "slow": chosen.slow, "fast": chosen.fast, "size": chosen.size, "quick": chosen.quick}
        result = long_steps.compare(
            layers,
            methods=chosen.methods,
            steps=steps,
            budget=budget,
            seed=chosen.seed,
            watcher=watcher,
            settings=asked,
            partial=True,
        )
    table, explained = report.table(result.runs, result.units, result.title), report.explanation(result.runs)
    stopped = result.settings.get("interrupted")
    if stopped:
        explained = f"{stopped}\n{explained}"
    show(table, explained, console())
    with results.taken():
        say_written(report.write(result, folder, tables=[rendered(table), explained]))
    return 130 if stopped else 0


def _layers(chosen: argparse.Namespace) -> Layers:
    """The system with both forces."""
    from kcons.comparison import test_systems
    from kcons.comparison.averages import layers

    if chosen.scene in test_systems.FLUIDS:
        try:
            fast, slow = float(chosen.fast), None if chosen.slow is None else float(chosen.slow)
        except ValueError:
            given = [
                f"--{name} {getattr(chosen, name)}" for name in ("slow", "fast") if getattr(chosen, name) is not None
            ]
            raise InputError(
                f"{' '.join(given)}: for a fluid give how far molecules reach, such as 4", item="fast"
            ) from None
        fluid = test_systems.build_fluid(chosen.scene, chosen.size, chosen.seed, quick=chosen.quick)
        return layers.of_fluid(fluid, fast, slow, sweeps=10_000 if chosen.quick else 20_000, seed=chosen.seed)
    if chosen.scene is None or not Path(chosen.scene).is_file():
        known = ", ".join(test_systems.FLUIDS)
        raise InputError(f"--slow and --fast are for {known} and for files, not {chosen.scene!r}", item="scene")
    if chosen.slow is None:
        raise InputError("a file needs --slow and --fast, the expensive and the cheap forces", item="slow")
    both = [argparse.Namespace(**{**vars(chosen), "forces": name}) for name in (chosen.slow, chosen.fast)]
    return layers.of_test_systems(test_system(both[0]), test_system(both[1]))
