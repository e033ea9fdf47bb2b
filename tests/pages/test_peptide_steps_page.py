"""The page on step lengths shows what was measured on a peptide in water, and these say what the page says."""

from __future__ import annotations

import json
import math

from committed_pages import FOLDER, page, printed

RESULT = json.loads((FOLDER / "solvated_peptide.json").read_text(encoding="utf-8"))
RUNS = {
    (run["method"], run["step"], round(1000 * run["friction"])): run
    for run in RESULT["parts"].values()
    if "method" in run
}


def off(method, step, friction, kind="turn"):
    return RUNS[method, step, friction]["kinds"][kind]


def test_page_shows_the_committed_results():
    assert RESULT["full"]
    assert printed("studies/peptide_steps.py", "solvated_peptide.json") in page("step_length.md")


def test_nothing_stops_and_shifts_are_right_up_to_16_fs():
    assert all(run["status"] == "ok" for run in RUNS.values())
    for (_, step, _), run in RUNS.items():
        for kind in ("shift", "internal"):
            value, error = run["kinds"][kind]
            assert step > 16 or abs(value) <= 3 * error


def test_read_between_kicks_16_fs_are_right():
    """Where turns at the kicks are visibly off."""
    for step, friction in ((8.0, 5), (12.0, 20), (16.0, 20)):
        value, error = off("langevin-halfway", step, friction)
        assert abs(value) <= 3 * error and round(100 * abs(value), 1) <= 0.6  # as the page says
        assert off("langevin-respa", step, friction)[0] > value
    value, error = off("langevin-respa", 12.0, 20)
    assert value > 3 * error
    value, error = off("langevin-respa", 16.0, 20)
    assert 0.03 < value < 0.06 and value > 10 * error


def test_spheres_are_better_at_the_kicks_and_fail_at_24_fs():
    assert off("spheres", 16.0, 20)[0] < 0.5 * off("langevin-respa", 16.0, 20)[0]
    assert off("spheres", 24.0, 20)[0] > 0.05


def test_energies_agree_within_their_errors():
    known, doubt = RUNS["langevin", 2.0, 5]["energy"]
    for run in RUNS.values():
        value, error = run["energy"]
        assert abs(value - known) <= 3 * math.hypot(error, doubt)
