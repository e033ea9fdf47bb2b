"""Files that are either whole or not there, folders of one run, data as JSON, archives whose damage is noticed."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import SEEK_END, BytesIO
from os import PathLike
from pathlib import Path
from secrets import token_hex
from struct import Struct
from typing import Any, BinaryIO
from zipfile import ZipFile

import numpy as np

from kcons.constraints.arguments import as_float_array, finite_array, finite_number, whole_number
from kcons.errors import InputError, OccupiedError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

#: Ends the names of files that are still being written.
UNFINISHED = ".unfinished"
#: The file that a run locks while it writes into a folder.
LOCK = ".kcons.lock"

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
    are not followed. Each writer has a file of its own until then, so that several can write to one path: the last one
    to finish stays. One that is killed leaves its unfinished file, which nothing reads.
    """
    target = Path(path)
    unfinished = target.with_name(f"{target.name}.{token_hex(8)}{UNFINISHED}")
    try:
        with unfinished.open("xb") as opened:
            yield opened
        unfinished.replace(target)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def write_files(folder: str | PathLike[str], contents: Mapping[str, bytes]) -> list[Path]:
    """Put files into a folder, by name, each in one piece; their paths."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        with in_one_piece(Path(folder, name)) as file:
            file.write(content)
    return [Path(folder, name) for name in contents]


class ResultFolder:
    """A folder with the results of one thing, into which one run at a time writes.

    Parameters
    ----------
    folder : path
    record : str
        The file in it that says what the results belong to: JSON, or a CSV table below lines such as `# name: JSON`. It
        may be one of the results.
    owner : mapping
        What the record has to say; where it is a result, it may say more.
    names : sequence of str
        Patterns of the files that are written there.
    what : str
        What the results are, for messages.
    """

    def __init__(
        self, folder: str | PathLike[str], record: str, owner: Mapping[str, Any], names: Sequence[str], what: str
    ) -> None:
        self.path = as_path(folder, "folder")
        self.record, self.owner, self.names, self.what = record, owner, names, what
        self._taken = False

    def refuse_others(self) -> None:
        """Refuse a folder that has anything but these results under their names.

        Raises
        ------
        OccupiedError
        """
        remedy = "give another folder (--out)"
        if self.path.exists() and not self.path.is_dir():
            raise OccupiedError(f"{self.path}: there is a file where a folder has to be; {remedy}", item="folder")
        there = list(self._there())
        for path in there:
            if path.is_symlink() or not path.is_file():
                raise OccupiedError(f"{path} is a link, or no file; {remedy}", item="folder")
        if not there:
            return
        record = self.path / self.record
        mine = json.loads(text(self.owner))
        try:
            theirs = _said(record)
            if not mine.keys() & theirs.keys():
                raise ValueError(f"{record} has none of {', '.join(mine)}")
            wrong = _other(mine, theirs, self.record in self.names)
        except (OSError, ValueError, TypeError, RecursionError) as error:
            names = ", ".join(path.name for path in there[:3]) + (" ..." if len(there) > 3 else "")
            raise OccupiedError(f"{self.path} has other files called {names}; {remedy}", item="folder") from error
        if wrong:
            said = ", ".join(f"{'other' if name.endswith('s') else 'another'} {name}{value}" for name, value in wrong)
            raise OccupiedError(f"{self.path} has {self.what} of {said}; {remedy}", item=wrong[0][0])

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Keep other runs out, write whose the folder is, and clear what killed runs left unfinished.

        Raises
        ------
        OccupiedError
            Another run writes there, or the folder has something else in it.
        """
        if self._taken:
            yield
            return
        self.refuse_others()  # before anything is made
        self.path.mkdir(parents=True, exist_ok=True)
        with _locked(self.path):
            self.refuse_others()  # what was written since
            for name in (self.record, *self.names):
                for left in self.path.glob(f"{name}.*{UNFINISHED}"):
                    left.unlink(missing_ok=True)
            if self.record not in self.names:
                with in_one_piece(self.path / self.record) as file:
                    file.write(text(self.owner).encode())
            self._taken = True
            try:
                yield
            finally:
                self._taken = False

    def _there(self) -> Iterator[Path]:
        """Files of the names of the results."""
        for name in dict.fromkeys((self.record, *self.names)):
            if "*" in name:
                yield from sorted(self.path.glob(name))
            elif (self.path / name).exists() or (self.path / name).is_symlink():
                yield self.path / name


def _said(record: Path) -> dict[str, Any]:
    """Entries of a record."""
    written = record.read_text(encoding="utf-8")
    if record.suffix != ".csv":
        return dict(json.loads(written))
    head = (line[2:].partition(": ") for line in written.splitlines() if line.startswith("# "))
    return {name: json.loads(value) for name, _, value in head}


def _other(mine: Mapping[str, Any], theirs: Mapping[str, Any], part: bool) -> list[tuple[str, str]]:
    """Names of entries that differ, and the values of texts, which may be a `part` of all entries there."""
    found: list[tuple[str, str]] = []
    for key, value in mine.items():
        there = theirs.get(key)
        if part and isinstance(value, dict) and isinstance(there, dict):
            found += _other(value, there, part)
        elif key not in theirs or there != value:
            found.append((key, f" ({there})" if part and isinstance(there, str) else ""))
    return found if part else found + [(key, "") for key in sorted(theirs.keys() - mine.keys())]


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which the operating system takes away from a process that ends in whatever way."""
    place = folder / LOCK
    while True:
        try:
            opened = os.open(place, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            if place.is_symlink() or place.is_dir():
                raise OccupiedError(f"{place} is a link, or no file; remove it", item="folder") from error
            raise
        try:
            _lock(opened)
            if os.fstat(opened).st_nlink:
                break
            os.close(opened)  # the run that had it has just removed it
        except (BlockingIOError, PermissionError) as error:
            os.close(opened)
            raise OccupiedError(
                f"another run writes into {folder} ({_holder(place)}); wait until it ends, or give another folder "
                "(--out)",
                item="folder",
            ) from error
        except OSError as error:  # a file system without locks
            warnings.warn(
                f"{folder} cannot be locked ({error}): see to it that one run at a time writes there",
                UserWarning,
                stacklevel=5,
            )
            break
    try:
        os.ftruncate(opened, 0)
        os.write(opened, f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        if sys.platform != "win32":
            place.unlink(missing_ok=True)
        os.close(opened)


def _lock(opened: int) -> None:
    if sys.platform == "win32":
        os.lseek(opened, 1 << 30, os.SEEK_SET)  # others can read what lies before
        msvcrt.locking(opened, msvcrt.LK_NBLCK, 1)
        os.lseek(opened, 0, os.SEEK_SET)
    else:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _holder(place: Path) -> str:
    """Who says that it has a lock."""
    try:
        return place.read_text(encoding="utf-8", errors="replace") or "it has just begun"
    except FileNotFoundError:
        return "it has just ended"


def plain(value: Any) -> Any:
    """What JSON has: lists, keys that are text, and None for NaN and infinity."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def text(data: Any, indent: int | None = 1) -> str:
    """Data as JSON."""
    return json.dumps(plain(data), indent=indent, ensure_ascii=False, allow_nan=False)


def stored_arrays(file: BinaryIO) -> dict[str, Any]:
    """The arrays of an archive, each with its checksum compared.

    Nothing that kcons writes is compressed: an archive whose arrays, by its directory, are longer than itself is
    refused before any of them is read.
    """
    found: dict[str, Any] = {}
    with ZipFile(file) as archive:
        # A damaged entry of the directory may hide the next one; its last record says how many there are.
        length = file.seek(-_LAST_RECORD.size, SEEK_END) + _LAST_RECORD.size
        count = _LAST_RECORD.unpack(file.read(_LAST_RECORD.size))[4]
        if count != len(archive.namelist()):
            raise ValueError(f"{len(archive.namelist())} arrays are listed of {count}")
        unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > length:
            raise ValueError(f"it has {length:,} bytes and would unpack to {unpacked:,}")
        for name in archive.namelist():
            # Read whole: what `numpy.load` does not look at, it does not check either.
            content = BytesIO(archive.read(name))
            array = np.lib.format.read_array(content, allow_pickle=False)
            if content.read(1):
                raise ValueError(f"{name} has more than its array")
            found[name.removesuffix(".npy")] = array if array.ndim else array.item()
    return found


def refuse_clock(time: Any, step: Any, time_remainder: Any) -> None:
    """Refuse times that are no finite numbers, and counts of steps that are none.

    Raises
    ------
    InputError
    """
    if type(step) is int and step >= 0 and type(time) is float and math.isfinite(time) and time_remainder == 0.0:
        return  # as in nearly all steps
    finite_number(time, "time")
    finite_number(time_remainder, "time_remainder")
    whole_number(step, "step", 0)


def checked_state(values: dict[str, Any]) -> dict[str, Any]:
    """What a state is made of, as a step needs it."""
    shape = np.shape(values["positions"])
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"positions have shape {shape}")
    for name in ("positions", "velocities", "forces", "remainder"):
        if name in values:
            values[name] = finite_array(values[name], shape[0], name)
    for name in {"thermostat", "barostat"} & set(values):
        values[name] = np.atleast_1d(as_float_array(values[name], name))
        if not np.isfinite(values[name]).all():
            raise ValueError(f"{name} is not finite")
    if len(values.get("barostat", range(9))) < 9:
        raise ValueError(f"barostat has {len(values['barostat'])} numbers, which are no cell")
    refuse_clock(*(values.get(name, 0) for name in ("time", "step", "time_remainder")))
    return values
