"""Progress of long work, for whoever wants to show it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class Watcher:
    """Receives progress. This one shows nothing; that of the command line shows progress bars."""

    def begin(self, what: str, total: float) -> None:
        """A piece of work of `total` units starts."""

    def advance(self, done: float) -> None:
        """So much of it is done."""

    def end(self) -> None:
        """It is over."""

    def overall(self, what: str, done: float, total: float) -> None:
        """A part of a longer run starts; `done` of the `total` expected seconds of the run have passed."""

    @contextmanager
    def piece(self, what: str, total: float) -> Iterator[None]:
        """A piece of work of `total` units, which is over at the end of the block."""
        self.begin(what, total)
        try:
            yield
        finally:
            self.end()
