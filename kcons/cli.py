"""The command `kcons`. Everything heavy is imported by the subcommand that needs it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kcons import __version__
from kcons.errors import InputError, KconsError

if TYPE_CHECKING:
    from rich.console import Console

    from kcons.compare import Comparison
    from kcons.scenes import Scene


#: Columns of a page that is no terminal.
WIDE = 150


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status: 0, 2 for an error that the user can mend, 130 when interrupted."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if chosen.version:
        print(f"kcons {__version__}")
        return 0
    if chosen.command is None:
        parser.print_help()
        return 0
    try:
        return int(chosen.run(chosen))
    except (KconsError, OSError) as error:
        print(f"kcons: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("kcons: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="kcons", description="Constraints in molecular dynamics.")
    parser.add_argument("--version", action="store_true", help="print the version and leave")
    commands = parser.add_subparsers(title="commands", dest="command")

    scene_help = "one of the built-in scenes; --list shows them"
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("scene", nargs="?", help=scene_help)
    common.add_argument("--size", type=int, help="number of molecules, bonds or particles")
    common.add_argument("--seed", type=int, default=1, help="of the initial velocities (default 1)")
    common.add_argument("--list", action="store_true", help="list scenes and methods, and leave")

    compare = commands.add_parser(
        "compare",
        parents=[common],
        help="how much error each method makes, for how much time",
        description="Run a scene through several methods; table, plot and JSON of error against cost.",
    )
    compare.add_argument(
        "--dt",
        type=_numbers,
        help="time steps, comma separated, in the unit the scene shows; "
        "steppers with several force evaluations a step take longer ones at the same cost",
    )
    compare.add_argument("--methods", type=_names, help="methods, comma separated, or all (default: the usual ones)")
    compare.add_argument("--out", type=Path, help="folder for compare.json, .png and .txt (default ./compare-SCENE)")
    compare.add_argument("--quick", action="store_true", help="smaller system, half the horizon, a budget of 5 s")
    compare.add_argument("--budget", type=float, help="seconds for each method (default 20)")
    compare.set_defaults(run=_compare)

    plan = commands.add_parser(
        "plan",
        parents=[common],
        help="clusters, rank, degrees of freedom and the solver picked for each kind of cluster",
        description="What the engine will do for a scene, before any run.",
    )
    plan.set_defaults(run=_plan)
    return parser


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",") if word.strip()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 4,2,1") from None


def _names(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


# -- compare ----------------------------------------------------------------------------------------


def _compare(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return _list()
    from kcons import compare, methods, report
    from kcons.progress import Bars

    methods.chosen(chosen.methods)  # complain before any work
    budget = chosen.budget if chosen.budget is not None else (5.0 if chosen.quick else 20.0)
    folder: Path = chosen.out or Path(f"compare-{chosen.scene}")
    if chosen.dt is not None and not chosen.dt:
        raise InputError("--dt is empty; give time steps such as --dt 4,2,1", item="dt")
    asked = {"size": chosen.size, "seed": chosen.seed, "quick": chosen.quick, "dt": chosen.dt}
    _check_scene(chosen)
    with Bars() as watcher:
        watcher.begin("building the scene" + ("" if compare.kernels_cached() else "; compiling kernels (once)"), 1)
        scene = _scene(chosen, quick=chosen.quick)
        watcher.end()
        if chosen.dt is not None:
            scene = scene.with_time_steps(chosen.dt)
        folder.mkdir(parents=True, exist_ok=True)  # complain before the long part
        result = compare.compare(scene, methods=chosen.methods, budget=budget, watcher=watcher, settings=asked)
    text = _rendered(result)
    console = _console()
    console.print(report.table(result, narrow=not report.fits(result, console.width)))
    console.print(report.explanation(result), highlight=False, markup=False)
    for path in report.write(result, folder, tables=[text, report.explanation(result)]):
        print(f"wrote {path}")
    return 0


def _check_scene(chosen: argparse.Namespace) -> None:
    from kcons import scenes

    if chosen.scene is None:
        raise InputError(f"name a scene: {', '.join(scenes.SCENES)}", item="scene")
    if chosen.scene not in scenes.SCENES:
        raise InputError(f"there is no scene {chosen.scene!r}; there are {', '.join(scenes.SCENES)}", item="scene")
    if chosen.seed < 0:
        raise InputError(f"the seed is {chosen.seed}; give a non-negative number", item="seed")


def _scene(chosen: argparse.Namespace, *, quick: bool = False) -> Scene:
    from kcons import scenes

    return scenes.build(chosen.scene, chosen.size, chosen.seed, quick=quick)


def _rendered(result: Comparison) -> str:
    """The table as plain text, wide enough for all columns."""
    from io import StringIO

    from rich.console import Console

    from kcons import report

    page = StringIO()
    Console(file=page, width=WIDE, color_system=None).print(report.table(result))
    return page.getvalue().rstrip()


def _console() -> Console:
    from rich.console import Console

    console = Console()
    # Into a file or a pipe there is no width to fit into.
    return console if console.is_terminal else Console(width=WIDE)


# -- plan and list ----------------------------------------------------------------------------------


def _plan(chosen: argparse.Namespace) -> int:
    if chosen.list:
        return _list()
    _check_scene(chosen)
    scene = _scene(chosen)
    print(scene.title)
    print(scene.motion.report(scene.positions, scene.velocities))
    return 0


def _list() -> int:
    from kcons import methods, scenes

    print("scenes")
    for name, entry in scenes.SCENES.items():
        print(f"  {name:<16} {entry.text} (default {entry.size} {entry.unit})")
    print("methods")
    for name, method in methods.METHODS.items():
        print(f"  {name:<16} {method.title}{'' if method.usual else ' (only when named)'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
