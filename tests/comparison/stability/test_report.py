"""The page shows the committed results, and these have no faults."""

from __future__ import annotations

from pathlib import Path

from kcons.comparison.stability import report
from kcons.comparison.study import json_files

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "docs" / "results" / "stability.json"


def test_page_shows_the_committed_results():
    result = json_files.read(RESULTS)
    shown = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    for part, words in report.markdown(result).items():
        assert words in shown, part


def test_committed_results_have_no_faults():
    result = json_files.read(RESULTS)
    assert result["environment"]["commit"]
    assert report.failures(result) == []
    assert result["fuzz"]["faults"] == []
    assert result["fuzz"]["trials"] >= 10_000
