"""The page on comparisons shows the committed results of OpenMM and nothing else."""

from __future__ import annotations

import json

from committed_pages import FOLDER, page, printed

RESULTS = FOLDER / "openmm_compare.json"


def test_page_shows_the_committed_results():
    assert printed("11_openmm_compare.py", "openmm_compare.json", "--summary") in page("compare.md")


def test_results_are_those_of_a_full_run():
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert list(results) == ["alanine", "dhfr", "villin"]
    for found in results.values():
        assert found["environment"]["commit"]
        of = {name: [m for m in found["measurements"] if m["method"] == name] for name in found["settings"]["methods"]}
        assert all(of.values())
        # Tolerances do not change the error of OpenMM's own, kcons' scheme of order 6 does.
        own = [m["error"] for m in of["openmm-verlet-1e-12"]]
        best = min(m["error"] for m in of["openmm-kcons-blanes-moan6"] if "error" in m)
        assert own == sorted(own, reverse=True)
        assert best < 0.1 * own[-1]
        for m in of["openmm-held-rattle"]:
            assert m["constraint_residual"] < 1e-12
            assert m["velocity_residual"] < 1e-12
