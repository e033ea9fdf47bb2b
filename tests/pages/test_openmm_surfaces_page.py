"""The page on surfaces shows the committed results and nothing else."""

from __future__ import annotations

from committed_pages import page, printed


def test_page_shows_the_committed_results():
    assert printed("studies/openmm_surfaces.py", "openmm_surfaces.json") in page("openmm_surfaces.md")
