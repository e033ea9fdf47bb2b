"""What the commands write to the terminal, and how they read lists."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

#: Columns of a page that is no terminal.
WIDE = 150


def numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",") if word.strip()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 4,2,1") from None


def names(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def show(table: Table, explained: str, console: Console) -> None:
    console.print(table)
    console.print(explained, highlight=False, markup=False)


def say_written(paths: list[Path]) -> None:
    for path in paths:
        print(f"wrote {path}")


def rendered(table: Table) -> str:
    """The table as plain text, wide enough for all columns."""
    from io import StringIO

    from rich.console import Console

    page = StringIO()
    Console(file=page, width=WIDE, color_system=None).print(table)
    return page.getvalue().rstrip()


def console() -> Console:
    from rich.console import Console

    console = Console()
    # Into a file or a pipe there is no width to fit into.
    return console if console.is_terminal else Console(width=WIDE)
