"""The options of a command as a table, what is written to the terminal, and how lists are read."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rich.console import RenderableType

#: Columns of a page that is no terminal.
WIDE = 150
#: What `--constrain` takes.
HELD = ("hbonds", "allbonds", "hangles", "allangles")


class Option:
    """A row of the table of a command: its name ('--out'; without dashes what is given by its place), and help.

    `more` are further arguments of `argparse.ArgumentParser.add_argument`: type, default, nargs, choices, ...
    """

    def __init__(self, name: str, help: str, **more: Any) -> None:
        self.name, self.how = name, {"help": help, **more}


class Command(NamedTuple):
    """A command: its table of options, and what runs it.

    `run` is given the options as attributes and returns the exit status; `kept` is what of its work stays when it is
    stopped, and is gone on from.
    """

    name: str
    help: str
    description: str
    options: Sequence[Option]
    run: Callable[[argparse.Namespace], int]
    kept: str = ""


def numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in names(text)]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers such as 4,2,1") from None


def names(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def show(*parts: RenderableType) -> None:
    """Tables, and sentences as they are; into a pipe that nobody reads nothing."""
    from rich.console import Console

    # A file or a pipe has no width to fit into.
    terminal = Console(width=None if sys.stdout.isatty() else WIDE)
    terminal.on_broken_pipe = drop_what_follows  # type: ignore[method-assign]
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
def in_order() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does, and say warnings for users as errors are said, in one line."""

    def end(*_: object) -> None:
        raise Terminated

    def show_one(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if category is UserWarning:
            print(f"kcons: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            shown(message, category, *where, **more)

    main = threading.current_thread() is threading.main_thread()  # no other one can set what a signal does
    before = signal.signal(signal.SIGTERM, end) if main else None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default", UserWarning)
            shown, warnings.showwarning = warnings.showwarning, show_one
            yield
    finally:
        if main:
            signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)
