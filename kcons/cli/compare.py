"""`kcons compare`: how much error each method makes, for how much time; averages at a temperature."""

from __future__ import annotations

import argparse
import json
import sys
from math import isfinite
from pathlib import Path
from typing import Any

from kcons.cli.parser import Command, Option
from kcons.cli.systems import SYSTEM, check_name, list_everything, molecules, option_of, test_system
from kcons.cli.terminal import names, numbers, show
from kcons.errors import InputError

#: Options that say nothing beside expensive and cheap forces.
NOT_WITH_CHEAP_FORCES = ("size", "forces", "force_field", "add_hydrogens", "criterion")
#: Options that results depend on, beside the system, the budget and what is said about molecules.
SETTINGS = ("size", "quick", "dt")
#: Steps of a production run that are looked at, in fs.
PRODUCTION_STEPS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def run(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return list_everything()
    from kcons.comparison import report
    from kcons.comparison.progress import Watcher
    from kcons.steppers.files import ResultFolder, in_one_piece

    temperature = _asks_for_averages(chosen)  # complain before any work
    budget = chosen.budget if chosen.budget is not None else (5.0 if chosen.quick else 20.0)
    named = f"compare-{Path(chosen.system).name}" + ("-averages" if temperature else "")
    folder: Path = chosen.out or Path(named)
    asked = _asked(chosen, budget, temperature)
    files = [f"compare.{kind}" for kind in ("csv", "png", "txt")]
    results = ResultFolder(folder, files[0], {"asked": {"system": asked["system"]}}, files, "a comparison")
    results.refuse_others()
    path = folder / files[0]
    done = _earlier(path, asked) if chosen.resume else None

    def keep(table: Any) -> None:
        table.attrs["asked"] = asked
        report.write_csv(path, table)

    with results.taken(), Watcher(shown=True) as watcher:
        if done is None:  # what an earlier run left is not what --resume is to go on from
            for name in files:
                (folder / name).unlink(missing_ok=True)
        options = {"budget": budget, "done": done, "keep": keep, "watcher": watcher}
        try:
            table, words = (_averages if temperature else _trajectories)(chosen, options)
        except KeyboardInterrupt:
            if path.is_file():
                print(f"kcons: --resume goes on from what is in {path}", file=sys.stderr)
            raise
        keep(table)
        with in_one_piece(folder / "compare.txt") as file:
            file.write(f"{words}\n".encode())
        with in_one_piece(folder / "compare.png") as file:
            report.figure(table).savefig(file, dpi=150, format="png")
    show(words + "\n", f"wrote compare.csv, .png and .txt into {folder}; the whole table is in {path}")
    return 0


def _asks_for_averages(chosen: argparse.Namespace) -> bool:
    """Whether averages are compared, and not trajectories."""
    from kcons.comparison import averages, methods

    target, two = chosen.target_error, bool(chosen.slow or chosen.fast)
    if chosen.dt is not None and not chosen.dt:
        raise InputError("--dt is empty; give time steps such as --dt 4,2,1", item="dt")
    if target is not None and not (target > 0 and isfinite(target)):
        raise InputError(f"--target-error is {target:g}; give a positive number such as 1e-6", item="target_error")
    if not two and chosen.criterion != "temperature":
        methods.choose(chosen.methods)
        check_name(chosen)
        return False
    if target is not None:
        other = "--slow and --fast" if two else "--criterion temperature"
        raise InputError(f"--target-error is an error of trajectories; leave {other} out", item="criterion")
    averages.choose_samplers(chosen.methods, two)
    if two:
        wrong = [name for name in NOT_WITH_CHEAP_FORCES if getattr(chosen, name) not in (None, "temperature")]
        if wrong:
            raise InputError(f"{option_of(wrong[0])} does not go with --slow and --fast; leave it out", item=wrong[0])
        for name, other, what in (("slow", "fast", "expensive"), ("fast", "slow", "cheap")):
            if getattr(chosen, name) is None:
                raise InputError(f"--{other} needs --{name}: give the {what} forces, too", item=name)
        if chosen.slow == chosen.fast:
            raise InputError(f"--slow and --fast are both {chosen.fast}: give cheaper forces to --fast", item="fast")
        if chosen.system is None or not Path(chosen.system).is_file():
            raise InputError(f"--slow and --fast are for files, not for {chosen.system!r}", item="system")
    check_name(chosen)
    return True


def _trajectories(chosen: argparse.Namespace, options: dict[str, Any]) -> tuple[Any, str]:
    """The table of a test system through methods, and what is said of it."""
    from kcons.comparison import measure, methods, ranking, report

    budget, watcher = options["budget"], options["watcher"]
    with watcher.piece("building the test system", 1):
        system = test_system(chosen, quick=chosen.quick)
    if chosen.dt is not None:
        system = system.with_time_steps(chosen.dt)
    reference = measure.reference_of(system, watcher)
    rounds = 1 if chosen.quick else measure.ROUNDS
    table = measure.compare(system, chosen.methods, rounds=rounds, reference=reference, **options)
    if chosen.target_error is not None:
        rows = ranking.find_steps(system, table, chosen.target_error, reference, budget=budget, watcher=watcher)
        table = measure.table_of([*table.to_dict("records"), *rows], table.attrs)
    production = _production(chosen, system, budget, watcher)
    found = ranking.rank(table, limit=chosen.target_error)
    best = None if found is None or not len(found.table) else found.table.iloc[0]
    code = "" if best is None else methods.code(system, best.method, best.setting, _expression(chosen))
    return table, report.text(table, found, code, production)


def _averages(chosen: argparse.Namespace, options: dict[str, Any]) -> tuple[Any, str]:
    """The table of a test system through thermostats, and what is said of it."""
    from kcons.comparison import averages, ranking, report

    with options["watcher"].piece("building the test system", 1):
        both = [argparse.Namespace(**{**vars(chosen), "forces": name}) for name in (chosen.slow, chosen.fast) if name]
        system, *cheap = [test_system(each, quick=chosen.quick) for each in both or [chosen]]
    given: dict[str, Any] = {"cheap": cheap[0] if cheap else None, "steps": chosen.dt}
    table = averages.compare_averages(system, chosen.methods, **given, **options)
    found = ranking.rank(table, "temperature")
    best = None if found is None or not len(found.table) else found.table.iloc[0]
    code = "" if best is None else averages.code(system, best.method, best.setting, best.friction, _expression(chosen))
    return table, report.text(table, found, code)


def _asked(chosen: argparse.Namespace, budget: float, averages: bool) -> dict[str, Any]:
    """What the rows of a table depend on."""
    settings = {name: getattr(chosen, name) for name in SETTINGS}
    settings |= {"averages": True, "slow": chosen.slow, "fast": chosen.fast} if averages else {}
    file = Path(chosen.system)
    system = str(file.resolve()) if file.is_file() else chosen.system
    return {"system": system, **settings, "budget": budget, **molecules(chosen)}


def _earlier(path: Path, asked: dict[str, Any]) -> Any:
    """Rows to go on from."""
    from kcons.comparison import report
    from kcons.comparison.machine import environment

    if not path.is_file():
        raise InputError(f"there is no {path} to go on from; leave --resume out", item="resume")
    table = report.read_csv(path)
    before, now = table.attrs["environment"], environment()
    for name in ("commit", "cpu", "versions"):
        if before[name] != now[name]:
            raise InputError(f"{path} is of {name} {before[name]}, not {now[name]}: give another --out", item="resume")
    if table.attrs.get("asked") != asked:
        raise InputError(
            f"{path} was made with {table.attrs.get('asked')}, not {asked}: give another --out", item="resume"
        )
    return table


def _production(chosen: argparse.Namespace, system: Any, budget: float, watcher: Any) -> str:
    """Which step is right for averages, for a user's own molecule whose forces are cheap enough for the budget."""
    from kcons.comparison import measure, production, test_systems

    if chosen.system in test_systems.SYSTEMS or system.units.energy != "eV" or chosen.quick:
        return ""
    seconds = measure.force_seconds(system)
    if seconds > production.CHEAP * budget:
        return (
            f"Forces take {seconds:.2g} s: too long to see here which step is right for averages. Run it, and ask "
            "kcons check TRAJECTORY --topology FILE --forces ...; or give cheap forces beside: --slow FORCES --fast "
            "FORCES."
        )
    checks = production.check_steps(system, PRODUCTION_STEPS, budget, watcher=watcher)
    return production.sentence(checks, system.units.time)


def _expression(chosen: argparse.Namespace) -> str:
    """Python that makes the test system, after `from kcons.comparison import test_systems`."""
    from kcons.comparison import test_systems

    said = ({"quick": True} if chosen.quick else {}) | molecules(chosen)
    words = [f"{name}={_literal(value)}" for name, value in said.items()]
    if chosen.system not in test_systems.SYSTEMS:
        return f"test_systems.from_file({', '.join([_literal(chosen.system), *words])})"
    size = [] if chosen.size is None else [str(chosen.size)]
    return f"test_systems.build({', '.join([_literal(chosen.system), *size, *words])})"


def _literal(value: Any) -> str:
    """Python for it, strings in double quotes."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return f"[{', '.join(map(_literal, value))}]" if isinstance(value, list) else repr(value)


COMMAND = Command(
    "compare",
    "how much error each method makes, for how much time",
    "Run a test system or a file through several methods: which one to use, at which step; a ranking; "
    "a CSV file and a picture of error against cost. Trajectories are compared, or averages at a temperature.",
    (
        *SYSTEM,
        Option(
            "--dt",
            "time steps, comma separated, in the unit that tables show; "
            "steppers with several force evaluations a step take longer ones at the same cost",
            type=numbers,
        ),
        Option("--methods", "comma separated; all; openmm: those of OpenMM (default: the usual ones)", type=names),
        Option("--out", "folder for compare.csv, .png and .txt (default ./compare-SYSTEM[-averages])", type=Path),
        Option("--quick", "smaller system, half the horizon, a budget of 5 s", action="store_true"),
        Option("--budget", "seconds for each method (default 20)", type=float),
        Option("--resume", "go on from the rows of compare.csv in the folder", action="store_true"),
        Option("--target-error", "find the cheapest method and step that make at most this error", type=float),
        Option(
            "--criterion",
            "what methods are ranked by: error of the trajectory (default); temperature runs thermostats instead, and "
            "looks at the temperature of the configurations",
            choices=("error", "temperature"),
        ),
        Option("--slow", "of a file: expensive forces, as in --forces, with --fast", metavar="FORCES"),
        Option("--fast", "cheap ones: how long may the step be? (--slow gfn2 --fast amber14-all)", metavar="FORCES"),
    ),
    run,
)
