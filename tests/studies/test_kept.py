"""Studies go on where they were interrupted, by the same code with the same settings."""

from __future__ import annotations

from functools import partial

import pytest
from kcons.comparison.study import json_files
from study_scripts import Kept, Watcher, picked, work_off

from kcons.errors import InputError


class Listener(Watcher):
    def __init__(self):
        self.heard = []

    def begin(self, what, total):
        self.heard.append((what, total))

    def advance(self, done):
        self.heard.append(done)

    def end(self):
        self.heard.append("end")


def test_pieces_are_done_once_and_progress_is_told():
    found, listener = {"b": 0}, Listener()
    pieces = {name: partial(ord, name) for name in "abc"}
    work_off("letters", pieces, found.__setitem__, dict(found), listener)
    assert found == {"a": 97, "b": 0, "c": 99}
    assert listener.heard == [("letters", 3), 1, 2, 3, "end"]


def test_an_interrupt_keeps_what_is_done(tmp_path):
    def interrupted():
        raise KeyboardInterrupt

    made, listener = {"quick": True}, Listener()
    kept = Kept(tmp_path / "a.json", made, form="form-1")
    found = {}

    def put(name, value):
        found[name] = value
        kept.put({"pieces": found})

    with pytest.raises(KeyboardInterrupt):
        work_off("both", {"first": lambda: 1, "second": interrupted}, put, watcher=listener)
    assert listener.heard[-1] == "end"
    assert Kept(tmp_path / "a.json", made, form="form-1").earlier()["pieces"] == {"first": 1}
    stored = json_files.read(tmp_path / "a.json", "form-1")
    assert list(stored) == ["format", "made_by", "environment", "pieces"] and "cpu" in stored["environment"]


@pytest.mark.parametrize("other", [{"made_by": {"quick": False}}, {"form": "form-2"}, {"under": "key"}])
def test_other_code_settings_or_formats_do_not_count(tmp_path, other):
    path = tmp_path / "a.json"
    same = {"made_by": {"quick": True}, "form": "form-1"}
    Kept(path, **same).put({"a": 1})
    assert Kept(path, **same).earlier()["a"] == 1
    assert Kept(path, **{**same, **other}).earlier() == {}


def test_half_a_file_none_and_nowhere(tmp_path):
    (tmp_path / "a.json").write_text('{"format": "fo')
    for path in (tmp_path / "a.json", tmp_path / "b.json", None):
        assert Kept(path, {}).earlier() == {}
    Kept(None, {}).put({"a": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_another_text_is_put(tmp_path):
    Kept(tmp_path / "a.json", {}, pack=lambda data: '{"packed": true}').put({"a": 1})
    assert (tmp_path / "a.json").read_text() == '{"packed": true}\n'


def test_names_are_picked_out_of_those_there_are():
    known = {"a": 1, "b": 2}
    assert picked(None, known, "part", "only") == ["a", "b"]
    assert picked(iter("b"), known, "part", "only") == ["b"]
    with pytest.raises(InputError, match="no part is named; there are a, b"):
        picked([], known, "part", "only")
    with pytest.raises(InputError, match="there is no part 'c'; there are a, b") as error:
        picked(["a", "c"], known, "part", "only")
    assert error.value.item == "only"
