"""Progress of long work, for whoever wants to show it, and times in words."""

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


def duration(seconds: float) -> str:
    """Three digits and a unit, for example '12.5 ms'."""
    for size, limit, unit in ((1e-9, 1e-6, "ns"), (1e-6, 1e-3, "µs"), (1e-3, 1.0, "ms"), (1.0, 600.0, "s")):
        if seconds < 0.9995 * limit:
            return f"{seconds / size:#.3g}".rstrip(".") + f" {unit}"
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"
