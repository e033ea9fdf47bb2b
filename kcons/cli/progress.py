"""Progress bars for the command line."""

from __future__ import annotations

import sys
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from kcons.comparison.progress import Watcher, duration


class Bars(Watcher):
    """A bar on the terminal for the piece of work in hand; a line for each piece where there is no terminal."""

    def __init__(self) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        self._bars = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task: TaskID | None = None
        self._whole: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def _bar(self, task: TaskID | None, text: str, done: float, total: float) -> TaskID:
        if not self._bars.console.is_terminal:
            print(text, file=sys.stderr, flush=True)
        if task is None:
            task = self._bars.add_task(text, total=total)
        self._bars.update(task, description=text, completed=done, total=total)
        return task

    def overall(self, what: str, done: float, total: float) -> None:
        left = max(total - done, 0.0)
        text = f"{what}; {'the last of it' if left == 0 else 'about ' + duration(left) + ' left'}"
        self._whole = self._bar(self._whole, text, done, total)

    def begin(self, what: str, total: float) -> None:
        self._task = self._bar(None, what, 0.0, total)

    def advance(self, done: float) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=done)

    def end(self) -> None:
        if self._task is not None:
            self._bars.remove_task(self._task)
            self._task = None
