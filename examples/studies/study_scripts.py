"""Shared parts of scripts that measure and print: calls timed in turn, tables, command line options."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from kcons.comparison.study.asked import picked
from kcons.comparison.study.tables import Table, terminal
from rich.console import Console

from kcons.comparison import json_files
from kcons.comparison.machine import environment
from kcons.comparison.progress import Watcher
from kcons.errors import InputError
from kcons.thermostats.correlated_series import slope as slope

if TYPE_CHECKING:
    from rich.table import Table as RichTable


Name = TypeVar("Name")
Found = TypeVar("Found")


class Kept:
    """A result in a file, with the code and the settings that made it.

    Parameters
    ----------
    path : Path or None
        None: nothing is kept.
    made_by : mapping
        Code and settings.
    form : str, optional
        The entry 'format' of the file.
    under : str
        The entry for `made_by`.
    pack : callable, optional
        Data to the text of the file.

    Attributes
    ----------
    head : dict
        What every such file begins with: format, code and settings, machine.
    """

    def __init__(
        self,
        path: Path | None,
        made_by: Mapping[str, Any],
        *,
        form: str = "",
        under: str = "made_by",
        pack: Callable[[Mapping[str, Any]], str] = json_files.text,
    ) -> None:
        self.path, self.form, self.under, self.pack = path, form, under, pack
        self.head = {**({"format": form} if form else {}), under: made_by, "environment": environment()}

    def earlier(self) -> dict[str, Any]:
        """What the file holds, if the same code made it with the same settings; otherwise nothing."""
        if self.path is None:
            return {}
        try:
            found = json_files.read(self.path, self.form)
        except (OSError, InputError):
            return {}
        return found if found.get(self.under) == self.head[self.under] else {}

    def put(self, result: Mapping[str, Any]) -> None:
        """Into the file, in one piece."""
        if self.path is not None:
            json_files.write(self.path, self.pack({**self.head, **result}))


def work_off(
    what: str,
    pieces: Mapping[Name, Callable[[], Found]],
    put: Callable[[Name, Found], Any],
    known: Container[Name] = (),
    watcher: Watcher | None = None,
) -> None:
    """Do one piece of work after another, but for those that are known.

    Parameters
    ----------
    what : str
        For the progress bar.
    pieces : mapping of names to callables
    put : callable
        Gets the name and what was found.
    known : container of names, optional
    watcher : Watcher, optional
    """
    watching = watcher or Watcher()
    with watching.piece(what, max(len(pieces), 1)):
        for done, (name, piece) in enumerate(pieces.items(), 1):
            if name not in known:
                put(name, piece())
            watching.advance(done)


def in_turn(
    calls: Mapping[str, Callable[[], Any]], repeats: int, clock: Callable[[], float] = process_time
) -> dict[str, list[float]]:
    """Seconds of each call, `repeats` times, in turn: disturbances of the machine then affect all calls alike.

    Parameters
    ----------
    calls : mapping of name to callable
    repeats : int
    clock : callable, optional
        Seconds; CPU time of this process by default.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = clock()
            call()
            seconds[name].append(clock() - begun)
    return seconds


def ratio(first: Sequence[float], second: Sequence[float]) -> float:
    """Median over the turns of first/second."""
    return float(np.median(np.array(first) / np.array(second)))


def speeds(seconds: Mapping[str, Sequence[float]], steps: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of one of the `steps` of a call, and the speed relative to the first of them all.

    Parameters
    ----------
    seconds : mapping of name to sequence of float
        From `in_turn`.
    steps : int
    """
    first = next(iter(seconds.values()))
    return {
        name: {"ms": 1e3 * float(np.median(found)) / steps, "ratio": ratio(first, found)}
        for name, found in seconds.items()
    }


def table(
    title: str, headings: Sequence[str], words: Collection[str] = (), rows: Iterable[Sequence[str]] = ()
) -> RichTable:
    """A table whose columns are numbers, but for those whose headings are in `words`.

    Parameters
    ----------
    title : str
    headings : sequence of str
    words : collection of str, optional
    rows : iterable of sequence of str, optional
    """
    columns = [k for k, heading in enumerate(headings) if heading in words]
    return terminal(Table(headings, list(rows), columns, title=title))


def options(about: str | None, *, full: str) -> argparse.ArgumentParser:
    """The parser of a script: ``--full`` (explained by `full`), ``--out`` and ``--show``."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help=full)
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument("--show", type=Path, help="print what an earlier result has and stop")
    return parser


def script(
    parser: argparse.ArgumentParser,
    measure: Callable[[argparse.Namespace], dict[str, Any]],
    show: Callable[[dict[str, Any]], None],
    arguments: Sequence[str] | None = None,
) -> None:
    """Measure, write the result as JSON and show it; with ``--show`` only show an earlier one.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        From `options`.
    measure : callable
        Gets what was chosen.
    show : callable
    arguments : sequence of str, optional
        Those of the command line by default.
    """
    chosen = parser.parse_args(arguments)
    if chosen.show:
        show(json_files.read(chosen.show))
        return
    result = measure(chosen)
    if chosen.out:
        json_files.write(chosen.out, result)
    show(result)


def continued(out: Path | None, measure: Callable[..., dict[str, Any]], *, quick: bool) -> dict[str, Any]:
    """A measurement that goes on from what the file `out` has, and is written to it after each of its parts.

    What other code measured, or with other settings, is not gone on from.

    Parameters
    ----------
    out : Path or None
        None: from the beginning, and nothing is written.
    measure : callable
        Gets `quick`, `keep`, which takes what has been measured so far, and `earlier`, what the file has or None.
    quick : bool
    """
    kept = Kept(out, {"commit": environment()["commit"], "quick": quick})
    earlier = {name: value for name, value in kept.earlier().items() if name not in kept.head}
    return measure(quick=quick, keep=kept.put, earlier=earlier or None)


def script_of_parts(
    about: str | None,
    measure: Callable[..., dict[str, Any]],
    show: Callable[[dict[str, Any], Console], None],
    draw: Callable[[dict[str, Any], str], None],
    *,
    width: int,
) -> None:
    """`continued` as a command: ``--full --out F`` measures, ``--show F`` prints, ``--show F --draw P`` draws as well.

    Parameters
    ----------
    about : str
    measure : callable
        As for `continued`.
    show, draw : callable
        Get the results, and the console or the name of the picture.
    width : int
        Of the console, in characters.
    """
    parser = options(about, full="long runs")
    parser.add_argument("--draw", metavar="PNG", help="with --show: the curves, into this file")
    chosen, console = parser.parse_args(), Console(width=width)
    if not chosen.show:
        show(continued(chosen.out, measure, quick=not chosen.full), console)
        return
    result = json_files.read(chosen.show)
    show(result, console)
    if chosen.draw:
        draw(result, chosen.draw)


def script_of_runs(
    about: str | None,
    runs: Mapping[str, Callable[[], dict[str, Any]]],
    short: Callable[[], None],
    show: Callable[[dict[str, Any]], None],
    out: Path,
) -> None:
    """Runs of which each stands for itself, as a command: ``--full NAME ...`` puts those into the file, or all.

    A run is in the file as soon as it is done, beside what the file holds already, with the machine and the commit it
    was made by; without ``--full`` a short one is shown and nothing written.

    Parameters
    ----------
    about : str
    runs : mapping of name to callable
    short : callable
    show : callable
        Gets the results, for ``--show FILE``.
    out : Path
        Where results go unless ``--out`` says so.
    """
    parser = options(about, full="long runs")
    parser.add_argument("names", nargs="*", metavar="NAME", help="with --full: those to run, all by default")
    chosen = parser.parse_args()
    file = chosen.out or out
    if chosen.show:
        show(json_files.read(chosen.show))
        return
    if not chosen.full:
        short()
        return
    for name in picked(chosen.names or None, runs, "run", "--full"):
        here = environment()
        own = {key: here[key] for key in ("commit", "date", "cpu", "simd")}
        found = {**runs[name](), "environment": own}
        earlier = json_files.read(file) if file.exists() else {"runs": {}}
        json_files.write(file, {**earlier, "environment": here, "runs": {**earlier["runs"], name: found}})
        print(name, json_files.text(found, None), flush=True)
