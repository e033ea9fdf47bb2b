"""The command `kcons freeenergy`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from kcons.cli.parser import Command, Option
from kcons.cli.scan import INCOMPLETE
from kcons.cli.terminal import say_written, show

if TYPE_CHECKING:
    from kcons.free_energy.windows.input_file import InputFile


def _free_energy(chosen: argparse.Namespace) -> int:
    from dataclasses import replace

    from kcons.comparison.progress import Watcher
    from kcons.free_energy import Windows, read_input
    from kcons.steppers.files import in_one_piece, text

    given = read_input(chosen.input, allow_modules=chosen.allow_module or ())
    if chosen.list:
        return _list(given)
    folder: Path = chosen.out or Path(chosen.input.stem)
    how = {**given.options, "workers": chosen.workers}
    windows = Windows(given.sampler, folder, given.settings, **how)
    # A folder belongs to settings, and pulls are slower than the way to a window.
    slow = replace(given.settings, pull=given.pull_steps)
    pulls = Windows(given.sampler, folder / "pulls", slow, **how) if given.pulls else None
    watcher = Watcher(shown=True)
    with windows.taken(), watcher, watcher.piece("windows", 1.0):

        def progress(done: int, total: int) -> None:
            watcher.advance(done / total)

        for each in filter(None, (windows, pulls)):
            each.progress = progress
        found = windows.run(given.targets)
        if given.improve and not found.failed:
            found = windows.improve(**given.improve)
        # Before pulls, which may fail.
        written = found.write(folder)
        said = ""
        if given.pulls is not None and pulls is not None:
            pulled = pulls.pull(**given.pulls)
            numbers, said = found.beside(pulled, given.pulls["start"], given.pulls["end"])
            written.append(folder / "pulls.json")
            with in_one_piece(written[-1]) as opened:
                opened.write(text(numbers).encode())
    show(found.table(), "\n".join([found.summary(), *([said] if said else [])]))
    say_written(written)
    return INCOMPLETE if found.failed else 0


def _list(given: InputFile) -> int:
    """Say what would be run. Coordinates have been looked at, calculators are not."""
    sides = 2 if given.options.get("both_sides", True) else 1
    parts = {name: getattr(given.settings, name) for name in ("pull", "equilibration", "production")}
    told = ", ".join(f"{name} {steps:,}" for name, steps in parts.items())
    runs = f"{sides} runs" if sides > 1 else "a run"
    print(f"{len(given.targets)} windows of {', '.join(given.sampler.names)}, {runs} each")
    print(f"{sum(parts.values()):,} steps a run: {told}; a sample every {given.settings.every}")
    if given.pulls:
        print(f"{given.pulls['count']} pulls both ways of {given.pull_steps:,} steps each")
    return 0


COMMAND = Command(
    "freeenergy",
    "free energy along held coordinates, from an input file",
    "Samples windows with coordinates held, and integrates their mean force. The input file is TOML, see the page on "
    "free energies. Goes on where it stopped: finished windows are kept one by one. Exit status 0; 2 for wrong use; 3 "
    "if some windows failed.",
    (
        Option("input", "structure, forces, coordinates and sampling, in TOML", type=Path, metavar="INPUT"),
        Option("--out", "folder of the windows and results (default ./INPUT without its ending)", type=Path),
        Option("--workers", "processes of this machine (default: one a core)", type=int),
        Option(
            "--allow-module",
            "let the input file take a calculator of this Python module, whose code then runs; may be repeated",
            action="append",
            metavar="MODULE",
        ),
        Option("--list", "say what would be run, and leave", action="store_true"),
    ),
    _free_energy,
    "windows",
)
