"""The page on speed shows the committed results and nothing else."""

from __future__ import annotations

import json

from committed_pages import FOLDER, page, printed


def test_page_shows_the_committed_results():
    assert printed("studies/engine_speed.py", "engine_speed.json") in page("speed.md")
    assert printed("studies/engine_speed.py", "certificate.json") in page("speed.md")


def test_certificates_take_no_more_than_one_per_cent():
    """The committed run: 10 s of steps without forces a system."""
    found = json.loads((FOLDER / "certificate.json").read_text(encoding="utf-8"))
    assert found["full"] and len(found["certificates"]) == 5
    assert max(row["share"] for row in found["certificates"]) <= 0.01
