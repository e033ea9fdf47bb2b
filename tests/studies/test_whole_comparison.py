"""Who wins where: gains at equal errors, the committed tables made again, and a part that runs."""

from __future__ import annotations

import math

import harness
import pandas as pd
import pytest
import whole_comparison as study

from kcons.comparison import METHODS


def row(title, engine, setting, error, seconds):
    about = {"part": "p", "heading": "A system", "title": title, "engine": engine, "setting": setting, "status": "ok"}
    known = {"horizon": 10.0, "time": "fs", "long_time": "ps", "error_unit": "Å", "reference_error": 1e-12}
    costs = {"error": error, "seconds": seconds, "evaluations": 1000 / setting, "step_seconds": seconds / 1000}
    return {**about, **known, **costs, "method": title, "force_seconds": 1e-3, "margin": 0.05, "adaptive": False}


ROWS = [
    *(row("kcons RATTLE", "arrays", h, 1e-3 * (h / 2) ** 2, 4.0 / h) for h in (4.0, 2.0, 1.0)),
    *(row("a peer", "arrays", h, 1e-3 * (h / 2) ** 2, 10.0 / h) for h in (2.0, 1.0)),
]


def test_costs_between_points_and_gains():
    rattle = pd.DataFrame(ROWS[:3])
    assert study.cost_at(rattle, "seconds", 5e-4) == pytest.approx(2.0 * math.sqrt(2))
    assert study.cost_at(rattle, "seconds", 1e-2) == 1.0 and study.cost_at(rattle, "seconds", 1e-5) == math.inf
    # Gains are at equal errors.
    (found,) = study.winners(pd.DataFrame(ROWS)).to_dict("records")
    assert found["gain"] == pytest.approx(2.5, rel=0.05) and found["ahead of kcons"] == "none"
    faster = [{**r, "seconds": 0.1 * r["seconds"]} if r["title"] == "a peer" else r for r in ROWS]
    (found,) = study.winners(pd.DataFrame(faster)).to_dict("records")
    assert found["gain"] < 1 and found["ahead of kcons"].startswith("a peer at ")


def test_the_committed_tables_and_figures_are_made_from_the_file():
    _, table = harness.read(harness.RESULTS / "whole_comparison.csv")
    shown = study.tables(table)["winners"]
    assert set(shown.engine) == {"arrays", "ASE", "OpenMM", "all engines"} and len(shown) > 30
    few = table[table.part == "dumbbells"]
    made = study.figures(few)
    assert set(made) == {"who-wins-where", "report-dumbbells"}
    assert made["report-dumbbells"].axes[0].get_title(loc="left") == few.heading.iloc[0]


def test_a_part_runs_and_is_kept(tmp_path, monkeypatch, capsys):
    names = ("rattle", "shake-1e-8", "ase-kcons")
    monkeypatch.setattr(study, "METHODS", {name: METHODS[name] for name in names})
    study.main(["--quick", "--only", "rotor", "--out", str(tmp_path)])
    assert "Asymmetric top" in capsys.readouterr().out
    table = harness.read(tmp_path / "whole_comparison.csv")[1]
    assert set(table.method) == set(names) and set(table.part) == {"rotor"}
    with pytest.raises(SystemExit):
        study.main(["--only", "nothing", "--out", str(tmp_path)])
