"""The page on the whole comparison shows the committed results, and these are complete."""

from __future__ import annotations

import re

import pytest
from committed_pages import FOLDER, ROOT, page

from kcons import comparison_page, everything

PARTS = everything.parts(FOLDER / "report")
PAGE = page("report.md")


def test_page_shows_the_committed_results():
    assert comparison_page.results(PARTS) in PAGE


def test_page_shows_the_pictures_of_these_parts():
    shown = re.findall(r"^!\[(.*)\]\(figures/report-(.*)\.png\)$", PAGE, re.MULTILINE)
    assert sorted(shown) == sorted((part.heading, part.key) for part in PARTS if part.key in comparison_page.PICTURES)
    assert {key for _, key in shown} == set(comparison_page.PICTURES)
    for _, key in shown:
        assert (ROOT / "docs" / "figures" / f"report-{key}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.key)
def test_parts_were_measured_in_a_full_run(part):
    assert "comparison" in part.data or "result" in part.data, part.data.get("not run", part.data.get("failed"))
    assert part.data["environment"]["commit"]
    if "comparison" in part.data:
        assert part.data["comparison"]["settings"]["quick"] is False


def test_no_part_is_missing():
    assert [part.key for part in PARTS] == [item.key for item in everything.PLAN]
