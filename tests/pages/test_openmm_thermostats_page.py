"""The committed results of thermostats in OpenMM reach what they must."""

from __future__ import annotations

import json
import math
import runpy

import pytest
from committed_pages import FOLDER, ROOT

RESULTS = FOLDER / "openmm_thermostats.json"


def test_results_are_those_of_a_full_run():
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    assert results["full"] and all(part["machine"]["commit"] for part in results["measurements"].values())
    speed = {name: row["ratio"] for name, row in results["measurements"]["speed"]["rows"].items()}
    assert speed["VerletIntegrator"] == 1.0
    assert speed["kcons Isokinetic"] >= 0.85 and speed["kcons rattle"] >= 0.9
    assert speed["kcons RattleIntegrator"] >= 0.97
    assert speed["kcons Langevin"] >= 0.9 * speed["LangevinMiddleIntegrator"]
    simulation = results["measurements"]["simulation"]["rows"]
    assert len(simulation) == 8 and all(row["quotient"] <= 1.02 for row in simulation.values())


def test_a_long_step_of_langevin_is_no_worse_than_a_short_one_of_openmm():
    """What is left of the mean energy at 4 fs, against LangevinMiddleIntegrator at 2 fs, within standard errors."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))["measurements"]["sampling"]
    zero = found["reference"]

    def off(name: str, fs: float) -> tuple[float, float]:
        (row,) = (row for row in found["sampling"][name] if row["fs"] == fs)
        return abs(row["mean"] - zero["mean"]), math.hypot(row["error"], zero["error"])

    ours, error = off("kcons Langevin", 4.0)
    theirs, other = off("LangevinMiddleIntegrator", 2.0)
    assert ours - theirs <= math.hypot(error, other)
    assert ours <= 3 * error


def _within_three_errors(rows: dict[str, dict[str, float]]) -> None:
    assert {"kcons NoseHoover, 1 fs", "kcons NoseHoover, 2 fs"} == set(rows)
    for row in rows.values():
        assert abs(row["mean"] - row["g"]) <= 3 * row["mean error"] <= 0.01 * row["g"]
        assert abs(row["variance"] - 2 * row["g"]) <= 3 * row["variance error"] <= 0.1 * 2 * row["g"]


def test_kinetic_energies_under_a_chain_are_those_of_the_degrees_of_freedom():
    kinetic = json.loads(RESULTS.read_text(encoding="utf-8"))["measurements"]["kinetic"]
    _within_three_errors(kinetic["rows"])


@pytest.mark.validation
def test_kinetic_energies_anew():
    """The committed runs once more, three minutes."""
    example = runpy.run_path(str(ROOT / "examples" / "studies/openmm_thermostats.py"))
    _within_three_errors(example["kinetic"](True)["rows"])
