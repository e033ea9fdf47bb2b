"""The command `kcons check`."""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

from kcons.cli.terminal import HELD, Command, Option, rendered, say_written, show
from kcons.constraints.arguments import positive
from kcons.errors import InputError, KconsError, UnreadableError

#: The exit status of each result; 2 is wrong use.
EXIT = {"kept": 0, "tolerated": 0, "violated": 1, "incomplete": 3}
#: Options that are arguments of `check_trajectory`, by the same names.
AS_GIVEN = "constrain", "select", "targets", "tolerance", "precision", "frames", "format", "topology_format", "workers"


def _check(chosen: argparse.Namespace) -> int:
    from kcons.mdanalysis.check import report
    from kcons.mdanalysis.check.constraint_check import check_trajectory

    path: Path = chosen.trajectory
    folder: Path = chosen.out or Path(f"check-{path.stem}")
    report.results(folder, path).refuse_others()  # complain before any work
    for name in ("no_rigid_water", "format", "topology_format"):
        if chosen.forces is not None and getattr(chosen, name):
            raise InputError(f"--forces does not go with --{name.replace('_', '-')}; leave one out", item="forces")
    if chosen.temperature is not None:
        if chosen.forces is None:
            raise InputError("--temperature needs --forces, from which temperatures are found", item="temperature")
        positive(chosen.temperature, "temperature")
    given = {name: getattr(chosen, name) for name in AS_GIVEN}
    try:
        result = check_trajectory(path, chosen.topology, rigid_water=not chosen.no_rigid_water, **given)
    except UnreadableError as error:
        print(f"kcons: {error}", file=sys.stderr)
        found = {"trajectory": str(path), "status": "incomplete", "verdict": str(error)}
        say_written(report.write(folder, path, found))
        return EXIT["incomplete"]
    failed = ""
    none = "no temperatures of the configurations:"
    if chosen.forces is not None and result.violated:
        result.remarks.append(f"{none} frames are off the constraints; say what the run held")
    elif chosen.forces is not None:
        from kcons.comparison import trajectory_temperatures

        where, held = (path, chosen.topology), {"constrain": chosen.constrain, "select": chosen.select}
        try:
            kelvin = trajectory_temperatures.along(*where, chosen.forces, result.frames, **held)
            result.remarks += trajectory_temperatures.sentences(kelvin, chosen.temperature)
        except KconsError as error:  # the check itself is done, and is worth its time
            failed = " ".join(str(error).split())
            result.remarks.append(f"{none} {failed}")
            print(f"kcons: {failed}", file=sys.stderr)
    summary, units, rows, verdict = report.page(result)
    picture = io.BytesIO()
    report.plot(result, picture)
    text = "\n".join([summary, rendered(units), rendered(rows), result.verdict])
    written = report.write(folder, path, result.to_dict(), picture.getvalue(), text)
    show(summary, units, rows, verdict)
    say_written(written)
    return 2 if failed else EXIT[result.status]


COMMANDS = (
    Command(
        "check",
        "how well a trajectory of any engine kept its constraints",
        "How far each constraint was from its target, judged by the precision of the file. Exit status 0: kept; 1: "
        "violated; 2: wrong use; 3: incomplete, such as a file that ends too early, or has a NaN.",
        (
            Option("trajectory", "any trajectory that MDAnalysis reads", type=Path),
            Option("--topology", "any topology that MDAnalysis reads", type=Path, required=True),
            Option("--format", "of the trajectory, where its name does not tell: LAMMPSDUMP, ...", metavar="NAME"),
            Option("--topology-format", "of the topology, where its name does not tell", metavar="NAME"),
            Option("--constrain", f"{', '.join(HELD)}, none (default hbonds)", default="hbonds", metavar="NAME"),
            Option("--select", "rows within this selection only (MDAnalysis' language)", default="all"),
            Option("--no-rigid-water", "do not expect water to be rigid", action="store_true"),
            Option("--targets", "first (frame; default), mean, topology (coordinates), TOML file", default="first"),
            Option("--tolerance", "relative, of the engine (default 1e-4)", type=float, default=1e-4),
            Option("--precision", "step of the coordinates in the file, Å, where not known", type=float),
            Option("--frames", "frames to look at (default all)", metavar="A:B:STEP"),
            Option("--workers", "processes (default 1)", type=int, default=1),
            Option("--forces", "also temperatures of the configurations, by forces as for compare (gfn2, ...)"),
            Option("--temperature", "with --forces: whether the temperatures are this one", type=float, metavar="K"),
            Option("--out", "folder for check.json, .png and .txt (default ./check-TRAJECTORY)", type=Path),
        ),
        _check,
    ),
)
