"""Solvers alone: precision and scaling of the engine and of sweeps, and solvers that fail or take too long."""

from __future__ import annotations

import harness
import pandas as pd
import solvers_alone


def test_the_study(tmp_path, capsys):
    solvers_alone.main(["--quick", "--systems", "chain-small", "--solvers", "kcons,sweeps", "--out", str(tmp_path)])
    head, table = harness.read(tmp_path / "precision.csv")
    assert "commit" in head and (table.status == "ok").all()
    assert set(table.stage) == {"P", "V"} and set(table.solver) == {"kcons", "sweeps"}
    assert len(solvers_alone.figures(table)["report-solver-precision"].axes) == 2
    assert "ns a row" in capsys.readouterr().out


def test_points_of_the_scaling_come_from_processes_of_their_own():
    rows = list(solvers_alone.scaling("chain", "kcons", (20, 3000), 300.0))
    assert [row["status"] for row in rows] == ["ok", "ok"]
    assert rows[1]["rows"] == 3000 and rows[1]["P residual"] < 1e-12
    (late,) = solvers_alone.scaling("chain", "ase", (20, 30), 0.01)
    assert late["status"] == "stopped"
    figure = solvers_alone.figures(pd.DataFrame(rows))["report-scaling"]
    assert len(figure.axes) == 3


def test_what_solvers_of_others_raise_is_a_result():
    class Failing:
        def __init__(self, *_):
            pass

        def timing(self, stage):
            raise RuntimeError("did not converge")

    candidate = type("Made", (), {"make": Failing, "name": "made"})
    failed = {"P": {"status": "failed", "words": "RuntimeError: did not converge"}}
    assert solvers_alone.timed(solvers_alone.chain(5), candidate, 0.0) == failed
