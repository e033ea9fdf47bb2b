"""Residual against time a constraint: plain data, resumed where it stopped, drawn and listed."""

from __future__ import annotations

import json

import pytest

from kcons.comparison.solvers_alone import bare_solvers, solver_precision
from kcons.comparison.solvers_alone.bare_solvers import Candidate, Timing
from kcons.errors import UnsupportedError


class Ideal(bare_solvers.BareSolver):
    made: list[float] = []

    def __init__(self, system, tolerance):
        super().__init__(system, tolerance)
        self.tolerance = tolerance
        Ideal.made.append(tolerance)

    def timing(self, stage):
        if self.tolerance == 1e-9 and stage == "V":
            raise RuntimeError("did not converge\nat all")
        return Timing(1e-6 / self.tolerance, float("nan") if self.tolerance == 1e-12 else self.tolerance)


class Absent(Ideal):
    def __init__(self, system, tolerance):
        raise UnsupportedError("not installed; install it")


@pytest.fixture
def candidates(monkeypatch):
    Ideal.made.clear()
    found = (Candidate("kcons", "ideal", Ideal, (1e-3, 1e-9, 1e-12)), Candidate("ase", "absent", Absent, (1e-3,)))
    monkeypatch.setattr(solver_precision, "CANDIDATES", found)


def test_points_failures_and_refusals(candidates):
    kept = []
    found = solver_precision.measure(quick=True, systems=["chain-small"], keep=lambda d: kept.append(len(d["points"])))
    assert kept == [6, 7]
    by = {(p["tolerance"], p["stage"]): p for p in found["points"] if p["solver"] == "kcons"}
    assert by[1e-3, "P"]["ns_per_row"] == pytest.approx(1e-3 * 1e9 / 100)
    assert by[1e-9, "V"]["status"] == "failed"
    assert by[1e-9, "V"]["note"] == "RuntimeError: did not converge"
    assert by[1e-12, "P"]["status"] == "failed"
    assert "nothing was raised" in by[1e-12, "P"]["note"]
    assert found["points"][-1]["status"] == "not run"
    json.dumps(found, allow_nan=False)

    table = solver_precision.table(found)
    assert all(len(row) == len(table.headings) for row in table.rows)
    assert list(table.marks) == ["good", "bad", "bad", ""]
    assert table.rows[-1][-1] == "not installed; install it"
    panels = solver_precision.figure(found).axes
    assert len(panels) == 2
    (line,) = panels[0].lines
    assert list(line.get_ydata()) == [1e-3, 1e-9]


def test_a_slow_solver_is_not_asked_for_more(candidates, monkeypatch):
    monkeypatch.setattr(solver_precision, "QUICK_PATIENCE", -1.0)
    found = solver_precision.measure(quick=True, systems=["chain-small"])
    first = [p for p in found["points"] if p["solver"] == "kcons"]
    assert [p["status"] for p in first] == ["ok", "ok", "not run"]
    assert "tolerances below 0.001" in first[-1]["note"]


def test_what_is_there_is_not_measured_again(candidates):
    kept = []
    whole = solver_precision.measure(quick=True, systems=["chain-small"], keep=lambda d: kept.append(json.dumps(d)))
    Ideal.made.clear()
    again = solver_precision.measure(quick=True, systems=["chain-small"], earlier=json.loads(kept[0]))
    assert Ideal.made == []
    assert len(again["points"]) == len(whole["points"])
    # A full run takes nothing from a quick one.
    solver_precision.measure(quick=False, systems=["chain-small"], earlier=whole)
    assert Ideal.made == [1e-3, 1e-9, 1e-12]


def test_engine_and_sweeps_on_a_small_chain(monkeypatch):
    found = tuple(c for c in bare_solvers.CANDIDATES if c.name in ("kcons", "sweeps"))
    monkeypatch.setattr(solver_precision, "CANDIDATES", found)
    result = solver_precision.measure(quick=True, systems=["chain-small"])
    sweeps = [p for p in result["points"] if p["solver"] == "sweeps" and p["stage"] == "P"]
    assert [p["residual"] <= p["tolerance"] for p in sweeps] == [True] * 6
    (ours,) = [p for p in result["points"] if p["solver"] == "kcons" and p["stage"] == "P"]
    assert ours["residual"] < min(p["residual"] for p in sweeps)
