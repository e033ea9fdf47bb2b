"""The page on trajectories shows the committed costs of a check, and these reach what they must."""

from __future__ import annotations

import json
from pathlib import Path

from kcons.comparison import processor_of

DOCS = Path(__file__).resolve().parents[2] / "docs"
RESULTS = json.loads((DOCS / "results" / "trajectory_check.json").read_text(encoding="utf-8"))
CASES, COLD = RESULTS["cases"], RESULTS["cold"]["cases"]
KINDS = {("dcd", 99_000), ("xtc", 99_000), ("dcd", 9_000)}


def test_committed_costs():
    assert {(case["format"], case["atoms"]) for case in CASES} == KINDS
    for case in CASES:
        assert case["bytes"] > 0.99e9
        assert case["speed_of_reader"] >= 0.8
        assert case["gain_of_two_workers"] >= 1.6
        assert case["check"]["peak"] <= 300 >= case["two workers"]["peak"]


def test_committed_memory_where_nothing_is_compiled_yet():
    assert {(case["format"], case["atoms"], case["workers"]) for case in COLD} == {
        (*k, n) for k in KINDS for n in (1, 2)
    }
    for case in COLD:
        assert case["bytes"] > 0.99e9
        for key in ("peak", "peak_of_others", "peak_of_command"):
            assert 100 < case[key] <= 300, (case, key)
    assert RESULTS["cold"]["environment"]["commit"] == RESULTS["environment"]["commit"]


def test_the_page_shows_them():
    page = (DOCS / "trajectories.md").read_text(encoding="utf-8")
    assert f"one core of {processor_of(RESULTS['environment'])}, CPU times" in page
    for case in CASES:
        row = (
            f"| {case['format'].upper()}, {case['frames']} frames of {case['atoms']:,} atoms "
            f"| {case['reader']['cpu']:.2f} s | {case['check']['cpu']:.2f} s | {case['speed_of_reader']:.0%} "
            f"| {case['check']['peak']:.0f} MB | {case['gain_of_two_workers']:.2f} × |"
        ).replace("%", " %")
        assert row in page
    for case in COLD:
        workers = ("one worker", "two workers")[case["workers"] - 1]
        row = (
            f"| {case['format'].upper()}, {case['atoms']:,} atoms, {workers} | {case['peak']:.0f} MB "
            f"| {case['peak_of_command']:.0f} MB | {case['peak_of_others']:.0f} MB |"
        )
        assert row in page
