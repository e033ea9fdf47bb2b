"""The page on the error budget shows the committed numbers, and they say what it says."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "error-budget.md").read_text(encoding="utf-8")
RESULTS = json.loads((ROOT / "docs" / "results" / "error_budget.json").read_text(encoding="utf-8"))
SYSTEMS = ("water", "chain", "dumbbells")


def load_example():
    spec = importlib.util.spec_from_file_location("error_budget", ROOT / "examples" / "18_error_budget.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


example = load_example()


def slope(points):
    x, y = np.log([point[:2] for point in points]).T
    return float(np.polyfit(x, y, 1)[0])


def test_page_shows_the_committed_numbers():
    assert example.show(RESULTS) in PAGE


def test_the_figure_can_be_drawn_from_them(tmp_path):
    example.plot(RESULTS, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000
    assert (ROOT / "docs" / "figures" / "error_budget.png").exists()


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_step_enters_with_the_order(system):
    found = RESULTS["scenes"][system]
    assert slope(found["steps"]["kcons RATTLE"]) == pytest.approx(2.0, abs=0.1)
    best = {title: min(error for _, error in points) for title, points in found["steps"].items()}
    assert best["kcons BlanesMoan6"] < 0.05 * best["kcons RATTLE"]


def test_the_tolerance_enters_with_its_first_power():
    solvers = RESULTS["scenes"]["chain"]["tolerances"]["solvers"]
    for solver in ("shake", "openmm-verlet"):
        assert slope(solvers[solver]) == pytest.approx(1.0, abs=0.1)
    # About as large as the tolerance after the whole run.
    for tolerance, distance, _ in solvers["shake"]:
        assert 0.05 * tolerance < distance < 20 * tolerance


@pytest.mark.parametrize("system", SYSTEMS)
def test_kcons_has_none(system):
    ((_, distance, residual),) = RESULTS["scenes"][system]["tolerances"]["solvers"]["kcons"]
    assert distance < 1e-10 and residual < 1e-13


def test_settle_has_its_own():
    found = [row[1] for row in RESULTS["scenes"]["water"]["tolerances"]["solvers"]["openmm-verlet"]]
    assert max(found) < 1.5 * min(found)
    assert 1e-8 < found[-1] < 1e-6


def test_rounding_stops_the_gain_and_leaves_the_constraints_alone():
    curves = RESULTS["rounding"]["curves"]
    _, errors, residuals = np.array(curves["BlanesMoan6"]).T
    assert errors.min() < 1e-12
    assert errors[-1] < 1e-10
    assert residuals.max() < 1e-14
    assert slope([p[:2] for p in curves["RATTLE"][:8]]) == pytest.approx(-2.0, abs=0.1)
