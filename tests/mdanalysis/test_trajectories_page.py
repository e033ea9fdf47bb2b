"""The page on trajectories shows the committed costs of a check, and these reach what they must."""

from __future__ import annotations

import json
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
CASES = json.loads((DOCS / "results" / "trajectory_check.json").read_text(encoding="utf-8"))["cases"]


def test_committed_costs():
    assert {(case["format"], case["atoms"]) for case in CASES} == {("dcd", 99_000), ("xtc", 99_000), ("dcd", 9_000)}
    for case in CASES:
        assert case["bytes"] > 0.99e9
        assert case["speed_of_reader"] >= 0.8
        assert case["gain_of_two_workers"] >= 1.6
        assert case["check"]["peak"] <= 300 >= case["two workers"]["peak"]


def test_the_page_shows_them():
    page = (DOCS / "trajectories.md").read_text(encoding="utf-8")
    for case in CASES:
        row = (
            f"| {case['format'].upper()}, {case['frames']} frames of {case['atoms']:,} atoms "
            f"| {case['reader']['cpu']:.2f} s | {case['check']['cpu']:.2f} s | {case['speed_of_reader']:.0%} "
            f"| {case['check']['peak']:.0f} MB | {case['gain_of_two_workers']:.2f} × |"
        ).replace("%", " %")
        assert row in page
