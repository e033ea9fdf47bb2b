"""The measurements of docs/growth.md: a small run of each, and the committed result."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "notes" / "growth_results.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("growth_results", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def committed():
    return json.loads((ROOT / "docs" / "results" / "growth.json").read_text(encoding="utf-8"))


def test_random_systems(script):
    found = script.random_starts(60, seed=7, sizes=(4,))
    assert found["trajectories"] == found["finite"] == 60
    assert found["failed"] == 0
    assert found["worst_row"] < 1e-13
    assert 0 < found["worst_of_terms"] < 1e-13


def test_ensemble(script):
    found = script.ensemble(20, 5.0)
    assert all(row["error_max"] < 1e-7 and row["failed"] == 0 for row in found["kinds"].values())


def test_work_and_precision(script):
    rows = {(r["method"], r["rtol"]): r for r in script.work_precision(5.0, (1e-6,))["rows"]}
    own, plain = rows["kcons, DOP853", 1e-6], rows["SciPy DOP853", 1e-6]
    assert own["error"] < 2e-6 > plain["error"]
    # What the projection is for.
    assert own["excess_error"] < 1e-13 < 1e-9 < plain["excess_error"]


def test_committed_result(committed):
    random = committed["random"]
    assert random["trajectories"] == random["finite"] == 1_000_000
    assert random["failed"] == 0
    assert max(group["total"] for group in random["groups"]) < 1e-13
    assert random["above_1e-13"] == 0
    assert random["worst_row"] < 1e-13
    assert random["worst_of_terms"] < 1e-13
    assert committed["ensemble"]["count"] == 10_000
    for row in committed["ensemble"]["kinds"].values():
        assert row["failed"] == 0
        assert row["error_max"] < 1e-6
        assert row["wall_s"] < 60.0


@pytest.mark.validation
def test_a_million_random_systems(script):
    found = script.random_starts(1_000_000)
    assert found["trajectories"] == found["finite"] == 1_000_000
    assert max(group["total"] for group in found["groups"]) < 1e-13
    assert found["above_1e-13"] == 0
    assert found["worst_of_terms"] < 1e-13


@pytest.mark.validation
def test_ten_thousand_hypercycles(script):
    found = script.ensemble(10_000)
    for row in found["kinds"].values():
        assert row["failed"] == 0
        assert row["error_max"] < 1e-6
