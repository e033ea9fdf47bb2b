"""The files of a report: numbers, picture and tables side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kcons.comparison.study import json_files
from kcons.steppers.files import ResultFolder, in_one_piece

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def results(folder: Path, name: str, system: str) -> ResultFolder:
    """The folder of a comparison on one system, which `write` writes into."""
    names = [f"{name}.{kind}" for kind in ("json", "png", "txt")]
    return ResultFolder(folder, names[0], {"settings": {"system": system}}, names, "a comparison")


def write(folder: Path, name: str, data: Mapping[str, Any], figure: Figure, tables: Sequence[str] = ()) -> list[Path]:
    """Put NAME.json, NAME.png and, if given, the tables as NAME.txt into `folder`; the paths written."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [json_files.write(folder / f"{name}.json", data), folder / f"{name}.png"]
    with in_one_piece(written[1]) as file:
        figure.savefig(file, dpi=150, format="png")
    if tables:
        written.append(folder / f"{name}.txt")
        with in_one_piece(written[2]) as file:
            file.write(("\n".join(tables) + "\n").encode())
    return written
