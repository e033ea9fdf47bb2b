"""Cost and memory against size: in processes of their own, stopped where they take too long, with fitted exponents."""

from __future__ import annotations

import json

import pytest

from kcons.comparison.solvers_alone import scaling


def points(solver, field, power, kind="chain", sizes=(100, 1000, 10_000, 100_000)):
    return [
        {"kind": kind, "size": n, "solver": solver, "status": "ok", field: 1e-8 * (n if n >= 1000 else 1000) ** power}
        for n in sizes
    ]


def test_exponents_are_fitted_beyond_the_cost_of_a_call():
    found = {"points": [*points("kcons", "p_seconds", 1.0), *points("sweeps", "p_seconds", 1.5)]}
    fitted = scaling.exponents(found)
    assert fitted["chain", "kcons", "p_seconds"] == pytest.approx(1.0)
    assert fitted["chain", "sweeps", "p_seconds"] == pytest.approx(1.5)
    assert ("chain", "kcons", "v_seconds") not in fitted


def test_engine_and_sweeps_in_processes_of_their_own():
    kept = []
    sizes = {"chain": (100, 3000)}
    found = scaling.measure(quick=True, sizes=sizes, keep=lambda d: kept.append(json.loads(json.dumps(d))))
    assert [len(d["points"]) for d in kept] == [2, 4]
    assert [p["status"] for p in found["points"]] == ["ok"] * 4
    for p in found["points"]:
        assert p["rows"] == p["size"]
        assert p["p_seconds"] > 0 and p["v_seconds"] > 0 and p["setup_seconds"] > 0
        assert p["p_residual"] < (1e-12 if p["solver"] == "kcons" else 1.1e-8)
    again = scaling.measure(quick=True, sizes=sizes, earlier=kept[0], solvers=["kcons"])
    assert again["points"] == kept[0]["points"]
    table = scaling.table(found)
    assert all(len(row) == len(table.headings) for row in table.rows)
    assert len(scaling.figure(found).axes) == 3


def test_solvers_are_stopped_or_say_why_they_cannot(monkeypatch):
    found = scaling.measure(sizes={"chain": (20, 10_000, 100_000)}, solvers=["ase"], patience=2.0)
    states = [p["status"] for p in found["points"]]
    assert states[0] == "ok"
    assert states[-1] == "stopped"
    assert "stopped after 2 s" in found["points"][-1]["note"]
    refused = scaling.measure(sizes={"chain": (20, 100)}, solvers=["lammps"], patience=30.0)
    assert [p["status"] for p in refused["points"]] == ["not run"]
    marks = scaling.table(refused).marks
    assert list(marks) == [""]
