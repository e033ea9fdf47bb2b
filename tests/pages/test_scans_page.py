"""The page on scans shows the committed counts, and these reach what they must."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

DOCS = Path(__file__).resolve().parents[2] / "docs"
RESULTS = json.loads((DOCS / "results" / "scans.json").read_text(encoding="utf-8"))
PAGE = (DOCS / "scans.md").read_text(encoding="utf-8")
MOLECULES = RESULTS["molecules"]
OTHERS = ("geomeTRIC", "Sella")
PROGRAMS = ("kcons", *OTHERS, "geomeTRIC's scan")


def test_twenty_molecules_without_a_failure():
    assert len({m["molecule"] for m in MOLECULES}) == 20 and RESULTS["points"] == 24 and RESULTS["fmax"] == 0.005
    for m in MOLECULES:
        assert m["failures"] == 0
        assert all(len(m["points"][name]) == 24 and sum(m["points"][name]) == m["calls"][name] for name in OTHERS)


def test_no_more_calls_than_the_others():
    for m in MOLECULES:
        assert m["calls"]["kcons"] <= min(m["calls"][name] for name in PROGRAMS)


def test_energies_agree():
    """With those of geomeTRIC, sharply converged from the same structures: ten times better than 0.1 kJ/mol."""
    assert max(m["off"]["kcons"] for m in MOLECULES) <= 0.01


def test_the_page_shows_them():
    for m in MOLECULES:
        calls, both = m["calls"], m["both ways"]
        off = " | ".join(f"{m['off'][name]:.3f}" for name in ("kcons", *OTHERS))
        row = (
            f"| {m['molecule']} | {m['barrier']:.2f} | {' | '.join(str(calls[name]) for name in PROGRAMS)} "
            f"| {off} | {both['calls']} | {both['hysteresis']:.3f} |"
        )
        assert row in PAGE
    total = [sum(m["calls"][name] for m in MOLECULES) for name in PROGRAMS]
    assert (
        f"| all | | {' | '.join(map(str, total))} | | | | {sum(m['both ways']['calls'] for m in MOLECULES)} | |" in PAGE
    )
    assert f"{total[0]:,} in all, where geomeTRIC needed {total[1]:,} and Sella {total[2]:,}" in PAGE
    versions = RESULTS["versions"]
    assert f"geomeTRIC {versions['geometric']}, Sella {versions['sella']}, tblite {versions['tblite']}" in PAGE


def test_half_of_the_points_take_few_calls():
    """After the first five of each molecule."""
    later = [n for m in MOLECULES for n in m["points"]["kcons"][5:]]
    assert np.median(later) <= 3 and "points take three calls of energy and forces or fewer" in PAGE
