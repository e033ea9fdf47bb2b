"""What studies share: pieces of work, run one after another into a CSV file with a row a measurement.

The file begins with lines '# commit: ...', '# machine: ...', '# versions: ...', '# settings: ...'. It is written after
each piece, so that a study that was cut off goes on from the rows in its file.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

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
