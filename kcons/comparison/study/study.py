"""A study: named pieces of work, each saved in a file as soon as it is done.

What was interrupted goes on where it was, as long as the code, the test systems and the settings are the same. However
a study ends, what is done is in its file, and its progress bars are gone.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from kcons.comparison.study import json_files
from kcons.comparison.study.machine import environment
from kcons.errors import InputError, did_you_mean

Name = TypeVar("Name")
Found = TypeVar("Found")


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


@contextmanager
def interruptible(done: Callable[[], int], planned: int, what: str, partial: bool) -> Iterator[dict[str, str]]:
    """Work that Ctrl-C ends with what is done of it, if `partial` and anything is.

    Yields
    ------
    dict
        Empty, or {'interrupted': what was done} afterwards: it belongs to the settings of the result.
    """
    said: dict[str, str] = {}
    try:
        yield said
    except KeyboardInterrupt:
        if not (partial and done()):
            raise
        said["interrupted"] = f"interrupted: {done()} of {planned} {what} were measured"


class Kept:
    """A result in a file, with the code and the settings that made it.

    Parameters
    ----------
    path : Path or None
        None: nothing is kept.
    made_by : mapping
        From `kcons.comparison.study.machine.stamp`.
    form : str, optional
        The entry 'format' of the file.
    under : str
        The entry for `made_by`.
    pack : callable, optional
        Data to the text of the file.

    Attributes
    ----------
    head : dict
        What every such file begins with: format, code and settings, machine.
    """

    def __init__(
        self,
        path: Path | None,
        made_by: Mapping[str, Any],
        *,
        form: str = "",
        under: str = "made_by",
        pack: Callable[[Mapping[str, Any]], str] = json_files.text,
    ) -> None:
        self.path, self.form, self.under, self.pack = path, form, under, pack
        self.head = {**({"format": form} if form else {}), under: made_by, "environment": environment()}

    def earlier(self) -> dict[str, Any]:
        """What the file holds, if the same code made it with the same settings; otherwise nothing."""
        if self.path is None:
            return {}
        try:
            found = json_files.read(self.path, self.form)
        except (OSError, InputError):
            return {}
        return found if found.get(self.under) == self.head[self.under] else {}

    def put(self, result: Mapping[str, Any]) -> None:
        """Into the file, in one piece."""
        if self.path is not None:
            json_files.write(self.path, self.pack({**self.head, **result}))


def noted(make: Callable[[], Found]) -> tuple[Found, str]:
    """What `make` gives, and what it warned of, for a note beside the result: each warning once."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        found = make()
    return found, "; ".join(dict.fromkeys(str(each.message) for each in said))


def picked(names: Iterable[str] | None, known: Iterable[str], what: str, item: str) -> list[str]:
    """Names that were asked for; all that are known by default.

    Raises
    ------
    InputError
        None is named, or one that is not known.
    """
    there = list(known)
    wanted = there if names is None else list(names)
    if not wanted:
        raise InputError(f"no {what} is named; there are {', '.join(there)}", item=item)
    for name in wanted:
        if name not in there:
            raise InputError(
                f"there is no {what} {name!r}{did_you_mean(name, there)}; there are {', '.join(there)}", item=item
            )
    return wanted


def work_off(
    what: str,
    pieces: Mapping[Name, Callable[[], Found]],
    put: Callable[[Name, Found], Any],
    known: Container[Name] = (),
    watcher: Watcher | None = None,
) -> None:
    """Do one piece of work after another, but for those that are known.

    Parameters
    ----------
    what : str
        For the progress bar.
    pieces : mapping of names to callables
    put : callable
        Gets the name and what was found.
    known : container of names, optional
    watcher : Watcher, optional
    """
    watching = watcher or Watcher()
    with watching.piece(what, max(len(pieces), 1)):
        for done, (name, piece) in enumerate(pieces.items(), 1):
            if name not in known:
                put(name, piece())
            watching.advance(done)
