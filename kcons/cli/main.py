"""The command `kcons`. Everything heavy is imported by the subcommand that needs it."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Collection, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons import __version__
from kcons.cli import check, completion, doctor, freeenergy, listing, scan, studies, warmup
from kcons.cli.parser import Parser
from kcons.cli.terminal import (
    Terminated,
    console,
    ended_in_order,
    names,
    numbers,
    patient_streams,
    rendered,
    say_written,
    show,
    warnings_in_a_line,
)
from kcons.errors import InputError, KconsError, did_you_mean, with_extra

#: Options of `kcons compare` and `kcons plan` by what can be run.
OF_FLUIDS = frozenset({"size", "seed", "dt", "methods", "out", "quick", "budget", "criterion"})
OF_STEPS_OF_FLUIDS = OF_FLUIDS - {"criterion"} | {"slow", "fast"}
OF_STEPS_OF_FILES = OF_STEPS_OF_FLUIDS - {"size"} | {"coordinates", "constrain", "select", "rigid_residues", "platform"}
OF_THE_WHOLE = frozenset({"all", "only", "fresh", "out", "quick", "list"})

if TYPE_CHECKING:
    from kcons.comparison.test_systems import TestSystem


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    The exit status: 0; of `check`, 1 for a violation and 3 where not all could be told; of `scan` and
    `freeenergy`, 3 where some points or windows failed; 2 for an error that the user can mend; 130 when interrupted,
    143 when terminated.
    """
    try:
        with patient_streams():
            return _main(arguments)
    except OSError as error:
        print(f"kcons: the output cannot be written: {error}", file=sys.stderr)
        return 2


def _main(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    chosen = parser.parse_fully(arguments)
    if chosen.version:
        print(f"kcons {__version__}")
        return 0
    if chosen.command is None:
        parser.print_help()
        return 0
    try:
        with ended_in_order(), warnings_in_a_line():
            return int(chosen.run(chosen))
    except ModuleNotFoundError as error:
        explained = with_extra(error, f"kcons {chosen.command}")
        if not isinstance(explained, KconsError):
            raise
        print(f"kcons: {explained}", file=sys.stderr)
        return 2
    except (FileExistsError, NotADirectoryError) as error:
        print(
            f"kcons: {error.filename}: there is a file where a folder has to be; give another folder (--out)",
            file=sys.stderr,
        )
        return 2
    except (KconsError, OSError) as error:
        print(f"kcons: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"kcons: there is not enough memory: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        ended, status = ("terminated", 143) if isinstance(stop, Terminated) else ("interrupted", 130)
        kept = getattr(chosen, "kept", None)
        more = f"; finished {kept} are kept: run again to resume" if kept else ""
        print(f"kcons: {ended}{more}", file=sys.stderr)
        return status


def commands() -> dict[str, Parser]:
    """The parser of each command."""
    return _parser().commands()


def _parser() -> Parser:
    parser = Parser(prog="kcons", description="Constraints in molecular dynamics.")
    parser.add_argument("--version", action="store_true", help="print the version and leave")
    commands = parser.add_subparsers(title="commands", dest="command")

    names_help = "one of the built-in test systems, --list shows them; or a file: PDB, mmCIF, or what MDAnalysis reads"
    common = Parser(add_help=False)
    common.add_argument("scene", nargs="?", metavar="SYSTEM", help=names_help)
    common.add_argument("--size", type=int, help="number of molecules, bonds or particles")
    common.add_argument("--seed", type=int, default=1, help="of the initial velocities (default 1)")
    molecules = common.add_argument_group("molecules in OpenMM: alanine, dhfr, dhfr-water, villin, and files")
    molecules.add_argument(
        "--constrain",
        choices=("hbonds", "allbonds", "hangles", "allangles", "none"),
        help="beside rigid water (default hbonds for files; the last two for files that MDAnalysis reads)",
    )
    molecules.add_argument(
        "--forcefield", nargs="+", metavar="XML", help="files of OpenMM (default amber14-all.xml amber14/tip3pfb.xml)"
    )
    molecules.add_argument("--add-hydrogens", action="store_true", help="add hydrogens that a file lacks, at pH 7")
    molecules.add_argument("--platform", help="of OpenMM (default: Reference up to 200 atoms, CPU above)")
    files = common.add_argument_group("any file that MDAnalysis reads; these options make it read PDB files, too")
    files.add_argument("--coordinates", type=Path, metavar="FILE", help="coordinates, where the topology file has none")
    files.add_argument(
        "--forces",
        help="openmm (default), force fields of OpenMM by name, comma separated (amber14-all,amber14/tip3p), or emt, "
        "lj, tip3p, gfn1, gfn2, or another calculator of ASE; not for plan",
    )
    files.add_argument("--select", metavar="WORDS", help="hold only what is within this selection of MDAnalysis")
    files.add_argument("--rigid-residues", nargs="+", metavar="NAME", help="residues held rigid")
    common.add_argument("--list", action="store_true", help="list test systems and methods, and leave")

    compare = commands.add_parser(
        "compare",
        parents=[common],
        help="how much error each method makes, for how much time",
        description="Run a test system through several methods: a table, a plot and a JSON file of error against cost. "
        "Trajectories are compared, or averages at a temperature.",
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
        help="folder for compare.json, .png and .txt (default ./compare-SYSTEM, with --fast ./compare-SYSTEM-steps)",
    )
    compare.add_argument("--quick", action="store_true", help="smaller system, half the horizon, a budget of 5 s")
    compare.add_argument("--budget", type=float, help="seconds for each method (default 20)")
    compare.add_argument(
        "--target-error",
        type=float,
        metavar="E",
        help="also find the cheapest method and step that make at most this error, by measurement",
    )
    studies.add_steps(compare)
    compare.add_argument(
        "--criterion",
        choices=("error", "drift", "temperature"),
        help="what methods are ranked by: error of the trajectory (default), drift of the energy; for thermostats the "
        "temperature of the configurations",
    )
    report = compare.add_argument_group("the whole comparison")
    report.add_argument(
        "--all",
        action="store_true",
        help="every test system, on one page (default ./compare-all; --quick: five minutes); resumes what stopped",
    )
    report.add_argument(
        "--only", type=names, metavar="PARTS", help="of these, comma separated (--all --list shows them)"
    )
    report.add_argument("--fresh", action="store_true", help="compare again what is there already")
    report.add_argument("--redraw", type=Path, metavar="DIR", help="pictures and page from the numbers in DIR, no run")
    report.add_argument("--into", type=Path, metavar="PAGE", help="with --redraw: the table into this page, too")
    compare.set_defaults(run=_compare)

    plan = commands.add_parser(
        "plan",
        parents=[common],
        help="clusters, rank, degrees of freedom and the solver picked for each kind of cluster",
        description="What the engine will do for a system, before any run.",
    )
    plan.set_defaults(run=_plan)
    check.add(commands)
    completion.add(commands, _parser)
    doctor.add(commands)
    freeenergy.add(commands)
    scan.add(commands)
    studies.add(commands)
    warmup.add(commands)

    return parser


# -- compare ----------------------------------------------------------------------------------------


def _compare(chosen: argparse.Namespace) -> int:
    if chosen.all or chosen.redraw is not None or chosen.only or chosen.fresh or chosen.into is not None:
        return _compare_all(chosen)
    if chosen.list:
        return listing.of_everything()
    from kcons.comparison import test_systems

    budget = chosen.budget if chosen.budget is not None else (5.0 if chosen.quick else 20.0)
    folder: Path = chosen.out or Path(f"compare-{Path(chosen.scene or '').stem}")
    if chosen.dt is not None and not chosen.dt:
        raise InputError("--dt is empty; give time steps such as --dt 4,2,1", item="dt")
    asked = {
        "system": _system(chosen.scene),
        **{name: getattr(chosen, name) for name in ("size", "seed", "quick", "dt")},
        **_molecules(chosen),
    }
    target: float | None = chosen.target_error
    if target is not None and not (target > 0 and isfinite(target)):
        raise InputError(f"--target-error is {target:g}; give a positive number such as 1e-6", item="target_error")
    if chosen.slow is not None or chosen.fast is not None:
        known = OF_STEPS_OF_FLUIDS if chosen.scene in test_systems.FLUIDS else OF_STEPS_OF_FILES
        _take_only(chosen, known, "does not go with --slow and --fast; leave it out")
        _check_name(chosen)

        def with_forces(forces: str) -> TestSystem:
            return _test_system(argparse.Namespace(**{**vars(chosen), "forces": forces}))

        folder = chosen.out or folder.with_name(f"{folder.name}-steps")  # beside what compares trajectories
        return studies.compare_steps(chosen, budget, folder, asked["system"], with_forces)
    if chosen.scene in test_systems.FLUIDS:
        if target is not None:
            raise InputError("--target-error is for trajectories; a fluid has averages", item="target_error")
        if chosen.criterion not in (None, "temperature"):
            raise InputError(
                f"--criterion {chosen.criterion} is for trajectories; thermostats are ranked by temperature",
                item="criterion",
            )
        return _compare_averages(chosen, budget, folder, asked)
    if chosen.criterion == "temperature":
        raise InputError(
            f"--criterion temperature is for {', '.join(test_systems.FLUIDS)}, whose averages are known. Whether a "
            "step is right for averages of your own system: run it, and ask kcons check TRAJECTORY --topology FILE "
            "--forces ..., or kcons compare FILE --slow FORCES --fast FORCES",
            item="criterion",
        )
    if chosen.criterion == "drift" and target is not None:
        raise InputError("--target-error is an error of trajectories; leave --criterion drift out", item="criterion")
    return _compare_trajectories(chosen, budget, folder, asked)


def _compare_trajectories(chosen: argparse.Namespace, budget: float, folder: Path, asked: dict[str, Any]) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison.methods import methods
    from kcons.comparison.methods.snippets import code
    from kcons.comparison.study import report_files
    from kcons.comparison.work_precision import answer, measure, recommendation, report
    from kcons.comparison.work_precision.timing_rounds import QUICK_ROUNDS, ROUNDS

    methods.chosen(chosen.methods)  # complain before any work
    _check_name(chosen)
    results = report_files.results(folder, "compare", asked["system"])
    results.refuse_others()
    target: float | None = chosen.target_error
    with Bars() as watcher:
        compiling = "" if measure.kernels_cached() else "; compiling kernels (once)"
        with watcher.piece(f"building the test system{compiling}", 1):
            test_system = _test_system(chosen, quick=chosen.quick)
        if chosen.dt is not None:
            test_system = test_system.with_time_steps(chosen.dt)
        folder.mkdir(parents=True, exist_ok=True)  # complain before the long part
        reference = None if target is None else measure.reference_of(test_system, watcher)
        rounds = QUICK_ROUNDS if chosen.quick else ROUNDS
        result = measure.compare(
            test_system,
            methods=chosen.methods,
            budget=budget,
            watcher=watcher,
            settings=asked,
            reference=reference,
            rounds=rounds,
            partial=True,
        )
        if target is not None and reference is not None and "interrupted" not in result.settings:
            result = recommendation.recommend(
                test_system,
                result,
                target,
                reference=reference,
                made_by=_expression(chosen),
                budget=budget,
                watcher=watcher,
                rounds=rounds,
            )
    terminal = console()
    explained = report.explanation(result)
    ranked = answer.answer(result, chosen.criterion or "error", target)
    first = [] if ranked is None else [answer.text(ranked)]
    if result.recommendation is not None:  # which has its own sentence and lines of code
        first = [recommendation.sentences(result)]
        first += [answer.places(ranked)] if ranked is not None and ranked.ranked else []
    elif ranked is not None and ranked.ranked:
        best = ranked.ranked[0].point
        first.append(f"In Python:\n\n{code(test_system, best.method, best.number, _expression(chosen))}".rstrip())
    for words in first:
        terminal.print(words + "\n", highlight=False, markup=False, soft_wrap=True)
    show(report.table(result, narrow=not report.fits(result, terminal.width)), explained, terminal)
    with results.taken():
        say_written(report.write(result, folder, tables=[*first, rendered(report.table(result)), explained]))
    return 130 if "interrupted" in result.settings else 0


def _system(scene: str | None) -> str:
    """What results belong to: a test system by name, or a file by its path."""
    return str(Path(scene).resolve()) if scene and Path(scene).is_file() else str(scene)


def _expression(chosen: argparse.Namespace) -> str:
    """Python that makes the test system, after `from kcons.comparison import test_systems`."""
    from kcons.comparison import test_systems

    said: dict[str, Any] = {"seed": chosen.seed} if chosen.seed != 1 else {}
    said |= {"quick": True} if chosen.quick else {}
    said |= _molecules(chosen)
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


def _compare_all(chosen: argparse.Namespace) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison.work_precision import parts_of_the_whole, whole

    every = "--all runs all test systems and methods; choose parts of it by --only"
    if chosen.scene is not None:
        raise InputError(every, item="all")
    if chosen.redraw is not None:
        _take_only(chosen, {"all", "redraw", "into"}, "does not go with --redraw, which runs nothing; leave it out")
    elif chosen.into is not None:
        raise InputError("--into goes with --redraw DIR", item="into")
    else:
        _take_only(chosen, OF_THE_WHOLE, f"does not go with --all: {every}")
    if chosen.list:
        print("parts of the whole comparison")
        for item in parts_of_the_whole.PLAN:
            print(f"  {item.key:<22} {item.heading}")
        return 0
    if chosen.redraw is not None:
        with Bars() as watcher:
            written = whole.redraw(chosen.redraw, chosen.into, watcher)
        say_written(written)
        return 0
    folder: Path = chosen.out or Path("compare-all")
    items = parts_of_the_whole.chosen(chosen.only)
    results = whole.results(folder)
    with results.taken(), Bars() as watcher:
        path = whole.run(items, folder, quick=chosen.quick, fresh=chosen.fresh, watcher=watcher)
    print(f"wrote {path}, and beside it JSON, PNG and TXT of every part")
    return 0


def _compare_averages(chosen: argparse.Namespace, budget: float, folder: Path, asked: dict[str, Any]) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison import test_systems
    from kcons.comparison.averages import report as sampling_report
    from kcons.comparison.averages import sampling
    from kcons.comparison.study import report_files
    from kcons.comparison.work_precision import answer

    sampling.chosen(chosen.methods)  # complain before any work
    _check_name(chosen)
    _take_only(chosen, OF_FLUIDS, "is not for fluids; leave it out")
    results = report_files.results(folder, "compare", asked["system"])
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
            settings=asked,
            partial=True,
        )
    table, explained = sampling_report.table(result), sampling_report.explanation(result)
    ranked = answer.answer_of_averages(result)
    first = [] if ranked is None else [answer.text(ranked)]
    terminal = console()
    for words in first:
        terminal.print(words + "\n", highlight=False, markup=False, soft_wrap=True)
    show(table, explained, terminal)
    with results.taken():
        say_written(sampling_report.write(result, folder, tables=[*first, rendered(table), explained]))
    return 130 if "interrupted" in result.settings else 0


def _take_only(chosen: argparse.Namespace, known: Collection[str], why: str) -> None:
    """Complain of an option that would say nothing."""
    for name, option in commands()[chosen.command].given(chosen).items():
        if name not in known:
            raise InputError(f"{option} {why}", item=name)


def _check_name(chosen: argparse.Namespace) -> None:
    from kcons.comparison import test_systems

    known = ", ".join((*test_systems.SYSTEMS, *test_systems.FLUIDS))
    if chosen.scene is None:
        raise InputError(f"name a test system: {known}; or a PDB file", item="scene")
    if test_systems.is_file(chosen.scene) or test_systems.is_other_file(chosen.scene):
        if not Path(chosen.scene).is_file():
            raise InputError(f"there is no file {chosen.scene}", item="scene")
        if chosen.size is not None:
            raise InputError("a file has the size it has; leave --size out", item="size")
    elif chosen.scene not in test_systems.SYSTEMS and chosen.scene not in test_systems.FLUIDS:
        raise InputError(
            f"there is no test system {chosen.scene!r}"
            f"{did_you_mean(chosen.scene, (*test_systems.SYSTEMS, *test_systems.FLUIDS))}; "
            f"there are {known}; or give a PDB file",
            item="scene",
        )
    if chosen.seed < 0:
        raise InputError(f"the seed is {chosen.seed}; give a non-negative number", item="seed")


def _molecules(chosen: argparse.Namespace) -> dict[str, Any]:
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


def _test_system(chosen: argparse.Namespace, *, quick: bool = False) -> TestSystem:
    from kcons.comparison import test_systems

    if test_systems.is_file(chosen.scene) or test_systems.is_other_file(chosen.scene):
        if chosen.add_hydrogens and test_systems.by_mdanalysis(chosen.scene, _molecules(chosen)):
            raise InputError("--add-hydrogens is for PDB and mmCIF files with OpenMM", item="add_hydrogens")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            test_system = test_systems.from_file(chosen.scene, chosen.seed, quick=quick, **_molecules(chosen))
        for text in dict.fromkeys(str(w.message) for w in said if w.category is UserWarning):
            print(f"kcons: {text}", file=sys.stderr)
        return test_system
    if chosen.add_hydrogens:
        raise InputError("--add-hydrogens is for files; the built-in molecules have theirs", item="add_hydrogens")
    for name in sorted(test_systems.FILE_OPTIONS & set(_molecules(chosen))):
        raise InputError(f"--{name.replace('_', '-')} is for files, not for built-in test systems", item=name)
    return test_systems.build(chosen.scene, chosen.size, chosen.seed, quick=quick, **_molecules(chosen))


# -- plan -------------------------------------------------------------------------------------------


def _plan(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return listing.of_everything()
    from kcons.comparison import test_systems

    _check_name(chosen)
    given = _molecules(chosen)
    if test_systems.is_other_file(chosen.scene) and test_systems.by_mdanalysis(chosen.scene, given):
        return _plan_file(chosen, given)
    if chosen.scene in test_systems.FLUIDS:
        _take_only(chosen, OF_FLUIDS, "is not for fluids; leave it out")
        fluid = test_systems.build_fluid(chosen.scene, chosen.size, chosen.seed)
        print(fluid.title)
        print(fluid.motion.report(fluid.positions))
        return 0
    test_system = _test_system(chosen)
    print(test_system.title)
    print(test_system.motion.report(test_system.positions, test_system.velocities))
    return 0


def _plan_file(chosen: argparse.Namespace, given: dict[str, Any]) -> int:
    """Nothing but the rows: no forces are needed."""
    from kcons.comparison.test_systems import any_file

    for name in ("forces", "force_field", "platform", "add_hydrogens"):
        if name in given:
            option = name.replace("_", "-") if name == "add_hydrogens" else name.replace("_", "")
            raise InputError(f"a plan needs no forces; leave --{option} out", item=name)
    found = any_file.plan(chosen.scene, **given)
    print(found.title)
    for note in found.notes:
        print(note)
    sites = len(found.rows.virtual_sites)
    if sites:
        print(f"{sites:,} virtual sites, placed by their molecules")
    print(found.motion.report(found.positions))
    return 0
