"""What the commands write to the terminal, and how they read lists."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

#: Columns of a page that is no terminal.
WIDE = 150


def numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",") if word.strip()]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 4,2,1") from None


def names(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def console() -> Console:
    from rich.console import Console

    # A file or a pipe has no width to fit into.
    found = Console(width=None if sys.stdout.isatty() else WIDE)
    found.on_broken_pipe = drop_what_follows  # type: ignore[method-assign]
    return found


def show(*parts: RenderableType) -> None:
    """Tables, and sentences as they are; into a pipe that nobody reads nothing."""
    terminal = console()
    for part in parts:
        terminal.print(part, highlight=False, markup=False, soft_wrap=not hasattr(part, "columns"))


def drop_what_follows() -> None:
    """Send what is written to standard output from now on, and what waits to be, nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def rendered(table: RenderableType) -> str:
    """The table as plain text, wide enough for all columns."""
    from rich.console import Console

    page = io.StringIO()
    Console(file=page, width=WIDE, color_system=None).print(table)
    return page.getvalue().rstrip()


def say_written(paths: Iterable[Path]) -> None:
    show(*(f"wrote {path}" for path in paths))


class Terminated(KeyboardInterrupt):
    """SIGTERM has come."""


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does, so that it finishes its files and ends its workers."""
    if threading.current_thread() is not threading.main_thread():  # no other one can set what a signal does
        yield
        return

    def end(*_: object) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


@contextmanager
def warnings_in_a_line() -> Iterator[None]:
    """Say warnings for users as errors are said, without the line of code that they come from."""
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show_one(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if category is UserWarning:
                print(f"kcons: {' '.join(str(message).split())}", file=sys.stderr)
            else:
                shown(message, category, *where, **more)

        warnings.showwarning = show_one
        yield
