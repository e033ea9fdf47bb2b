"""Files that are either whole or not there, data as JSON, and archives whose damage is noticed."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import SEEK_END, BytesIO
from os import PathLike
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO
from zipfile import ZipFile

import numpy as np

from kcons.constraints.arguments import as_array, numbers
from kcons.errors import InputError

#: The record at the end of an archive without comment; the fifth number is how many files there are.
_LAST_RECORD = Struct("<4s4H2LH")


def as_path(value: str | PathLike[str], item: str) -> Path:
    """The path that `value` names.

    Raises
    ------
    InputError
        It is neither text nor a path.
    """
    if not isinstance(value, str | PathLike):
        raise InputError(f"{item} is {value!r}; give a path", item=item)
    return Path(value)


@contextmanager
def in_one_piece(path: str | PathLike[str]) -> Iterator[BinaryIO]:
    """A binary file to write to, which becomes `path` once all of it is there.

    Whatever goes wrong on the way, a full disk included, leaves an older file as it was and nothing beside it. Links
    are not followed.
    """
    target = Path(path)
    unfinished = target.with_name(target.name + ".unfinished")
    unfinished.unlink(missing_ok=True)
    try:
        with unfinished.open("xb") as opened:
            yield opened
        unfinished.replace(target)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def plain(value: Any, digits: int | None = None) -> Any:
    """What JSON has: lists, keys that are text, and None for NaN and infinity.

    Parameters
    ----------
    value
    digits : int, optional
        Significant digits that are kept of a number.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return value if digits is None else float(f"{value:.{digits}g}")
    return value


def text(data: Any, indent: int | None = 1) -> str:
    """Data as JSON."""
    return json.dumps(plain(data), indent=indent, ensure_ascii=False, allow_nan=False)


def stored_arrays(file: BinaryIO) -> dict[str, Any]:
    """The arrays of an archive, each with its checksum compared."""
    found: dict[str, Any] = {}
    with ZipFile(file) as archive:
        # A damaged entry of the directory may hide the next one; its last record says how many there are.
        file.seek(-_LAST_RECORD.size, SEEK_END)
        count = _LAST_RECORD.unpack(file.read(_LAST_RECORD.size))[4]
        if count != len(archive.namelist()):
            raise ValueError(f"{len(archive.namelist())} arrays are listed of {count}")
        for name in archive.namelist():
            # Read whole: what `numpy.load` does not look at, it does not check either.
            content = BytesIO(archive.read(name))
            array = np.lib.format.read_array(content, allow_pickle=False)
            if content.read(1):
                raise ValueError(f"{name} is longer than what it holds")
            found[name.removesuffix(".npy")] = array if array.ndim else array.item()
    return found


def checked_state(values: dict[str, Any]) -> dict[str, Any]:
    """What a state is made of, as a step needs it."""
    shape = np.shape(values["positions"])
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"positions have shape {shape}")
    for name in ("positions", "velocities", "forces", "remainder"):
        if name in values:
            values[name] = as_array(values[name], shape, name)
    for name in {"thermostat", "barostat"} & set(values):
        values[name] = np.atleast_1d(numbers(values[name], name))
    if len(values.get("barostat", range(9))) < 9:
        raise ValueError(f"barostat has {len(values['barostat'])} numbers, which are no cell")
    for name, kind in (("time", float | int), ("time_remainder", float | int), ("step", int)):
        if not isinstance(values.get(name, 0), kind):
            raise ValueError(f"{name} is {values[name]!r:.40}")
    return values
