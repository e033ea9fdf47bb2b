"""The page on kcons' constraints in OpenMM shows the committed results and nothing else."""

from __future__ import annotations

from committed_pages import page, printed


def test_page_shows_the_committed_results():
    assert printed("studies/openmm_constraints.py", "openmm_constraints.json") in page("openmm_constraints.md")
