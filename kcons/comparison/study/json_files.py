"""Results in JSON files: the one place that writes and reads them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from kcons.errors import InputError
from kcons.steppers.files import in_one_piece, plain, text

__all__ = ["plain", "read", "text", "write"]


def write(path: str | Path, data: Any, indent: int | None = 1) -> Path:
    """Put data into a file, all of it or nothing: an older file stays as it was until the new one is complete.

    Parameters
    ----------
    path : path
    data
        Mappings, sequences, numbers and text; or a text that is JSON already.
    indent : int, optional
        Of each level; None for one line.
    """
    with in_one_piece(path) as file:
        file.write(f"{data if isinstance(data, str) else text(data, indent)}\n".encode())
    return Path(path)


def read(path: str | Path, form: str = "", of: str = "kcons") -> dict[str, Any]:
    """What a file holds.

    Parameters
    ----------
    path : path
    form : str, optional
        What its entry 'format' has to be.
    of : str
        What makes such files, for the message.

    Raises
    ------
    InputError
        The file holds something else.
    """
    try:
        # Older files have NaN.
        found: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=lambda _: None)
        if form and found["format"] != form:
            raise KeyError("format")
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no result of {of}: {error!r}", item="file") from None
    return found
