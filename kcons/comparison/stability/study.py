"""The whole stability study, kept as it comes in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from kcons.comparison.stability import fuzz, runs
from kcons.comparison.stability.small_systems import SYSTEMS
from kcons.comparison.study import json_files
from kcons.comparison.study.machine import stamp
from kcons.comparison.study.study import Kept, Watcher, picked, work_off
from kcons.errors import InputError

FORMAT = "kcons-stability-1"
PARTS = ("steps", "drift", "reversal", "fuzz")
#: Trials that are kept together.
BATCH = 500


def run(
    *,
    only: Iterable[str] | None = None,
    test_systems: Iterable[str] | None = None,
    quick: bool = False,
    kept: Path | None = None,
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """Run the parts of the study.

    Parameters
    ----------
    only : iterable of str, optional
        Of 'steps' (largest stable step), 'drift', 'reversal', 'fuzz'.
    test_systems : iterable of str, optional
        Of `SYSTEMS`, for all parts but 'fuzz'.
    quick : bool
        1e4 steps instead of 1e6, 300 trials instead of 10,000.
    kept : Path, optional
        JSON file that is written after every piece of work. Pieces it holds already are taken over where they were
        made by the same code with the same settings.
    watcher : Watcher, optional

    Raises
    ------
    InputError
        An unknown part or test system.
    """
    parts = picked(only, PARTS, "part", "only")
    chosen = picked(test_systems, SYSTEMS, "test system", "scenes")
    file = Kept(kept, stamp(quick=quick), form=FORMAT)
    result: dict[str, Any] = {**file.head, "pieces": file.earlier().get("pieces", {})}

    def put(name: str, found: Any) -> None:
        result["pieces"][name] = found
        file.put(result)

    work = {name: piece for part in parts for name, piece in _pieces(part, quick, chosen).items()}
    work_off("stability", work, put, result["pieces"], watcher)
    return result


def _pieces(part: str, quick: bool, test_systems: Sequence[str]) -> dict[str, Callable[[], Any]]:
    both = [(method, test_system) for test_system in test_systems for method in runs.METHODS]
    if part == "steps":
        return {f"steps/{s}/{m}": partial(runs.largest_step, m, s, quick) for m, s in both}
    if part == "drift":
        return {f"drift/{s}": partial(runs.drift, s, 8, 10_000 if quick else 1_000_000) for s in test_systems}
    if part == "reversal":
        steps = 200 if quick else 2000
        return {f"reversal/{s}/{m}": partial(runs.reversal, m, s, steps // (10 if m == "ASE" else 1)) for m, s in both}
    trials = 300 if quick else 10_000
    return {f"fuzz/{k}": partial(_trials, k, min(k + BATCH, trials)) for k in range(0, trials, BATCH)}


def _trials(first: int, end: int) -> list[dict[str, Any]]:
    return [asdict(fuzz.trial(seed)) for seed in range(first, end)]


def digest(result: dict[str, Any]) -> dict[str, Any]:
    """The result with all trials of the fuzz run summed up: what is committed."""
    trials = [fuzz.Trial(**t) for name, batch in result["pieces"].items() if name.startswith("fuzz/") for t in batch]
    pieces = {name: piece for name, piece in result["pieces"].items() if not name.startswith("fuzz/")}
    found = {**result, "pieces": pieces}
    if trials:
        found["fuzz"] = fuzz.summary(trials)
    return found


def put_into(result: dict[str, Any], path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Add pieces to existing results; pieces of quick runs are left out.

    Returns
    -------
    before, after : dict
        The results at `path`. Under 'added' it says by which code and on which machine a piece was made, where that is
        not what the others were made by.

    Raises
    ------
    InputError
        Quick results; a file that holds something else.
    """
    if result["made_by"]["quick"]:
        raise InputError("these results are quick ones; run without --quick", item="into")
    before = json_files.read(path, FORMAT, of="kcons stability")
    made = {"made_by": result["made_by"], "environment": result["environment"]}
    names = [name for name in result["pieces"] if not name.startswith("fuzz/")]
    summed = {"fuzz": result["fuzz"]} if "fuzz" in result else {}
    added = {
        **summed,
        "pieces": {**before["pieces"], **{name: result["pieces"][name] for name in names}},
        "added": {**before.get("added", {}), **dict.fromkeys([*names, *summed], made)},
    }
    after = json_files.plain({**before, **added})
    json_files.write(path, after)
    return before, after
