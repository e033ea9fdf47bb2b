"""What studies share: pieces of work, run one after another into a CSV file with a row a measurement; calls in turn.

The file begins with lines '# commit: ...', '# machine: ...', '# versions: ...', '# settings: ...'. It is written after
each piece, so that a study that was cut off goes on from the rows in its file.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd
from rich.progress import track

from kcons.comparison import environment, processor_of
from kcons.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
#: Where committed results are.
RESULTS = ROOT / "docs" / "results"


def options(about: str | None, out: str) -> argparse.ArgumentParser:
    """The parser of a study: ``--quick`` and ``--out``, a folder that is `out` by default."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter runs, some minutes")
    parser.add_argument("--out", type=Path, default=Path(out), help=f"folder for the results (default ./{out})")
    return parser


def head_of(**settings: Any) -> dict[str, str]:
    """Commit, machine, versions and settings of a run that begins now."""
    made = environment()
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items() if version)
    return {
        "commit": str(made["commit"]),
        "date": made["date"],
        "machine": f"{processor_of(made)}, {made['cores']} cores, {made['threads']} thread, {made['system']}",
        "versions": f"Python {made['python']}, {versions}",
        "settings": ", ".join(f"{name}={value}" for name, value in settings.items()),
    }


def write(path: Path, head: Mapping[str, str], table: pd.DataFrame) -> None:
    """The whole file or nothing."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}")
    lines = "".join(f"# {name}: {words}\n" for name, words in head.items())
    unfinished.write_text(lines + table.to_csv(index=False), encoding="utf-8")
    unfinished.replace(path)


def read(path: Path) -> tuple[dict[str, str], pd.DataFrame]:
    """Head and rows of a file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    count = next(k for k, line in enumerate(lines) if not line.startswith("# "))
    head = dict(line[2:].split(": ", 1) for line in lines[:count])
    return head, pd.read_csv(path, skiprows=count)


def run(path: Path, pieces: Mapping[str, Callable[[], Iterable[Mapping[str, Any]]]], **settings: Any) -> pd.DataFrame:
    """Work pieces off, but for those whose rows the file has.

    Parameters
    ----------
    path : Path
        CSV file; its folder is made.
    pieces : mapping of name to callable
        Each gives rows: mappings of column to value. The name becomes the column 'piece'.
    **settings
        What the rows depend on; they go into the head.

    Raises
    ------
    InputError
        The file is of another commit, machine or setting: give another folder.
    """
    head, rows = head_of(**settings), []
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        before, table = read(path)
        for name in ("commit", "machine", "versions", "settings"):
            if before[name] != head[name]:
                told = f"{path} has {name} {before[name]!r}, not {head[name]!r}: give another --out"
                raise InputError(told, item="out")
        head, rows = before, table.to_dict("records")
    done = {row["piece"] for row in rows}
    for name in track([name for name in pieces if name not in done], path.stem, transient=True):
        rows += [{"piece": name, **row} for row in pieces[name]()]
        write(path, head, pd.DataFrame(rows))
    return pd.DataFrame(rows)


def main(
    name: str,
    parser: argparse.ArgumentParser,
    pieces: Callable[[argparse.Namespace], Mapping[str, Callable[[], Iterable[Mapping[str, Any]]]]],
    tables: Callable[[pd.DataFrame], Mapping[str, pd.DataFrame]],
) -> None:
    """A study as a command: run its pieces into NAME.csv, and print its tables.

    Parameters
    ----------
    name : str
    parser : argparse.ArgumentParser
        From `options`.
    pieces : callable
        What was chosen, to pieces as for `run`.
    tables : callable
        The frame to tables by title.
    """
    chosen = parser.parse_args()
    path = chosen.out / f"{name}.csv"
    table = run(path, pieces(chosen), **{key: value for key, value in vars(chosen).items() if key != "out"})
    for title, found in tables(table).items():
        if len(found):
            print(f"{title}\n{found.to_string(index=False)}\n")
    head, _ = read(path)
    print(f"{head['machine']}; commit {head['commit'][:10]}, {head['date']}; {path}")


def shown(table: pd.DataFrame, part: str, **columns: str) -> pd.DataFrame:
    """The rows whose column 'part' is `part`, with columns by name, each formatted; blank where there is no value."""
    rows = table[table.part == part]
    return pd.DataFrame(
        {
            name: ["" if pd.isna(value) else form.format(value) for value in rows[name]]
            for name, form in columns.items()
            if name in rows
        }
    )


# -- times ------------------------------------------------------------------------------------------


def in_turn(
    calls: Mapping[str, Callable[[], Any]], repeats: int, clock: Callable[[], float] = process_time
) -> dict[str, list[float]]:
    """Seconds of each call, `repeats` times, in turn: disturbances of the machine then affect all calls alike."""
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
    """Median milliseconds of one of the `steps` of a call, and the speed relative to the first of them all."""
    first = next(iter(seconds.values()))
    return {
        name: {"ms": 1e3 * float(np.median(found)) / steps, "ratio": ratio(first, found)}
        for name, found in seconds.items()
    }
