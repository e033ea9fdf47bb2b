"""All cases through all programs; each result is saved at once, so that an interrupted study can be resumed."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from kcons.comparison.hard_cases.case import SYSTEMS, Case, Cell, all_cases
from kcons.comparison.hard_cases.worker import Worker
from kcons.comparison.study import json_files
from kcons.comparison.study.machine import environment, stamp
from kcons.comparison.study.study import Kept, Watcher, picked, work_off

FORMAT = "kcons-hard-cases-1"
#: Seconds after which a program that has not answered is given up: quick and full.
LIMITS = (20.0, 3600.0)


def chosen(only: Iterable[str] | None) -> dict[str, Case]:
    """The cases named, or all of them; 'h1' is 'H01'.

    Raises
    ------
    InputError
        An unknown number; the message lists those there are.
    """
    known = all_cases()
    asked = None if only is None else [name[:1].upper() + name[1:].zfill(2) for name in only]
    names = picked(asked, known, "case", "only")
    return {name: known[name] for name in known if name in names}


def run(
    *,
    only: Iterable[str] | None = None,
    quick: bool = False,
    systems: Iterable[str] = SYSTEMS,
    kept: Path | None = None,
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """Judge programs on cases.

    Parameters
    ----------
    only : iterable of str, optional
        Numbers of cases; all by default.
    quick : bool
        Shorter runs (each says how long it was).
    systems : iterable of str
        Names of `SYSTEMS`.
    kept : Path, optional
        JSON file that is written after every verdict. What it holds already is taken over where it was made by the
        same code with the same settings.
    watcher : Watcher, optional

    Returns
    -------
    dict
        Plain data, as it is in the file.
    """
    cases = chosen(only)
    systems = list(systems)
    settings = stamp(quick=quick, versions=environment()["versions"])
    file = Kept(kept, settings, form=FORMAT)
    result: dict[str, Any] = {
        **file.head,
        "systems": systems,
        "cases": {name: _described(case) for name, case in cases.items()},
        # Cells that are not reached stay in the file.
        "cells": file.earlier().get("cells", {}),
    }
    with Worker() as worker:
        for name, case in cases.items():
            _judge(
                case, systems, quick, worker, result["cells"].setdefault(name, {}), lambda: file.put(result), watcher
            )
    return result


def _judge(
    case: Case,
    systems: Iterable[str],
    quick: bool,
    worker: Worker,
    cells: dict[str, Any],
    keep: Callable[[], None],
    watcher: Watcher | None,
) -> None:
    """All programs on one case."""

    def put(system: str, cell: Cell) -> None:
        cells[system] = json_files.plain(asdict(cell))
        keep()

    def judged(system: str) -> Cell:
        if system in case.cannot:
            return Cell("cannot express", False, case.cannot[system])
        return worker.run(case.number, system, quick, LIMITS[0 if quick else 1])

    work_off(f"{case.number} {case.title}", {name: partial(judged, name) for name in systems}, put, cells, watcher)


def load(path: Path) -> dict[str, Any]:
    """Read a result.

    Raises
    ------
    InputError
        The file holds none.
    """
    return json_files.read(path, FORMAT, of="kcons hardcases")


def _described(case: Case) -> dict[str, str]:
    return {"title": case.title, "limit": case.limit, "kind": case.kind, "theme": case.theme}
