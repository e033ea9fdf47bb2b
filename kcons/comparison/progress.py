"""Progress of long work, shown or not, and times in words."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Self


class Watcher:
    """Is told of progress, and shows it if `shown`: a bar for the piece in hand.

    Without a terminal, a line for each piece, and one a minute.
    """

    #: Seconds between two lines about one piece.
    pause = 60.0

    def __init__(self, shown: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        self._shown = shown
        self._bars = Progress(*columns, console=Console(stderr=True), transient=True, disable=not shown)

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    @contextmanager
    def piece(self, what: str, total: float) -> Iterator[None]:
        """A piece of work of `total` units, which is over at the end of the block."""
        self._say(what)
        task = self._bars.add_task(what, total=total)
        try:
            yield
        finally:
            self._bars.remove_task(task)

    def advance(self, done: float) -> None:
        """So much of the piece in hand is done."""
        for task in self._bars.tasks if self._shown else ():
            self._bars.update(task.id, completed=done)
            if monotonic() - self._said >= self.pause:
                self._say(f"{task.description}: {task.percentage:.0f} %")

    def _say(self, line: str) -> None:
        self._said = monotonic()
        if self._shown and not self._bars.console.is_terminal:
            print(line, file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Three digits and a unit, for example '12.5 ms'."""
    for size, limit, unit in ((1e-9, 1e-6, "ns"), (1e-6, 1e-3, "µs"), (1e-3, 1.0, "ms"), (1.0, 600.0, "s")):
        if seconds < 0.9995 * limit:
            return f"{seconds / size:#.3g}".rstrip(".") + f" {unit}"
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"
