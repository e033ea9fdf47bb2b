"""`kcons compare`: how much error each method makes, for how much time; thermostats; long steps."""

from __future__ import annotations

import argparse
import json
import sys
from math import isfinite
from pathlib import Path
from typing import Any

from kcons.cli import listing, long_steps
from kcons.cli.parser import Parser
from kcons.cli.systems import check_name, molecules, owner, test_system
from kcons.cli.terminal import console, names, numbers, rendered, say_written, show
from kcons.errors import InputError

#: Options by what can be run.
OF_FLUIDS = frozenset({"size", "seed", "dt", "methods", "out", "quick", "budget", "criterion"})
OF_STEPS_OF_FLUIDS = OF_FLUIDS - {"criterion"} | {"slow", "fast"}
OF_STEPS_OF_FILES = OF_STEPS_OF_FLUIDS - {"size"} | {"coordinates", "constrain", "select", "rigid_residues", "platform"}
#: Options that results depend on, beside the system, the budget and what is said about molecules.
SETTINGS = ("size", "seed", "quick", "dt")
#: Steps of a production run that are looked at, in fs.
PRODUCTION_STEPS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def add(commands: Any, common: Parser) -> None:
    """Its options."""
    compare = commands.add_parser(
        "compare",
        parents=[common],
        help="how much error each method makes, for how much time",
        description="Run a test system or a file through several methods: which one to use, at which step; a ranking; "
        "a CSV file and a picture of error against cost. Trajectories are compared, or averages at a temperature.",
    )
    compare.add_argument(
        "--dt",
        type=numbers,
        help="time steps, comma separated, in the unit that tables show; "
        "steppers with several force evaluations a step take longer ones at the same cost",
    )
    compare.add_argument(
        "--methods",
        type=names,
        help="methods, comma separated, or all; openmm stands for those of OpenMM (default: the usual ones)",
    )
    compare.add_argument(
        "--out",
        type=Path,
        help="folder for compare.csv, .png and .txt (default ./compare-SYSTEM, with --fast ./compare-SYSTEM-steps)",
    )
    compare.add_argument("--quick", action="store_true", help="smaller system, half the horizon, a budget of 5 s")
    compare.add_argument("--budget", type=float, help="seconds for each method (default 20)")
    compare.add_argument("--resume", action="store_true", help="go on from the rows of compare.csv in the folder")
    compare.add_argument(
        "--target-error",
        type=float,
        metavar="E",
        help="also find the cheapest method and step that make at most this error, by measurement",
    )
    compare.add_argument(
        "--criterion",
        choices=("error", "drift", "temperature"),
        help="what methods are ranked by: error of the trajectory (default), drift of the energy; for thermostats the "
        "temperature of the configurations",
    )
    long_steps.add(compare)
    compare.set_defaults(run=run, of=compare)


def run(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return listing.of_everything()
    from kcons.comparison import test_systems

    budget = chosen.budget if chosen.budget is not None else (5.0 if chosen.quick else 20.0)
    folder: Path = chosen.out or Path(f"compare-{Path(chosen.scene or '').stem}")
    if chosen.dt is not None and not chosen.dt:
        raise InputError("--dt is empty; give time steps such as --dt 4,2,1", item="dt")
    if chosen.slow is not None or chosen.fast is not None:
        known = OF_STEPS_OF_FLUIDS if chosen.scene in test_systems.FLUIDS else OF_STEPS_OF_FILES
        chosen.of.take_only(chosen, known, "does not go with --slow and --fast; leave it out")
        check_name(chosen)
        folder = chosen.out or folder.with_name(f"{folder.name}-steps")  # beside what compares trajectories
        return long_steps.run(chosen, budget, folder)
    if chosen.scene in test_systems.FLUIDS:
        return _thermostats(chosen, budget, folder)
    return _trajectories(chosen, budget, folder)


def _trajectories(chosen: argparse.Namespace, budget: float, folder: Path) -> int:
    target: float | None = chosen.target_error
    if target is not None and not (target > 0 and isfinite(target)):
        raise InputError(f"--target-error is {target:g}; give a positive number such as 1e-6", item="target_error")
    if chosen.criterion == "temperature":
        from kcons.comparison import test_systems

        raise InputError(
            f"--criterion temperature is for {', '.join(test_systems.FLUIDS)}, whose averages are known. For a file "
            "kcons compare FILE says which step is right for averages; of a run, kcons check TRAJECTORY --topology "
            "FILE --forces ... tells",
            item="criterion",
        )
    if chosen.criterion == "drift" and target is not None:
        raise InputError("--target-error is an error of trajectories; leave --criterion drift out", item="criterion")
    from kcons.cli.progress import Bars
    from kcons.comparison import measure, methods, ranking, report
    from kcons.steppers.files import ResultFolder, in_one_piece

    methods.choose(chosen.methods)  # complain before any work
    check_name(chosen)
    asked = _asked(chosen, budget)
    names = [f"compare.{kind}" for kind in ("csv", "png", "txt")]
    results = ResultFolder(folder, names[0], {"asked": {"system": asked["system"]}}, names, "a comparison")
    results.refuse_others()
    path = folder / names[0]
    done = _earlier(path, asked) if chosen.resume else None
    with results.taken(), Bars() as watcher:
        if done is None:  # what an earlier run left is not what --resume is to go on from
            for name in names:
                (folder / name).unlink(missing_ok=True)
        with watcher.piece("building the test system", 1):
            system = test_system(chosen, quick=chosen.quick)
        if chosen.dt is not None:
            system = system.with_time_steps(chosen.dt)
        reference = measure.reference_of(system, watcher)

        def keep(table: Any) -> None:
            table.attrs["asked"] = asked
            report.write_csv(path, table)

        options: dict[str, Any] = {
            "budget": budget,
            "rounds": 1 if chosen.quick else measure.ROUNDS,
            "reference": reference,
        }
        try:
            table = measure.compare(system, chosen.methods, **options, done=done, keep=keep, watcher=watcher)
        except KeyboardInterrupt:
            if path.is_file():
                print(f"kcons: --resume goes on from what is in {path}", file=sys.stderr)
            raise
        if target is not None:
            rows = ranking.find_steps(system, table, target, reference, budget=budget, watcher=watcher)
            table = measure.table_of([*table.to_dict("records"), *rows], table.attrs)
        production = _production(chosen, system, budget, watcher)
        keep(table)
        found = ranking.rank(table, chosen.criterion or "error", target)
        code = ""
        if found is not None and len(found.table):
            best = found.table.iloc[0]
            code = methods.code(system, best.method, best.setting, _expression(chosen))
        words = report.text(table, found, code, production)
        with in_one_piece(folder / "compare.txt") as file:
            file.write(f"{words}\n".encode())
        with in_one_piece(folder / "compare.png") as file:
            report.figure(table).savefig(file, dpi=150, format="png")
    console().print(words + "\n", highlight=False, markup=False, soft_wrap=True)
    print(f"wrote compare.csv, .png and .txt into {folder}; the whole table is in {path}")
    return 0


def _asked(chosen: argparse.Namespace, budget: float) -> dict[str, Any]:
    """What the rows of a table depend on."""
    settings = {name: getattr(chosen, name) for name in SETTINGS}
    return {"system": owner(chosen.scene), **settings, "budget": budget, **molecules(chosen)}


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

    if chosen.scene in test_systems.SYSTEMS or system.units.energy != "eV" or chosen.quick:
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

    said: dict[str, Any] = {"seed": chosen.seed} if chosen.seed != 1 else {}
    said |= {"quick": True} if chosen.quick else {}
    said |= molecules(chosen)
    words = [f"{name}={_literal(value)}" for name, value in said.items()]
    if chosen.scene not in test_systems.SYSTEMS:
        return f"test_systems.from_file({', '.join([_literal(chosen.scene), *words])})"
    size = [] if chosen.size is None else [str(chosen.size)]
    return f"test_systems.build({', '.join([_literal(chosen.scene), *size, *words])})"


def _literal(value: Any) -> str:
    """Python for it, strings in double quotes."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return f"[{', '.join(map(_literal, value))}]" if isinstance(value, list) else repr(value)


def _thermostats(chosen: argparse.Namespace, budget: float, folder: Path) -> int:
    """Averages of a fluid at a temperature."""
    if chosen.target_error is not None:
        raise InputError("--target-error is for trajectories; a fluid has averages", item="target_error")
    if chosen.criterion not in (None, "temperature"):
        raise InputError(
            f"--criterion {chosen.criterion} is for trajectories; thermostats are ranked by temperature",
            item="criterion",
        )
    from kcons.cli.progress import Bars
    from kcons.comparison import test_systems
    from kcons.comparison.averages import ranking, sampling
    from kcons.comparison.averages import report as sampling_report
    from kcons.comparison.study import report_files

    sampling.chosen(chosen.methods)  # complain before any work
    check_name(chosen)
    chosen.of.take_only(chosen, OF_FLUIDS, "is not for fluids; leave it out")
    system = owner(chosen.scene)
    results = report_files.results(folder, "compare", system)
    results.refuse_others()
    fluid = test_systems.build_fluid(chosen.scene, chosen.size, chosen.seed, quick=chosen.quick)
    if chosen.dt is not None:
        fluid = fluid.with_time_steps(chosen.dt)
    folder.mkdir(parents=True, exist_ok=True)
    with Bars() as watcher:
        result = sampling.compare(
            fluid,
            methods=chosen.methods,
            budget=budget,
            seed=chosen.seed,
            watcher=watcher,
            settings={
                "system": system,
                "size": chosen.size,
                "seed": chosen.seed,
                "quick": chosen.quick,
                "dt": chosen.dt,
            },
            partial=True,
        )
    table, explained = sampling_report.table(result), sampling_report.explanation(result)
    first = list(filter(None, [ranking.text(result)]))
    terminal = console()
    for words in first:
        terminal.print(words + "\n", highlight=False, markup=False, soft_wrap=True)
    show(table, explained, terminal)
    with results.taken():
        say_written(sampling_report.write(result, folder, tables=[*first, rendered(table), explained]))
    return 130 if "interrupted" in result.settings else 0
