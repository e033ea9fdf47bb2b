"""What is asked for by name, work that Ctrl-C ends with what is done, and warnings that become notes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from kcons.errors import InputError, did_you_mean

Found = TypeVar("Found")


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
