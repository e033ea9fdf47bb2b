"""`kcons compare`: how much error each method makes, for how much time, or averages at a temperature; `kcons plan`."""

from __future__ import annotations

import argparse
import sys
from hashlib import sha256
from math import inf
from pathlib import Path
from typing import Any

from kcons.cli.terminal import HELD, Command, Option, names, numbers, show
from kcons.errors import InputError, unknown

#: Options that are arguments of `from_file`, by the same names, and those of them that `plan` takes.
GIVEN = ("constrain", "force_field", "add_hydrogens", "platform", "coordinates", "forces", "select")
OF_PLAN = ("constrain", "coordinates", "select")
#: Options that say nothing beside expensive and cheap forces.
NOT_WITH_CHEAP_FORCES = ("size", "forces", "force_field", "add_hydrogens", "criterion")
#: Steps of a production run that are looked at, in fs.
PRODUCTION_STEPS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


# -- systems ----------------------------------------------------------------------------------------


def option_of(name: str) -> str:
    """The option that an argument is given by."""
    return "--" + {"force_field": "forcefield"}.get(name, name.replace("_", "-"))


def check_name(chosen: argparse.Namespace) -> None:
    from kcons.comparison import test_systems

    known, name = test_systems.SYSTEMS, chosen.system
    if name is None:
        raise InputError(f"name a test system: {', '.join(known)}; or give a file", item="system")
    if test_systems.is_file(name):
        if not Path(name).is_file():
            raise InputError(f"there is no file {name}", item="system")
        if chosen.size is not None:
            raise InputError("a file has the size it has; leave --size out", item="size")
    elif name not in known:
        raise InputError(f"there is no test system {unknown(name, known)}; or give a file", item="system")


def molecules(chosen: argparse.Namespace) -> dict[str, Any]:
    """What was said about molecules."""
    return {name: value for name in GIVEN if (value := getattr(chosen, name)) is not None}


def test_system(chosen: argparse.Namespace, quick: bool = False) -> Any:
    from kcons.comparison import test_systems

    if test_systems.is_file(chosen.system):
        return test_systems.from_file(chosen.system, quick=quick, **molecules(chosen))
    return test_systems.build(chosen.system, chosen.size, quick=quick, **molecules(chosen))


def list_everything() -> int:
    """Print the names of test systems and methods."""
    from kcons.comparison import averages, methods, test_systems

    print("test systems")
    for name, entry in test_systems.SYSTEMS.items():
        print(f"  {name:<16} {entry.text} (default {entry.size} {entry.unit})")
    print(f"  {'FILE':<16} your own molecules; --constrain, --forces, --forcefield, --coordinates, --select")
    print("methods")
    for name, method in methods.METHODS.items():
        everywhere = method.engine != "OpenMM" or name in methods.GUESTS
        when = "" if everywhere else " (in OpenMM's test systems, or when named)"
        print(f"  {name:<27} {method.title}{when if method.usual else ' (only when named)'}")
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
    for name in (name for name in given if name not in OF_PLAN):
        raise InputError(f"a plan needs no forces; leave {option_of(name)} out", item=name)
    found = test_systems.plan(chosen.system, **given)
    sites = len(found.rows.virtual_sites)
    more = [f"{sites:,} virtual sites, placed by their molecules"] if sites else []
    print("\n".join([found.title, *found.notes, *more, str(found.motion.report(found.positions))]))
    return 0


# -- comparisons ------------------------------------------------------------------------------------


def _compare(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return list_everything()
    from kcons.comparison import report
    from kcons.comparison.progress import Watcher
    from kcons.steppers.files import ResultFolder, in_one_piece

    averages = _asks_for_averages(chosen)  # complain before any work
    budget = chosen.budget if chosen.budget is not None else (5.0 if chosen.quick else 20.0)
    folder: Path = chosen.out or Path(f"compare-{Path(chosen.system).name}{'-averages' if averages else ''}")
    settings = {name: getattr(chosen, name) for name in ("size", "quick", "dt")}
    settings |= {"averages": True, "slow": chosen.slow, "fast": chosen.fast} if averages else {}
    system = str(Path(chosen.system).resolve()) if Path(chosen.system).is_file() else chosen.system
    asked = {"system": system, **settings, "budget": budget, **molecules(chosen)}
    forces = (part for name in ("forces", "slow", "fast") for part in str(getattr(chosen, name)).split(","))
    paths = map(Path, (system, *(chosen.force_field or ()), chosen.coordinates or "", *forces))
    asked["contents"] = {str(path): sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()}
    files = [f"compare.{kind}" for kind in ("csv", "png", "txt")]
    results = ResultFolder(folder, files[0], {"asked": {"system": system}}, files, "a comparison")
    results.refuse_others()
    path = folder / files[0]
    done = _earlier(path, asked) if chosen.resume else None

    def keep(table: Any) -> None:
        table.attrs["asked"] = asked
        report.write_csv(path, table)

    with results.taken(), Watcher(shown=True) as watcher:
        for name in files[done is not None :]:  # an earlier table goes unless --resume goes on from it
            (folder / name).unlink(missing_ok=True)
        try:
            table, words = _measured(chosen, averages, budget=budget, done=done, keep=keep, watcher=watcher)
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
    """Whether averages are compared, and not trajectories.

    Raises
    ------
    InputError
        Options that do not go together; unknown names.
    """
    from kcons.comparison import averages, methods

    target, two, file = chosen.target_error, bool(chosen.slow or chosen.fast), Path(chosen.system or "")
    thermal, bad = two or chosen.criterion == "temperature", target is not None and not 0 < target < inf
    other = "--slow and --fast" if two else "--criterion temperature"
    lost = [name for name in NOT_WITH_CHEAP_FORCES if two and getattr(chosen, name) not in (None, "temperature")]
    poor = chosen.budget is not None and not 0 < chosen.budget < inf
    for item, wrong, said in (
        ("budget", poor, f"--budget is {chosen.budget}; give a positive number of seconds"),
        ("dt", chosen.dt == [], "--dt is empty; give time steps such as --dt 4,2,1"),
        ("target_error", bad, f"--target-error is {target}; give a positive number such as 1e-6"),
        ("criterion", thermal and target is not None, f"--target-error is an error of trajectories; leave {other} out"),
        *((name, True, f"{option_of(name)} does not go with --slow and --fast; leave it out") for name in lost),
        ("slow", two and chosen.slow is None, "--fast needs --slow: give the expensive forces, too"),
        ("fast", two and chosen.fast is None, "--slow needs --fast: give the cheap forces, too"),
        ("fast", two and chosen.slow == chosen.fast, "--slow and --fast are the same: give cheaper forces to --fast"),
        ("system", two and not file.is_file(), f"--slow and --fast are for files, not for {chosen.system!r}"),
    ):
        if wrong:
            raise InputError(said, item=item)
    if thermal:
        averages.choose_samplers(chosen.methods, two)
    else:
        methods.choose(chosen.methods)
    check_name(chosen)
    return thermal


def _earlier(path: Path, asked: dict[str, Any]) -> Any:
    """Rows to go on from."""
    from kcons.comparison import report
    from kcons.comparison.machine import environment

    if not path.is_file():
        raise InputError(f"there is no {path} to go on from; leave --resume out", item="resume")
    table, now = report.read_csv(path), environment()
    before = table.attrs["environment"]
    kept = ("commit", "cpu", "versions")
    made = [(name, before[name], now[name]) for name in kept] + [("settings", table.attrs.get("asked"), asked)]
    for name, old, new in made:
        if old != new:
            raise InputError(f"{path} is of {name} {old}, not {new}: give another --out", item="resume")
    return table


def _measured(chosen: argparse.Namespace, thermal: bool, **options: Any) -> tuple[Any, str]:
    """The table of a test system through methods, or through thermostats, and what is said of it."""
    from kcons.comparison import averages, measure, methods, ranking, report

    budget, watcher = options["budget"], options["watcher"]
    with watcher.piece("building the test system", 1):
        both = [argparse.Namespace(**{**vars(chosen), "forces": name}) for name in (chosen.slow, chosen.fast) if name]
        system, *cheap = [test_system(each, chosen.quick) for each in both or [chosen]]
    production = ""
    if thermal:
        given: dict[str, Any] = {"cheap": cheap[0] if cheap else None, "steps": chosen.dt}
        table = averages.compare_averages(system, chosen.methods, **given, **options)
        found = ranking.rank(table, "temperature")
    else:
        system = system if chosen.dt is None else system.with_time_steps(chosen.dt)
        reference = measure.reference_of(system, watcher)
        rounds = 1 if chosen.quick else measure.ROUNDS
        table = measure.compare(system, chosen.methods, rounds=rounds, reference=reference, **options)
        if (target := chosen.target_error) is not None:
            rows = ranking.find_steps(system, table, target, reference, budget=budget, watcher=watcher)
            if rows:  # the first time of a step has what is set up in it
                rows = [*table.to_dict("records"), *rows]
                table = measure.timed(system, rows, table.attrs, rounds=rounds, budget=budget, watcher=watcher)
        production = _production(chosen, system, budget, watcher)
        found = ranking.rank(table, limit=target)
    code = ""
    if found is not None and len(found.table):
        best, made_by = found.table.iloc[0], _expression(chosen)
        if thermal:
            code = averages.code(system, best.method, best.setting, best.friction, made_by)
        else:
            code = methods.code(system, best.method, best.setting, made_by)
    return table, report.text(table, found, code, production)


def _production(chosen: argparse.Namespace, system: Any, budget: float, watcher: Any) -> str:
    """Which step is right for averages, for a user's own molecule whose forces are cheap enough for the budget."""
    from kcons.comparison import measure, production, test_systems

    if chosen.system in test_systems.SYSTEMS or system.units.energy != "eV" or chosen.quick:
        return ""
    seconds = measure.force_seconds(system)
    if seconds > production.CHEAP * budget:
        ask = "run it, and ask kcons check TRAJECTORY --topology FILE --forces ..., or give cheap ones: --slow, --fast"
        return f"Forces take {seconds:.2g} s: too long to see here which step is right for averages; {ask}."
    checks = production.check_steps(system, PRODUCTION_STEPS, budget, watcher=watcher)
    return production.sentence(checks, system.units.time)


def _expression(chosen: argparse.Namespace) -> str:
    """Python that makes the test system, after `from kcons.comparison import test_systems`."""
    from kcons.comparison import test_systems

    said = ({"quick": True} if chosen.quick else {}) | molecules(chosen)
    size = [] if chosen.size is None else [str(chosen.size)]
    made = "build" if chosen.system in test_systems.SYSTEMS else "from_file"
    words = [repr(chosen.system), *size, *(f"{name}={value!r}" for name, value in said.items())]
    return f"test_systems.{made}({', '.join(words)})"


SYSTEM = (
    Option("system", "a built-in test system (--list), or a file: PDB, mmCIF, what MDAnalysis reads", nargs="?"),
    Option("--size", "number of molecules, bonds or particles", type=int),
    Option("--list", "list test systems and methods, and leave", action="store_true"),
    Option("--constrain", "beside rigid water, in molecules (default of files: hbonds)", choices=(*HELD, "none")),
    Option("--forcefield", "of molecules: files of OpenMM", nargs="+", dest="force_field", metavar="XML"),
    Option("--platform", "of OpenMM, for molecules (default: Reference up to 200 atoms, CPU above)"),
    Option("--add-hydrogens", "that a PDB or mmCIF file lacks, at pH 7", action="store_const", const=True),
    Option("--coordinates", "of a topology file that has none", metavar="FILE"),
    Option("--forces", "of files: openmm, its force fields (amber14-all,amber14/tip3p), or of ASE: emt, gfn2, ..."),
    Option("--select", "hold only what is within this selection of MDAnalysis, of files", metavar="WORDS"),
)


COMMANDS = (
    Command(
        "compare",
        "how much error each method makes, for how much time",
        "Which method to use, at which step: a ranking, a CSV file, a picture of error against cost.",
        (
            *SYSTEM,
            Option("--dt", "time steps of RATTLE, comma separated, in the unit that tables show", type=numbers),
            Option("--methods", "comma separated; all; openmm: those of OpenMM (default: the usual ones)", type=names),
            Option("--out", "folder for compare.csv, .png and .txt (default ./compare-SYSTEM[-averages])", type=Path),
            Option("--quick", "smaller system, half the horizon, a budget of 5 s", action="store_true"),
            Option("--budget", "seconds for each method (default 20)", type=float),
            Option("--resume", "go on from the rows of compare.csv in the folder", action="store_true"),
            Option("--target-error", "find the cheapest method and step that make at most this error", type=float),
            Option("--criterion", "error of trajectories (default), or temperature", choices=("error", "temperature")),
            Option("--slow", "of a file: expensive forces, as in --forces, with --fast", metavar="FORCES"),
            Option(
                "--fast", "cheap ones: how long may the step be? (--slow gfn2 --fast amber14-all)", metavar="FORCES"
            ),
        ),
        _compare,
    ),
    Command(
        "plan",
        "clusters, rank, degrees of freedom and the solver picked for each kind of cluster",
        "What the engine will do for a system, before any run. Files take --constrain, --coordinates, --select only.",
        SYSTEM,
        _plan,
    ),
)
