"""The page on Monte Carlo shows the committed results, and these reach what they must."""

from __future__ import annotations

import json

import numpy as np
from committed_pages import FOLDER, page, printed

RESULT = json.loads((FOLDER / "monte_carlo.json").read_text(encoding="utf-8"))


def test_the_page_shows_them():
    assert printed("studies/hamiltonian_monte_carlo.py", "monte_carlo.json") in page("monte_carlo.md")


def test_distributions_are_those_of_quadrature_and_of_metropolis():
    """p above 0.001, and the least of the samplers as low as chance makes it."""
    small = RESULT["small"]
    values = [p for row in small["rows"] if "HMC" in row["method"] for p in row["p"]]
    assert len(values) == 12 and 1 - (1 - min(values)) ** 12 > 0.05
    for row in small["rows"]:
        away = np.abs(np.array(row["mean"]) - small["exact"]) / row["error"]
        assert away.max() < 3.5, row["method"]
        assert min(row["p"]) > 1e-3 and min(row["p_metropolis"]) > 1e-3, row["method"]
        assert row["independent"] >= 2400
        assert row["rejected"] is None or sum(row["rejected"]) > 20


def test_rigid_water_makes_long_steps():
    """Nine tenths accepted at 1.5 fs an evaluation of 512 molecules; a loose Ewald sum spoils it."""
    rows = {(r["scheme"], r["dt"], r["ewald_tolerance"], r["switched"]): r for r in RESULT["water"]["rows"]}
    assert RESULT["water"]["molecules"] == 512
    good = rows["blanes-moan4", 12.0, 1e-5, True]
    assert good["accepted"] >= 0.9 * good["proposals"] >= 36 and good["fs_per_evaluation"] >= 1.5
    assert good["expected"] >= 0.9
    assert rows["rattle", 2.0, 1e-5, True]["expected"] < 0.9
    assert rows["blanes-moan4", 9.0, 5e-4, True]["spread"] > 10 * rows["blanes-moan4", 9.0, 1e-5, True]["spread"]
    assert all(row["not_reversible"] == 0 for row in rows.values())


def test_single_precision_shows():
    off = {row["platform"]: row["off"] for row in RESULT["precision"]["rows"]}
    assert off["OpenCL double"] < off["CPU"] < 1e-3 < 10 * off["OpenCL mixed"] < off["OpenCL single"]


def test_chains_take_a_hundredth_of_the_time():
    """Effective samples a second of processor time: more than 100 times those of mici on 1000 bonds."""
    rates: dict[tuple[int, str], list[float]] = {}
    for row in RESULT["chain"]["rows"]:
        rates.setdefault((row["bonds"], row["package"]), []).append(row["effective"] / row["cpu_seconds"])
    assert min(rates[1000, "kcons"]) > 100 * max(rates[1000, "mici"])
    assert len(rates[100, "kcons"]) == len(rates[100, "mici"]) == 3
    assert min(rates[100, "kcons"]) > max(rates[100, "mici"])


def test_a_protein_in_water_is_accepted():
    (row,) = RESULT["dhfr"]["rows"]
    assert row["expected"] >= 0.9 and row["proposals"] == 24 and row["not_reversible"] == 0
    assert row["accepted"] >= 0.9 * row["proposals"]


def test_physical_validation_finds_nothing():
    judge = RESULT["judge"]
    assert min(judge["kinetic_p"]) > 1e-3 and max(judge["ensemble_sigma"]) < 3.5
    assert judge["samples"] > 1000 and 0.5 < min(judge["acceptance"]) < 1
