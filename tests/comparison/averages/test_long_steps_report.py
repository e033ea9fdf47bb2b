"""The table of long steps says what was measured, and files hold it."""

from __future__ import annotations

import json

from kcons.comparison.averages import long_steps_report as report
from kcons.comparison.averages.long_steps import StepComparison, Stepped
from kcons.comparison.study.tables import plain_text
from kcons.comparison.test_systems.system import ASE_UNITS

RUNS = (
    Stepped(
        "langevin", 2.0, 0.005, "ok", length=8000.0, evaluations=4000, samples=250,
        kinds={"shift": (0.001, 0.002), "turn": (-0.002, 0.003)}, energy=(-0.4, 0.0002),
        energy_off=(0.0001, 0.0003), correlation=300.0, seconds=5.0,
    ),
    Stepped(
        "spheres", 24.0, 0.005, "ok", length=24000.0, evaluations=1000, cheap=6000, samples=250,
        kinds={"shift": (0.01, 0.002), "turn": (0.11, 0.003), "internal": (0.02, 0.01)}, energy=(-0.39, 0.0002),
        energy_off=(0.01, 0.0003), correlation=28.0, seconds=6.0,
    ),
    Stepped("langevin-respa", 48.0, 0.005, "failed", note="step 3: oh"),
)  # fmt: skip


def lines(runs):
    text = plain_text(report.table(runs, ASE_UNITS))
    return {line.split()[0]: line.split() for line in text.splitlines()[1:] if line.strip()}, text


def test_table():
    found, text = lines(RUNS)
    shown = {line.split("  ")[0]: line.split() for line in text.splitlines()}
    assert shown["Langevin, one step"][3:] == [
        "2", "5", "500", "+0.1", "±", "0.2", "-0.2", "±", "0.3", "+0.0001", "±", "0.0003", "300",
    ]  # fmt: skip
    assert shown["isokinetic spheres"][2:5] == ["24", "5", "42"]
    assert "+11.0 ± 0.3" in text and "+2.0 ± 1.0" in text and "failed [1]" in text
    marked = [cell for row in report.table(RUNS, ASE_UNITS).rows for cell in row if hasattr(cell, "style")]
    assert {"+1.0 ± 0.2", "+11.0 ± 0.3", "+0.0100 ± 0.0003"} <= set(marked) and "-0.2 ± 0.3" not in marked
    assert found


def test_without_a_reference():
    run = Stepped("hmc", 9.0, 0.0, "ok", length=900.0, evaluations=600, energy=(2.0, 0.1), correlation=60.0)
    table = report.table([run], ASE_UNITS)
    assert [h for h in table.headings if "off" in h] == [] and len(table.headings) == 6
    assert table.rows[0][2] == "" and "fewest calls for a sample" in report.explanation([run])


def test_explanation():
    text = report.explanation(RUNS)
    assert text.startswith("[1] step 3: oh\n") and "Metropolis" in text


def test_files(tmp_path):
    comparison = StepComparison("a title", ASE_UNITS, (-0.4, 0.0001), RUNS, {}, {"cpu": "a processor"})
    paths = report.write(comparison, tmp_path, tables=["a"])
    assert [path.name for path in paths] == ["compare.json", "compare.png", "compare.txt"]
    data = json.loads(paths[0].read_text(encoding="utf-8"))
    assert len(data["runs"]) == 3 and "correlation" not in data["runs"][2]
    assert paths[1].read_bytes().startswith(b"\x89PNG")


def test_runs_that_were_all_too_short_are_written(tmp_path):
    short = Stepped("langevin", 2.0, 0.005, "partial", note="3 samples are too few for an error")
    comparison = StepComparison("a title", ASE_UNITS, None, [short], {}, {"cpu": "a processor"})
    paths = report.write(comparison, tmp_path)
    assert [path.name for path in paths] == ["compare.json", "compare.png"]
    assert paths[1].stat().st_size > 0
