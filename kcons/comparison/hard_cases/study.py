"""All cases through all programs, kept as they come in, so that an interrupted study goes on where it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from kcons import __version__
from kcons.comparison.hard_cases.case import SYSTEMS, Case, Cell, all_cases
from kcons.comparison.hard_cases.worker import Worker
from kcons.comparison.study import json_files
from kcons.comparison.study.machine import code_digest, environment
from kcons.comparison.work_precision.measure import Watcher
from kcons.errors import InputError

FORMAT = "kcons-hard-cases-1"
#: Seconds after which a program that has not answered is given up: quick and full.
LIMITS = (20.0, 3600.0)


def chosen(only: Iterable[str] | None) -> dict[str, Case]:
    """The cases named, or all of them.

    Raises
    ------
    InputError
        An unknown number; the message lists those there are.
    """
    known = all_cases()
    if only is None:
        return known
    names = [name.upper() for name in only]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(f"there is no case {unknown[0] if unknown else ''}; there are {', '.join(known)}", item="only")
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
    watcher = watcher or Watcher()
    made_by = {"version": __version__, "code": code_digest(), "quick": quick, "versions": environment()["versions"]}
    before = _earlier(kept, made_by)
    result: dict[str, Any] = {
        "format": FORMAT,
        "made_by": made_by,
        "environment": environment(),
        "systems": systems,
        "cases": {name: _described(case) for name, case in cases.items()},
        "cells": {},
    }
    with Worker() as worker:
        for name, case in cases.items():
            watcher.begin(f"{name} {case.title}", len(systems))
            cells = result["cells"].setdefault(name, {})
            for done, system in enumerate(systems):
                watcher.advance(done)
                known = before.get(name, {}).get(system)
                if known is None:
                    known = asdict(_cell(worker, case, system, quick))
                cells[system] = known
                if kept is not None:
                    save(result, kept, before)
            watcher.end()
    return result


def _cell(worker: Worker, case: Case, system: str, quick: bool) -> Cell:
    if system in case.cannot:
        return Cell("cannot express", False, case.cannot[system])
    return worker.run(case.number, system, quick, LIMITS[0 if quick else 1])


def save(result: Mapping[str, Any], path: Path, before: Mapping[str, Any] | None = None) -> None:
    """Write in one piece; cells of an earlier run that were not reached yet stay in the file."""
    cells = {**(before or {})}
    for name, row in result["cells"].items():
        cells[name] = {**cells.get(name, {}), **row}
    json_files.write(path, {**result, "cells": cells})


def load(path: Path) -> dict[str, Any]:
    """Read a result.

    Raises
    ------
    InputError
        The file holds none.
    """
    return json_files.read(path, FORMAT, of="kcons hardcases")


def _earlier(kept: Path | None, made_by: Mapping[str, Any]) -> dict[str, Any]:
    if kept is None or not kept.is_file():
        return {}
    try:
        found = load(kept)
    except InputError:
        return {}
    return dict(found["cells"]) if found["made_by"] == json_files.plain(made_by) else {}


def _described(case: Case) -> dict[str, str]:
    return {"title": case.title, "limit": case.limit, "kind": case.kind, "theme": case.theme}
