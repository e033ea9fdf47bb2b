"""The page on speed shows the committed results and nothing else."""

from __future__ import annotations

from committed_pages import page, printed


def test_page_shows_the_committed_results():
    assert printed("03_engine_speed.py", "engine_speed.json") in page("speed.md")
