"""Files that are either whole or not there, data as JSON, archives whose damage is noticed."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.steppers.files import as_path, in_one_piece, plain, stored_arrays, text


def test_what_names_a_path(tmp_path: Path) -> None:
    assert as_path("a/b", "folder") == Path("a/b") and as_path(tmp_path, "folder") == tmp_path
    for wrong in (3, None, b"a"):
        with pytest.raises(InputError, match="; give a path"):
            as_path(wrong, "folder")  # type: ignore[arg-type]


def test_a_file_is_there_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with in_one_piece(path) as file:
        file.write(b"all of it")
        assert not path.exists()
    assert path.read_bytes() == b"all of it"
    assert [found.name for found in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_an_older_file_stays_where_writing_ends_early(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"older")
    with pytest.raises(error), in_one_piece(path) as file:
        file.write(b"newer")
        raise error
    assert path.read_bytes() == b"older"
    assert [found.name for found in tmp_path.iterdir()] == ["a"]


def test_what_was_left_unfinished_is_written_anew_and_links_are_not_followed(tmp_path: Path) -> None:
    other, path = tmp_path / "other", tmp_path / "a"
    other.write_bytes(b"of somebody else")
    (tmp_path / "a.unfinished").symlink_to(other)
    path.symlink_to(other)
    with in_one_piece(path) as file:
        file.write(b"mine")
    assert other.read_bytes() == b"of somebody else"
    assert path.read_bytes() == b"mine" and not path.is_symlink()


def test_data_as_json() -> None:
    data = {1: (1.5, math.nan), "b": [-math.inf, {"c": None, "d": True}], "σ": np.float64(0.25)}
    wanted = {"1": [1.5, None], "b": [None, {"c": None, "d": True}], "σ": 0.25}
    assert plain(data) == wanted and json.loads(text(data)) == wanted
    assert "σ" in text(data) and "\n" not in text(data, indent=None)


def test_digits() -> None:
    assert plain([1.23456e-7, 12345.6, 12345, "1.23456"], 3) == [1.23e-7, 12300.0, 12345, "1.23456"]


def archive(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def test_arrays_of_an_archive() -> None:
    found = stored_arrays(io.BytesIO(archive(x=np.arange(6.0).reshape(2, 3), time=np.array(0.5))))
    np.testing.assert_array_equal(found["x"], [[0, 1, 2], [3, 4, 5]])
    assert found["time"] == 0.5 and isinstance(found["time"], float)


def test_archives_with_objects_are_refused() -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        stored_arrays(io.BytesIO(archive(x=np.array([{}], dtype=object))))


def test_a_damaged_number_is_noticed() -> None:
    whole = bytearray(archive(x=np.arange(64.0)))
    whole[300] ^= 1
    with pytest.raises(Exception, match="CRC"):
        stored_arrays(io.BytesIO(bytes(whole)))
