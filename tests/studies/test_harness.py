"""Studies write one row a measurement, go on where they were cut off, and refuse files of other runs."""

from __future__ import annotations

import sys
from itertools import count

import harness
import pytest

from kcons.errors import InputError


def test_a_study_that_was_cut_off_goes_on(tmp_path):
    path, asked = tmp_path / "out" / "study.csv", []

    def piece(name):
        asked.append(name)
        if name == "b" and asked.count("b") == 1:
            raise KeyboardInterrupt
        return [{"value": 0.1 + len(name), "words": "a, 'b'"}, {"value": 1e-300, "more": None}]

    pieces = {name: lambda name=name: piece(name) for name in "abc"}
    with pytest.raises(KeyboardInterrupt):
        harness.run(path, pieces, quick=True)
    head, kept = harness.read(path)
    assert list(kept.piece) == ["a", "a"] and head["settings"] == "quick=True"
    assert {"commit", "machine", "versions", "date"} <= set(head)
    table = harness.run(path, pieces, quick=True)
    assert asked == ["a", "b", "b", "c"]
    assert list(table.piece) == list("aabbcc")
    again = harness.read(path)[1]
    assert list(again.value) == [1.1, 1e-300] * 3 and again.words[0] == "a, 'b'"
    assert [file.name for file in path.parent.iterdir()] == ["study.csv"]
    # Files of other runs are refused.
    before = path.read_text()
    with pytest.raises(InputError, match=r"settings 'quick=True', not 'quick=False': give another --out"):
        harness.run(path, pieces, quick=False)
    assert path.read_text() == before


def test_calls_are_made_in_turn_and_their_speeds_are_medians_over_the_turns():
    made, ticks = [], count()
    calls = {name: lambda name=name: made.append(name) for name in "ab"}
    assert harness.in_turn(calls, 3, clock=lambda: float(next(ticks))) == {"a": [1.0] * 3, "b": [1.0] * 3}
    assert "".join(made) == "ababab"
    seconds = {"first": [1.0, 2.0, 9.0], "second": [2.0, 1.0, 3.0]}
    assert harness.ratio(*seconds.values()) == 2.0
    found = harness.speeds(seconds, 4)
    assert found == {"first": {"ms": 500.0, "ratio": 1.0}, "second": {"ms": 500.0, "ratio": 2.0}}


def test_a_study_as_a_command(tmp_path, monkeypatch, capsys):
    def tables(table):
        times = harness.shown(table, "one", name="{}", ms="{:.1f}")
        return {"Times": times, "None": harness.shown(table, "two", x="{}")}

    monkeypatch.setattr(sys, "argv", ["study", "--quick", "--out", str(tmp_path)])
    rows = [{"part": "one", "name": "a", "ms": 1.25}, {"part": "one", "name": "b", "ms": None}]
    harness.main("study", harness.options("About", "out"), lambda chosen: {"all": lambda: rows}, tables)
    printed = capsys.readouterr().out
    assert "Times\nname  ms\n   a 1.2\n   b" in printed and "None\n" not in printed and "commit" in printed
    assert harness.read(tmp_path / "study.csv")[0]["settings"] == "quick=True"
