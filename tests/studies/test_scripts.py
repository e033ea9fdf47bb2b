"""Calls in turn, their medians, and the options of scripts that measure."""

from __future__ import annotations

import functools
import json
import sys
from io import StringIO
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import study_scripts as scripts
from rich.console import Console

from kcons.errors import InputError


def test_calls_are_made_in_turn_and_timed_alone() -> None:
    made: list[str] = []
    ticks = count()
    calls = {name: lambda name=name: made.append(name) for name in "ab"}
    seconds = scripts.in_turn(calls, 3, clock=lambda: float(next(ticks)))
    assert "".join(made) == "ababab"
    assert seconds == {"a": [1.0] * 3, "b": [1.0] * 3}


def test_speeds_are_medians_over_the_turns() -> None:
    seconds = {"first": [1.0, 2.0, 9.0], "second": [2.0, 1.0, 3.0]}
    assert scripts.ratio(*seconds.values()) == 2.0
    found = scripts.speeds(seconds, 4)
    assert found["first"] == {"ms": 500.0, "ratio": 1.0}
    assert found["second"] == {"ms": 500.0, "ratio": 2.0}


def test_table_sets_numbers_to_the_right() -> None:
    made = scripts.table("Title", ("name", "ms"), {"name"}, [("a", "1")])
    assert [column.justify for column in made.columns] == ["left", "right"]
    console = Console(width=40, file=StringIO())
    console.print(made)
    assert "Title" in console.file.getvalue() and made.row_count == 1


def test_script_measures_writes_and_shows(tmp_path: Path) -> None:
    shown: list[dict] = []
    parser = scripts.options("About", full="everything")
    out = tmp_path / "result.json"
    scripts.script(parser, lambda chosen: {"full": chosen.full}, shown.append, ["--full", "--out", str(out)])
    assert shown == [{"full": True}] == [json.loads(out.read_text())]

    def never(chosen: object) -> dict:
        raise AssertionError("an earlier result is shown, not measured again")

    scripts.script(parser, never, shown.append, ["--show", str(out)])
    assert shown == [{"full": True}] * 2


@pytest.mark.parametrize("there", [False, True])
def test_measurements_are_continued(tmp_path: Path, there: bool) -> None:
    out = tmp_path / "result.json"
    if there:
        scripts.continued(out, lambda **given: given["keep"]({"parts": [1]}), quick=True)
    # Of a full run there is nothing yet.
    assert scripts.continued(out, lambda **given: {"none": given["earlier"]}, quick=False) == {"none": None}

    def measure(*, quick, keep, earlier) -> dict:
        assert quick and (earlier == {"parts": [1]} if there else earlier is None)
        keep({"parts": [1, 2]})
        return {"parts": [1, 2, 3]}

    assert scripts.continued(out, measure, quick=True) == {"parts": [1, 2, 3]}
    kept = json.loads(out.read_text())
    assert kept["parts"] == [1, 2] and "cpu" in kept["environment"]
    assert scripts.continued(None, lambda **given: {"none": given["earlier"]}, quick=True) == {"none": None}


def test_slope_has_the_error_of_correlated_noise() -> None:
    """Of 400 runs, the standard deviation of the slopes is what their errors say."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 2.0, 500)
    white = rng.normal(size=(400, 540))
    noise = np.stack([np.convolve(row, np.full(10, 0.1), mode="valid")[:500] for row in white])
    found = np.array([scripts.slope(t, 3.0 * t + 1.0 + row) for row in noise])
    assert found[:, 0].mean() == pytest.approx(3.0, abs=4 * found[:, 0].std() / 20)
    # Eight degrees of freedom: the root mean square of the errors is known to 1.8 %, the deviation to 3.5 %.
    assert np.sqrt(np.mean(found[:, 1] ** 2)) == pytest.approx(found[:, 0].std(), rel=0.16)
    assert scripts.slope(t, 2.0 - t) == pytest.approx((-1.0, 0.0), abs=1e-12)


def test_a_script_of_parts_measures_shows_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[object, int | str]] = []

    def measure(*, quick: bool, keep, earlier) -> dict:
        keep({"parts": {"one": 1}})
        return {"quick": quick}

    def command(*words: object) -> None:
        monkeypatch.setattr(sys, "argv", ["script", *map(str, words)])
        scripts.script_of_parts(
            "What it does.",
            measure,
            lambda result, console: shown.append((result, console.width)),
            lambda result, path: shown.append((result["parts"], path)),
            width=77,
        )

    out = tmp_path / "results.json"
    command("--full", "--out", out)
    command("--show", out)
    command("--show", out, "--draw", "P")
    assert shown[0] == ({"quick": False}, 77)
    assert [result["parts"] for result, _ in shown[1:3]] == 2 * [{"one": 1}] and shown[3:] == [({"one": 1}, "P")]


def test_a_script_of_runs_keeps_each_with_its_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, done, shown = tmp_path / "results.json", [], []

    def run(name: str) -> dict:
        done.append(name)
        return {"value": len(done)}

    def command(*words: object) -> None:
        monkeypatch.setattr(sys, "argv", ["script", *map(str, words)])
        runs = {name: functools.partial(run, name) for name in ("one", "two")}
        scripts.script_of_runs("What it does.", runs, lambda: shown.append("short"), shown.append, out)

    command()
    assert shown == ["short"] and not out.exists()
    command("--full")
    command("--full", "two")
    with pytest.raises(InputError, match="there is no run 'three'"):
        command("--full", "one", "three")
    assert done == ["one", "two", "two"]
    command("--show", out)
    result = shown[-1]
    assert {name: one["value"] for name, one in result["runs"].items()} == {"one": 1, "two": 3}
    assert all({"commit", "date", "cpu", "simd"} == set(one["environment"]) for one in result["runs"].values())
    assert result["environment"]["versions"]["numpy"]
