"""The page on steppers shows the committed results and the steppers' own properties; its figures can be had again."""

from __future__ import annotations

import importlib.util
import json
import re
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from kcons import steppers
from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.work_precision import measure

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "steppers.md").read_text(encoding="utf-8")
RESULTS = json.loads((ROOT / "docs" / "results" / "high_order.json").read_text())
LONG_RUNS = json.loads((ROOT / "docs" / "results" / "long_runs.json").read_text())


def load_example():
    spec = importlib.util.spec_from_file_location("high_order", ROOT / "examples" / "04_high_order.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


example = load_example()


def test_page_shows_the_committed_results():
    shown = StringIO()
    example.show(RESULTS, Console(file=shown, width=150, color_system=None))
    assert "\n".join(line.rstrip() for line in shown.getvalue().strip().splitlines()) in PAGE


def table_of_the_page():
    head, _, *lines = re.search(r"^\| stepper \|.*?(?=\n\n)", PAGE, re.MULTILINE | re.DOTALL).group().splitlines()
    names = [cell.strip() for cell in head.strip("|").split("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0].strip("`"): dict(zip(names, row, strict=True)) for row in rows}


def test_table_names_every_stepper():
    kinds = {type(m.stepper).__name__ for m in methods.METHODS.values() if isinstance(m, methods.CoreStepper)}
    assert set(table_of_the_page()) == kinds


@pytest.mark.parametrize("name", table_of_the_page())
def test_table_says_what_the_stepper_says(name):
    row = table_of_the_page()[name]
    kind = getattr(steppers, name)
    stepper = kind(rate=1.0) if name == "Baumgarte" else kind()
    assert int(row["order"]) == stepper.order
    assert int(row["forces a step"]) == stepper.force_evaluations
    assert (row["reversible"] == "yes") == stepper.reversible
    assert (row["symplectic"] == "yes") == stepper.symplectic
    refuses = isinstance(stepper, steppers.RungeKuttaNystrom)
    assert (row["velocity-dependent forces"] == "no") == refuses
    if isinstance(stepper, steppers.Splitting):
        drifts = [abs(a * w) for a in stepper.drifts for w in stepper.flight]
        assert int(row["drifts a step"]) == len(drifts)
        assert float(row["longest drift"]) == pytest.approx(max(drifts), rel=0.05)
    else:
        assert row["drifts a step"] == row["longest drift"] == ""


@pytest.mark.parametrize("name", example.SYSTEMS)
def test_committed_curves_say_ten_times_fewer_evaluations(name):
    found = RESULTS["systems"][name]
    assert found["horizon"] == 5.0
    assert found["reference_error"] < 1e-11
    assert example.best_ratio(found["curves"])[0] >= 10
    assert set(found["curves"]) == {n for n, m in methods.METHODS.items() if isinstance(m, methods.CoreStepper)}


def test_page_quotes_the_committed_ratios():
    ratios = [example.best_ratio(RESULTS["systems"][name]["curves"])[0] for name in example.SYSTEMS]
    text = " ".join(re.search(r"^For an error of 5·10⁻⁷.*?(?=\n\n)", PAGE, re.MULTILINE | re.DOTALL).group().split())
    assert [int(n) for n in re.findall(r"(\d+) times fewer", text)] == [round(r) for r in ratios]


@pytest.mark.parametrize("name", [pytest.param("butane", marks=pytest.mark.validation), "dumbbells", "triple-pendulum"])
def test_ten_times_fewer_evaluations_here_and_now(name):
    # Where the best stepper is below the goal, RATTLE is still above it with ten times its force evaluations.
    system = test_systems.build(name)
    curve = example.curve(system, system.reference(), "blanes-moan6", full=False)
    best = next(p for p in curve if p["error"] < example.GOAL)
    steps = 10 * int(best["evaluations"])
    plain = measure.compare(system.with_time_steps([system.horizon / steps]), methods=["rattle"], budget=120)
    (measured,) = plain.of("rattle")
    assert measured.evaluations_per_time * system.horizon == pytest.approx(steps, rel=1e-3)
    assert measured.error > example.GOAL


def test_committed_energy_slopes():
    slopes = RESULTS["slopes"]
    for name, method in methods.METHODS.items():
        if isinstance(method, methods.CoreStepper) and method.stepper.symplectic:
            assert abs(slopes[name]["0.01"]) <= 1e-9
    projected = abs(slopes["projected-verlet, project=True"]["0.01"])
    assert projected > 1000 * abs(slopes["rattle"]["0.01"])


def test_interpolation_on_a_straight_curve():
    points = [{"evaluations": 100.0 * 2**k, "error": 1e-3 * 16.0**-k} for k in range(5)]
    assert example.at_goal(points, "evaluations", 1e-5) == pytest.approx(100 * 100**0.25)
    assert example.at_goal(points[:2], "evaluations", 1e-5) is None
    # A coarse step that is good by chance is not counted.
    lucky = [{"evaluations": 50.0, "error": 1e-7}, *points]
    assert example.at_goal(lucky, "evaluations", 1e-5) == pytest.approx(100 * 100**0.25)


def test_figure_is_drawn(tmp_path):
    example.plot(RESULTS, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (ROOT / "docs" / "figures" / "high_order.png").exists()


def long_run_row(which: str, found: dict[str, float]) -> str:
    figures = [found[item] for item in ("energy", "momentum", "spin", "positions", "velocities") if item in found]
    cells = [which, f"{found['steps']:,}", *(f"{x:.1e}" for x in figures), f"{found['cpu_s']:.2g} s"]
    return "| " + " | ".join(cells) + " |"


@pytest.mark.parametrize(("kind", "largest"), [("free_flight", 1e-10), ("reversal", 1e-11)])
def test_page_shows_the_long_runs(kind, largest):
    assert LONG_RUNS[kind]
    for which, found in LONG_RUNS[kind].items():
        assert long_run_row(which, found) in PAGE
        assert max(x for item, x in found.items() if item not in ("dt", "steps", "wall_s", "cpu_s")) <= largest
