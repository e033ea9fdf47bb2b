"""Results in files: plain data, complete or not there, and read with a reason if they are something else."""

from __future__ import annotations

import json
import math

import pytest

from kcons.comparison.study import json_files
from kcons.errors import InputError


def test_what_json_lacks_becomes_what_it_has(tmp_path):
    data = {1: (1.5, math.nan), "b": [math.inf, {"c": None}], "σ": "é"}
    path = json_files.write(tmp_path / "a.json", data)
    assert json.loads(path.read_text(encoding="utf-8")) == {"1": [1.5, None], "b": [None, {"c": None}], "σ": "é"}
    assert "σ" in path.read_text(encoding="utf-8")
    assert json_files.read(path) == json_files.plain(data)


def test_numbers_that_json_lacks_are_read_from_older_files(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": NaN, "b": -Infinity}')
    assert json_files.read(path) == {"a": None, "b": None}


def test_digits():
    assert json_files.plain({"a": [1.23456e-7, 12345.6, 12345]}, 3) == {"a": [1.23e-7, 12300.0, 12345]}


def test_text_is_written_as_it_is(tmp_path):
    path = json_files.write(tmp_path / "a.json", '{"a":\n1}')
    assert path.read_text() == '{"a":\n1}\n'


def test_an_older_file_stays_where_the_new_one_cannot_be_written(tmp_path):
    path = json_files.write(tmp_path / "a.json", {"a": 1}, indent=None)
    assert path.read_text() == '{"a": 1}\n'
    with pytest.raises(TypeError):
        json_files.write(path, {"a": object()})
    assert path.read_text() == '{"a": 1}\n'
    assert [found.name for found in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize("text", ["[1", "[1]", '{"a": 1}', '{"format": "other"}', "\xff"])
def test_other_files_are_refused(tmp_path, text):
    path = tmp_path / "x.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"x\.json holds no result of this study"):
        json_files.read(path, "mine", of="this study")
