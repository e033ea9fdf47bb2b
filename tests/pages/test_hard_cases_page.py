"""The page on hard cases shows the committed results and nothing else."""

from __future__ import annotations

from pathlib import Path

from kcons.comparison.hard_cases import OURS, load, report

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results" / "hard_cases.json"


def test_page_shows_the_committed_results():
    assert report.markdown(load(RESULTS)) in (ROOT / "docs" / "hard-cases.md").read_text(encoding="utf-8")


def test_no_case_of_kcons_is_silent():
    result = load(RESULTS)
    assert result["environment"]["commit"]
    assert result["systems"][:3] == list(OURS)
    assert report.failures(result) == []
    short = [name for name, row in result["cells"].items() if not row["kcons"]["met"]]
    assert [name for name in short if result["cells"][name]["kcons"]["verdict"] != "cannot express"] == []
