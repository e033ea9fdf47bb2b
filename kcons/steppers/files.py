"""Files that are either whole or not there, folders of one run, data as JSON, arrays whose damage is noticed."""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from os import PathLike
from pathlib import Path
from secrets import token_hex
from typing import Any, BinaryIO

import numpy as np

from kcons.constraints.arguments import finite_number, whole_number
from kcons.errors import InputError, OccupiedError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

#: Ends the names of files that are still being written.
UNFINISHED = ".unfinished"
#: The file that a run locks while it writes into a folder, and that stays there.
LOCK = ".kcons.lock"


def as_path(value: str | PathLike[str], item: str) -> Path:
    """The path that `value` names; `InputError` for what is neither text nor a path."""
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
        there = [path for name in dict.fromkeys((self.record, *self.names)) for path in sorted(self.path.glob(name))]
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


def _said(record: Path) -> dict[str, Any]:
    """Entries of a record."""
    written = record.read_text(encoding="utf-8")
    if record.suffix != ".csv":
        return dict(json.loads(written))
    head = (line[2:].partition(": ") for line in written.splitlines() if line.startswith("# "))
    return {name: json.loads(value) for name, _, value in head}


def _other(mine: Mapping[str, Any], theirs: Mapping[str, Any], part: bool) -> list[tuple[str, str]]:
    """Names of entries that differ, and the values of texts; those of a record that says more are a `part`."""
    found: list[tuple[str, str]] = []
    for key, value in mine.items():
        there = theirs.get(key)
        if part and isinstance(value, dict) and isinstance(there, dict):
            found += _other(value, there, part)
        elif there != value:
            found.append((key, f" ({there})" if part and isinstance(there, str) else ""))
    return found


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which the operating system takes away from a process that ends in whatever way."""
    with (folder / LOCK).open("a+") as opened:
        try:
            if sys.platform == "win32":
                msvcrt.locking(opened.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            raise OccupiedError(
                f"another run writes into {folder}; wait until it ends, or give another folder (--out)", item="folder"
            ) from error
        except OSError as error:  # a file system without locks
            warnings.warn(
                f"{folder} cannot be locked ({error}): see to it that one run at a time writes there",
                stacklevel=5,
            )
        yield


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


def write_arrays(file: BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Write arrays in NumPy's .npz format, with a checksum of all behind them."""
    whole = BytesIO()
    np.savez(whole, **arrays)
    file.write(whole.getvalue() + sha256(whole.getvalue()).digest())


def stored_arrays(file: BinaryIO) -> dict[str, Any]:
    """What `write_arrays` has written; `ValueError` unless all of it is as it was."""
    content = file.read()
    content, checksum = content[: -sha256().digest_size], content[-sha256().digest_size :]
    if sha256(content).digest() != checksum:
        raise ValueError("its checksum does not fit")
    with np.load(BytesIO(content), allow_pickle=False) as archive:
        return {name: array if array.ndim else array.item() for name, array in archive.items()}


def refuse_clock(time: Any, step: Any, time_remainder: Any) -> None:
    """Raise `InputError` for times that are no finite numbers, and counts of steps that are none."""
    if type(step) is int and step >= 0 and type(time) is float and math.isfinite(time) and time_remainder == 0.0:
        return  # as in nearly all steps
    finite_number(time, "time")
    finite_number(time_remainder, "time_remainder")
    whole_number(step, "step", 0)
