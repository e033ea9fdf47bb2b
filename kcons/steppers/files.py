"""Files that are either whole or not there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import BinaryIO


@contextmanager
def in_one_piece(path: str | PathLike[str]) -> Iterator[BinaryIO]:
    """A binary file to write to, which becomes `path` once all of it is there.

    Whatever goes wrong on the way, a full disk included, leaves an older file as it was and nothing beside it.
    """
    target = Path(path)
    unfinished = target.with_name(target.name + ".unfinished")
    try:
        with unfinished.open("wb") as opened:
            yield opened
        unfinished.replace(target)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise
