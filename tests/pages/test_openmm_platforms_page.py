"""The page on platforms shows the committed results, and these are what it says."""

from __future__ import annotations

import json
from pathlib import Path

from committed_pages import page, printed

FILE = Path(__file__).parents[2] / "docs" / "results" / "openmm_platforms.json"
RESULT = json.loads(FILE.read_text(encoding="utf-8"))


def test_page_shows_the_committed_results():
    assert printed("studies/openmm_platforms.py", FILE.name) in page("openmm_platforms.md")


def test_rattle_has_the_speed_of_verlet_and_drifts_no_more():
    assert RESULT["full"]
    assert "CUDA" in RESULT["measurements"][0]["title"]
    for part in RESULT["measurements"]:
        rows = part["rows"]
        assert rows["kcons RattleIntegrator"]["ratio"] >= 0.95
        verlet = rows["VerletIntegrator"]["drift"]
        for name in ("kcons RattleIntegrator", "kcons rattle"):
            drift = rows[name]["drift"]
            error = (drift["error"] ** 2 + verlet["error"] ** 2) ** 0.5
            assert abs(drift["slope"]) <= abs(verlet["slope"]) + 3 * error
            assert drift["error"] < 1e-3
            assert drift["picoseconds"] >= 100
        for row in rows.values():
            assert row["residual"] < 6e-8


def test_rattle_drifts_no_more_than_verlet_on_opencl():
    file = FILE.with_name("openmm_mixed_drift.json")
    assert printed("studies/openmm_platforms.py", file.name) in page("openmm_platforms.md")
    (part,) = json.loads(file.read_text(encoding="utf-8"))["measurements"]
    assert "Villin in water" in part["title"] and "OpenCL, mixed precision" in part["title"]
    verlet = part["rows"]["VerletIntegrator"]["drift"]
    for row in part["rows"].values():
        assert row["residual"] < 6e-8
        assert row["drift"]["picoseconds"] >= 10 and len(row["runs"]) == 3
        error = (row["drift"]["error"] ** 2 + verlet["error"] ** 2) ** 0.5
        assert abs(row["drift"]["slope"]) <= abs(verlet["slope"]) + 2 * error
