"""The files of a report: numbers, picture and tables side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.study import json_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write(folder: Path, name: str, data: Mapping[str, Any], figure: Figure, tables: Sequence[str] = ()) -> list[Path]:
    """Put NAME.json, NAME.png and, if given, the tables as NAME.txt into `folder`; the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [json_files.write(folder / f"{name}.json", data), folder / f"{name}.png"]
    figure.savefig(written[1], dpi=150)
    if tables:
        written.append(folder / f"{name}.txt")
        written[2].write_text("\n".join(tables) + "\n", encoding="utf-8")
    return written
