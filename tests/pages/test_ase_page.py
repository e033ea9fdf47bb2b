"""The page on ASE shows the committed measurements, and what it says of them is true."""

from __future__ import annotations

import json

import pytest
from committed_pages import FOLDER, page, printed

RESULTS = FOLDER / "ase_dynamics.json"


@pytest.fixture(scope="module")
def results():
    return json.loads(RESULTS.read_text(encoding="utf-8"))


def test_page_shows_the_committed_results():
    assert printed("studies/ase_dynamics.py", "ase_dynamics.json") in page("ase.md")


def test_all_of_it_was_measured(results):
    assert results["full"]


def test_statistics_lie_within_three_standard_errors(results):
    assert len(results["statistics"]) == 4
    for row in results["statistics"]:
        assert abs(row["mean"] - row["expected"]) <= 3 * row["error"], row["what"]
        assert row["error"] <= 0.01 * row["expected"], row["what"]


def test_what_order_four_gains(results):
    off = {row["stepper"]: row["deviation_ev"] for row in results["energy"]}
    assert f"{off['Rattle()'] / off['BlanesMoan4()']:.0f} times better than RATTLE" in page("ase.md")
    assert off["BlanesMoan6()"] > off["BlanesMoan4()"]


def test_energy_far_from_the_origin(results):
    rows = results["far"]
    assert all(row["kcons"] <= 1e-10 for row in rows)
    assert max(row["ase"] for row in rows if row["distance"] == 1e6) > 1e-5


def test_rattle_costs_less_than_velocity_verlet(results):
    steps = {(row["waters"], row["dynamics"]): row["step_us"] for row in results["cost"]}
    for n in (10, 100, 1000):
        assert steps[n, "ConstrainedDynamics, Rattle()"] < steps[n, "VelocityVerlet"]


def test_energy_at_equal_evaluations(results):
    deviation = {row["stepper"]: row["deviation_ev"] for row in results["energy"]}
    assert results["energy"][0]["forces"] == "GFN2-xTB"
    assert deviation["BlanesMoan4()"] < deviation["Rattle()"] / 100
