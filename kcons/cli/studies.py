"""The commands `kcons hardcases` and `kcons stability`, and `kcons compare --slow --fast`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.cli.terminal import console, names, rendered, say_written, show
from kcons.errors import InputError

if TYPE_CHECKING:
    from kcons.comparison.averages.layers import Layers
    from kcons.comparison.test_systems import TestSystem
    from kcons.steppers.files import ResultFolder


def add(commands: Any) -> None:
    """Their options."""
    hard = commands.add_parser(
        "hardcases",
        help="what kcons, ASE and OpenMM do where constraints are difficult",
        description="Run the hard cases side by side; table, picture, page and JSON of the verdicts.",
    )
    hard.add_argument("--quick", action="store_true", help="shorter runs, some minutes")
    hard.add_argument("--out", type=Path, default=Path("hardcases"), help="folder (default ./hardcases); goes on there")
    hard.add_argument("--only", type=names, help="numbers of cases, comma separated, such as H14,H16")
    hard.add_argument("--list", action="store_true", help="list the cases, and leave")
    hard.set_defaults(run=_hard_cases)

    stability = commands.add_parser(
        "stability",
        help="largest stable steps, drift of the energy, reversibility, random molecules",
        description="How far each method can be pushed on small test systems, and what it does beyond.",
    )
    stability.add_argument("--quick", action="store_true", help="shorter runs, some minutes")
    stability.add_argument("--out", type=Path, default=Path("stability"), help="folder (default ./stability)")
    stability.add_argument("--only", type=names, help="of steps, drift, reversal, fuzz; comma separated")
    stability.add_argument("--scenes", type=names, help="of water, chain, dumbbells, rotor, pendulum, butane")
    stability.add_argument(
        "--into", type=Path, nargs="+", metavar="FILE", help="add to these results (JSON) and this page (Markdown)"
    )
    stability.set_defaults(run=_stability)


def add_steps(compare: argparse.ArgumentParser) -> None:
    """Options of `kcons compare` for expensive and cheap forces."""
    layers = compare.add_argument_group(
        "expensive and cheap forces: how long may the step be? For fluids how far molecules reach (--fast 6), for "
        "files forces as in --forces (--slow gfn2 --fast amber14-all,amber14/tip3p)"
    )
    layers.add_argument("--slow", metavar="FORCES", help="the expensive ones (default for fluids: half the box)")
    layers.add_argument("--fast", metavar="FORCES", help="the cheap ones")


def _hard_cases(chosen: argparse.Namespace) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison import hard_cases
    from kcons.comparison.hard_cases import report
    from kcons.comparison.hard_cases.study import FORMAT

    cases = hard_cases.chosen(chosen.only)
    if chosen.list:
        for case in cases.values():
            print(f"{case.number}  {case.title}: {case.limit}")
        return 0
    kept = chosen.out / "hard_cases.json"
    with _results(kept, FORMAT).taken():
        with Bars() as watcher:
            result = hard_cases.run(only=chosen.only, quick=chosen.quick, kept=kept, watcher=watcher)
        show(report.table(result), report.summary(result), console())
        say_written([kept, *report.write(result, chosen.out)])
    return 0


def _results(kept: Path, form: str) -> ResultFolder:
    from kcons.steppers.files import ResultFolder

    names = [kept.with_suffix(f".{kind}").name for kind in ("json", "png", "html")]
    return ResultFolder(kept.parent, kept.name, {"format": form}, names, f"a {kept.stem} study")


def _stability(chosen: argparse.Namespace) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison import stability
    from kcons.comparison.stability import report
    from kcons.comparison.stability.study import FORMAT

    kept = chosen.out / "stability.json"
    with _results(kept, FORMAT).taken():
        with Bars() as watcher:
            found = stability.run(
                only=chosen.only, test_systems=chosen.scenes, quick=chosen.quick, kept=kept, watcher=watcher
            )
        result = stability.digest(found)
        if chosen.into:
            before, result = stability.put_into(result, chosen.into[0])
            for page in chosen.into[1:]:
                report.renew(page, before, result)
            say_written(chosen.into)
        print(report.text(result))
        say_written([kept, *report.write(result, chosen.out)])
    return 0


def compare_steps(
    chosen: argparse.Namespace, budget: float, folder: Path, system: str, with_forces: Callable[[str], TestSystem]
) -> int:
    """Bias against evaluations of the expensive forces; `with_forces` makes the test system of a file."""
    from kcons.cli.progress import Bars
    from kcons.comparison.averages import long_steps
    from kcons.comparison.averages import long_steps_report as report
    from kcons.comparison.study import report_files

    long_steps.chosen(chosen.methods)  # complain before any work
    if chosen.fast is None:
        raise InputError("--slow needs --fast: give the cheap forces, too", item="fast")
    if chosen.slow == chosen.fast:
        raise InputError(f"--slow and --fast are both {chosen.fast}: give cheaper forces to --fast", item="fast")
    results = report_files.results(folder, "compare", system)
    results.refuse_others()
    with Bars() as watcher:
        with watcher.piece("building the system", 1):
            layers = _layers(chosen, with_forces)
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


def _layers(chosen: argparse.Namespace, with_forces: Callable[[str], TestSystem]) -> Layers:
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
    return layers.of_test_systems(with_forces(chosen.slow), with_forces(chosen.fast))
