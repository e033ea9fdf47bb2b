"""Files that are either whole or not there, folders of one run, data as JSON."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from kcons.errors import OccupiedError
from kcons.steppers.files import ResultFolder, in_one_piece, plain, text


@pytest.mark.parametrize("error", [None, OSError, KeyboardInterrupt])
def test_a_file_is_there_once_it_is_whole(tmp_path: Path, error: type[BaseException] | None) -> None:
    """Where writing ends early the older one stays; what it was linked to is not written to."""
    other, path = tmp_path / "other", tmp_path / "a"
    other.write_bytes(b"of somebody else")
    path.symlink_to(other)
    with pytest.raises(error) if error else nullcontext(), in_one_piece(path) as file:
        file.write(b"newer")
        if error:
            raise error
        assert path.read_bytes() == b"of somebody else"
    assert other.read_bytes() == b"of somebody else"
    assert path.read_bytes() == (b"of somebody else" if error else b"newer") and path.is_symlink() == bool(error)
    assert sorted(found.name for found in tmp_path.iterdir()) == ["a", "other"]


def test_writers_of_one_path_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with in_one_piece(path) as one:
        one.write(b"the first half")
        with in_one_piece(path) as other:
            other.write(b"all of the other")
        assert path.read_bytes() == b"all of the other"
        with pytest.raises(OSError, match="full"), in_one_piece(path) as third:
            third.write(b"never more")
            raise OSError("the disk is full")
        one.write(b", and the second")
    assert path.read_bytes() == b"the first half, and the second"
    assert [found.name for found in tmp_path.iterdir()] == ["a"]


# -- folders of results -----------------------------------------------------------------------------


def of(folder: Path, **owner: object) -> ResultFolder:
    return ResultFolder(folder, "of.json", owner or {"system": "water"}, ["part-*.npz", "found.csv"], "a study")


def test_a_folder_is_of_one_run_at_a_time(tmp_path: Path) -> None:
    mine, other = of(tmp_path / "out"), of(tmp_path / "out")
    with mine.taken(), mine.taken():
        with pytest.raises(OccupiedError, match=r"another run writes into .*out; wait .*--out"):
            other.taken().__enter__()
        (tmp_path / "out" / "found.csv").write_text("mine")
    with other.taken():
        assert (tmp_path / "out" / "found.csv").read_text() == "mine"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".kcons.lock", "found.csv", "of.json"]


def test_a_run_that_was_killed_leaves_a_folder_to_the_next(tmp_path: Path) -> None:
    """What it had begun to write is cleared; no lock outlives its process."""
    (tmp_path / ".kcons.lock").touch()
    for name in ("part-1.npz", "kept.csv"):
        (tmp_path / f"{name}.0123.unfinished").write_text("half")
    with of(tmp_path).taken():
        left = sorted(path.name for path in tmp_path.glob("*.*"))
        assert left == [".kcons.lock", "kept.csv.0123.unfinished", "of.json"]


@pytest.mark.parametrize("name", ["part-3.npz", "found.csv", "of.json"])
@pytest.mark.parametrize("content", ["precious", '{"precious": 1}', "[" * 100_000])
def test_files_of_others_are_not_replaced(name: str, content: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(content)
    for begin in (of(tmp_path).refuse_others, of(tmp_path).taken().__enter__):
        with pytest.raises(OccupiedError, match=r"other files called .*give another folder \(--out\)"):
            begin()
    assert [found.name for found in tmp_path.iterdir()] == [name]
    assert path.read_text() == content


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with of(tmp_path, system="water", size=3).taken():
        pass
    of(tmp_path, system="water", size=3).refuse_others()
    for owner, said in (({"system": "chain", "size": 3}, "system"), ({"system": "water", "size": 2}, "size")):
        with pytest.raises(OccupiedError, match=f"has a study of another {said}; give another folder") as caught:
            of(tmp_path, **owner).refuse_others()
        assert caught.value.item == said
    (tmp_path / "file").touch()
    with pytest.raises(OccupiedError, match="there is a file where a folder has to be"):
        of(tmp_path / "file").refuse_others()


def test_a_result_may_be_the_record(tmp_path: Path) -> None:
    """It says more than whose it is."""
    (tmp_path / "r.json").write_text('{"settings": {"system": "water", "size": 3}, "numbers": [1]}')
    for system in ("water", "chain"):
        folder = ResultFolder(tmp_path, "r.json", {"settings": {"system": system}}, ["r.json"], "a study")
        if system == "water":
            with folder.taken():
                pass
        else:
            with pytest.raises(OccupiedError, match=r"a study of another system \(water\); give"):
                folder.refuse_others()
    assert "numbers" in (tmp_path / "r.json").read_text()


# -- data -------------------------------------------------------------------------------------------


def test_data_as_json() -> None:
    data = {1: (1.5, math.nan), "b": [-math.inf, {"c": None, "d": True}], "σ": np.float64(0.25)}
    wanted = {"1": [1.5, None], "b": [None, {"c": None, "d": True}], "σ": 0.25}
    assert plain(data) == wanted and json.loads(text(data)) == wanted
    assert "σ" in text(data) and "\n" not in text(data, indent=None)
