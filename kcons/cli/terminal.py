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

    found = Console()
    # Into a file or a pipe there is no width to fit into.
    return found if found.is_terminal else Console(width=WIDE)


def show(*parts: RenderableType) -> None:
    """Tables, and sentences as they are."""
    terminal = console()
    for part in parts:
        terminal.print(part, highlight=False, markup=False, soft_wrap=not hasattr(part, "columns"))


def rendered(table: RenderableType) -> str:
    """The table as plain text, wide enough for all columns."""
    from rich.console import Console

    page = io.StringIO()
    Console(file=page, width=WIDE, color_system=None).print(table)
    return page.getvalue().rstrip()


def say_written(paths: Iterable[Path]) -> None:
    for path in paths:
        print(f"wrote {path}")


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


class _Pipe(io.FileIO):
    """A pipe that may be closed at its other end: what is written from then on is dropped."""

    gone = False

    def write(self, data: Any, /) -> int:
        try:
            return len(data) if self.gone else super().write(data)
        except BrokenPipeError:
            self.gone = True
            return len(data)


def _forgiving(stream: Any) -> Any:
    if stream is None:  # closed by whoever started the command
        return open(os.devnull, "w", encoding="utf-8")
    buffer = getattr(stream, "buffer", None)
    if not isinstance(getattr(buffer, "raw", buffer), io.FileIO):
        return stream  # of a program that calls the command
    stream.flush()
    raw = io.BufferedWriter(_Pipe(stream.fileno(), "w", closefd=False))
    at_once = stream.line_buffering or stream.write_through
    return io.TextIOWrapper(raw, encoding=stream.encoding, errors="replace", line_buffering=at_once)


@contextmanager
def forgiving_streams() -> Iterator[None]:
    """Standard output and errors that take any character, '?' for those that their encoding lacks, and a reader that
    goes away, such as `head`.

    Raises
    ------
    OSError
        What was written cannot be brought to its file, at the end.
    """
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_forgiving, before)
    streams = [new for new, old in zip((sys.stdout, sys.stderr), before, strict=True) if new is not old]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream in streams:
            try:
                stream.flush()
            except OSError:
                getattr(stream.buffer, "raw", stream.buffer).gone = True  # closing would try again
                raise
