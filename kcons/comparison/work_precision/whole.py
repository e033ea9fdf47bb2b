"""The whole comparison: every test system through every method, into one folder and one page.

What is measured is written after every part. It is not measured again while code, test system and settings are the
same: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from kcons.comparison import test_systems
from kcons.comparison.methods.methods import METHODS
from kcons.comparison.study import json_files
from kcons.comparison.study.machine import stamp
from kcons.comparison.study.study import Kept, Watcher
from kcons.comparison.test_systems import TestSystem
from kcons.comparison.work_precision import whole_page
from kcons.comparison.work_precision.measure import Bench, compare, reference_of
from kcons.comparison.work_precision.measurement import Comparison
from kcons.comparison.work_precision.parts_of_the_whole import PLAN, Item
from kcons.comparison.work_precision.recommendation import sharpen
from kcons.comparison.work_precision.timing_rounds import FULL_ROUNDS, QUICK_ROUNDS
from kcons.errors import InputError, KconsError
from kcons.steppers.files import ResultFolder

FORMAT = "kcons-report-1"
#: Digits that go to files.
DIGITS = 4
#: A quick run is to be over after so many seconds; near the end, budgets shrink and then parts are left out.
QUICK_SECONDS = 280.0


def run(
    items: Sequence[Item],
    folder: Path,
    *,
    quick: bool = False,
    fresh: bool = False,
    watcher: Watcher | None = None,
    limit: float | None = None,
) -> Path:
    """Measure what is not there yet, and draw everything that is.

    Parameters
    ----------
    items : sequence of Item
    folder : path
    quick : bool
        Smaller test systems, short budgets, large test systems left out; five minutes in all.
    fresh : bool
        Measure again what is there.
    watcher : Watcher, optional
    limit : float, optional
        Seconds after which nothing more is begun; by default those of a quick run, otherwise none.

    Returns
    -------
    path : Path
        The page.
    """
    watching = watcher or Watcher()
    limit = QUICK_SECONDS if quick and limit is None else limit
    begun = time.perf_counter()
    expected = {item.key: item.quick_seconds if quick else item.seconds for item in items}
    pending = []
    for item in items:
        old = _kept(folder, item, quick).earlier()
        if not fresh and old and not {"failed", "unfinished"} & set(old):
            watching.overall(f"{item.key}: measured already", 0.0, sum(expected.values()))
            expected.pop(item.key)
        else:
            pending.append(item)
    done = spent = 0.0
    try:
        for number, item in enumerate(pending, 1):
            elapsed = time.perf_counter() - begun
            pace = spent / done if done else 1.0
            left = pace * sum(expected[i.key] for i in pending[number - 1 :] if not _excluded(i, quick))
            watching.overall(f"{number} of {len(pending)}: {item.heading}", elapsed, elapsed + left)
            share = 1.0 if limit is None or not left else max(0.0, min(1.0, (limit - elapsed) / left))
            started = time.perf_counter()
            found = _part(item, quick, share, watching, folder, fresh)
            _kept(folder, item, quick).put(found)
            whole_page.write_part(folder, _part_of(item, read(folder, item.key) or {}))
            if "seconds" in found:
                done += expected[item.key]
                spent += time.perf_counter() - started
            gc.collect()
    finally:
        # An interrupted run has a page, too, and it shows whatever is in the folder.
        path = _page(folder)
    return path


def results(folder: Path) -> ResultFolder:
    """The folder of the whole comparison; whose it is says the first part that is there."""
    names = [f"{item.key}.{kind}" for item in PLAN for kind in ("json", "png", "txt")]
    record = next((name for name in names[::3] if (folder / name).exists()), names[0])
    return ResultFolder(folder, record, {"format": FORMAT}, [*names, "index.html"], "a whole comparison")


def key_of(item: Item, quick: bool) -> dict[str, Any]:
    """What a measurement depends on: code, test system, settings."""
    part = asdict(item)
    for name in ("heading", "seconds", "quick_seconds"):
        part.pop(name)
    return stamp(quick=quick, part=part)


def _kept(folder: Path, item: Item, quick: bool) -> Kept:
    return Kept(folder / f"{item.key}.json", key_of(item, quick), form=FORMAT, under="key", pack=packed)


def _part(item: Item, quick: bool, share: float, watcher: Watcher, folder: Path, fresh: bool) -> dict[str, Any]:
    """Measure one part; what keeps it from being measured is its result."""
    reason = _excluded(item, quick) or ("the time of a quick run was over" if share < 0.05 else "")
    if reason:
        return {"not run": reason}
    begun = time.perf_counter()
    try:
        if item.module:
            found = {"result": _by_module(item, quick, watcher, folder, fresh)}
        else:
            found = {"comparison": _compared(item, quick, share, watcher).to_dict()}
    except (KconsError, ValueError, ArithmeticError, RuntimeError, MemoryError) as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    return {**found, "seconds": time.perf_counter() - begun}


def _by_module(item: Item, quick: bool, watcher: Watcher, folder: Path, fresh: bool) -> dict[str, Any]:
    """A part with a module of its own; what it has measured is kept from time to time."""
    kept = _kept(folder, item, quick)
    result: dict[str, Any] = import_module(item.module).measure(
        quick=quick,
        keep=lambda result: kept.put({"unfinished": True, "result": result}),
        watcher=watcher,
        earlier=None if fresh else kept.earlier().get("result"),
    )
    return result


def _excluded(item: Item, quick: bool) -> str:
    """Why a part is not measured here; '' if it is."""
    if quick and not item.quick_seconds:
        return "in the full run only"
    if item.module and find_spec(item.module) is None:
        return f"this version of kcons has no {item.module}"
    if item.scene and item.scene not in test_systems.SYSTEMS:
        return f"this version of kcons has no test system {item.scene!r}"
    if item.needs and find_spec(item.needs) is None:
        return f"{item.needs} is not installed; python -m pip install {item.needs}"
    return ""


def _compared(item: Item, quick: bool, share: float, watcher: Watcher) -> Comparison:
    with watcher.piece("building the test system", 1):
        test_system = test_system_of(item, quick)
    budget = (item.quick_seconds / 12 if quick else item.budget) * share
    names, left_out = methods_of(item, test_system, quick)
    reference = reference_of(test_system, watcher)
    rounds = QUICK_ROUNDS if quick else FULL_ROUNDS
    found = compare(
        test_system,
        methods=names,
        budget=budget,
        watcher=watcher,
        reference=reference,
        rounds=rounds,
        settings={"part": item.key, "quick": quick},
    )
    reasons = dict.fromkeys(left_out.values())
    remarks = [f"not run: {', '.join(n for n in left_out if left_out[n] == why)} ({why})" for why in reasons]
    found = replace(found, remarks=[*found.remarks, *remarks])
    return sharpen(Bench(test_system, reference, budget, watcher, rounds), found)


def test_system_of(item: Item, quick: bool) -> TestSystem:
    """The test system of a part."""
    size = item.quick_size if quick and item.quick_size is not None else item.size
    test_system = test_systems.build(item.scene, size, quick=quick, **item.options)
    if item.steps is not None and not quick:
        test_system = test_system.with_time_steps(item.steps)
    return test_system if item.pace is None else replace(test_system, reference_pace=item.pace)


def methods_of(item: Item, test_system: TestSystem, quick: bool) -> tuple[list[str], dict[str, str]]:
    """Names of the methods that run, and of those that are left out though they could, with the reasons.

    All steppers of kcons on arrays, in a quick run the usual ones; of other MD engines the usual ones, those that
    refuse with their reasons; of OpenMM and of guests those that can run the test system.
    """
    kept: list[str] = []
    out: dict[str, str] = {}
    for method in METHODS.values():
        usual = method.usual or (not quick and method.md_engine == "kcons")
        guest = method.guest or method.md_engine == "openmm"
        if not usual or not method.follows or (guest and method.refuses(test_system) is not None):
            continue
        why = next((why for beginning, why in item.without.items() if method.name.startswith(beginning)), None)
        if why is None:
            kept.append(method.name)
        else:
            out[method.name] = why
    return kept, out


# -- files ------------------------------------------------------------------------------------------


def read(folder: Path, key: str) -> dict[str, Any] | None:
    """What was measured of a part; None where there is nothing that can be read."""
    try:
        return unpacked(json_files.read(folder / f"{key}.json", FORMAT))
    except (OSError, InputError):
        return None


def packed(found: Mapping[str, Any]) -> str:
    """JSON, four digits, measurements one a line under the names of their columns."""
    data = json_files.plain(found, DIGITS)
    lines: list[str] = []
    if "comparison" in data:
        measurements = data["comparison"]["measurements"]
        columns = list(measurements[0]) if measurements else []
        lines = [json_files.text([m[name] for name in columns], indent=None) for m in measurements]
        data["comparison"] = {**data["comparison"], "columns": columns, "measurements": "ROWS"}
    return json_files.text(data).replace('"ROWS"', "[\n" + ",\n".join(lines) + "\n]")


def unpacked(data: dict[str, Any]) -> dict[str, Any]:
    """What `packed` made, as it was."""
    if "comparison" not in data:
        return data
    comparison = dict(data["comparison"])
    columns = comparison.pop("columns")
    comparison["measurements"] = [
        {name: value for name, value in zip(columns, row, strict=True) if value is not None}
        for row in comparison["measurements"]
    ]
    return {**data, "comparison": comparison}


def redraw(folder: Path, into: Path | None = None, watcher: Watcher | None = None) -> list[Path]:
    """Pictures, tables and the page from the numbers in a folder; the table of winners goes `into` a page, too.

    Raises
    ------
    InputError
        There are none.
    """
    found = parts(folder)
    if not found:
        raise InputError(f"there are no results of kcons compare --all in {folder}", item="redraw")
    made: list[Path] = []
    watching = watcher or Watcher()
    with watching.piece("drawing", len(found) + 2):
        for done, part in enumerate(found, 1):
            made += whole_page.write_part(folder, part)
            watching.advance(done)
        filled = [] if into is None else whole_page.fill(into, found)
        watching.advance(len(found) + 1)
        return [_page(folder), *made, *filled]


def parts(folder: Path) -> list[whole_page.Part]:
    """All parts that are in a folder, in the order of the plan."""
    return [_part_of(item, data) for item in PLAN if (data := read(folder, item.key)) is not None]


def _part_of(item: Item, data: Mapping[str, Any]) -> whole_page.Part:
    return whole_page.Part(item.key, item.heading, item.module, data)


def _page(folder: Path) -> Path:
    return whole_page.write(folder / "index.html", parts(folder))
