"""What a comparison found: files, of this version and of earlier ones, and the order of a method."""

import json
from pathlib import Path

import pytest

from kcons.comparison.work_precision.measurement import Comparison, Measurement

ROOT = Path(__file__).parents[3]


def comparison(*measurements, error=1e-14):
    return Comparison(
        scene={"name": "made", "units": {}},
        reference={"error": error},
        settings={"quick": True},
        environment={"cpu": "none"},
        measurements=list(measurements),
        remarks=["a remark"],
    )


def measured(step, error, **changes):
    return Measurement(
        **{"method": "a", "title": "A", "setting": step, "adaptive": False, "status": "ok"} | changes, error=error
    )


def test_what_is_written_comes_back():
    found = comparison(measured(2.0, 4e-3), measured(1.0, 1e-3), measured(1.0, None, method="b", status="baseline"))
    assert Comparison.from_dict(json.loads(json.dumps(found.to_dict()))) == found


def test_entries_that_are_missing_are_none_and_unknown_ones_are_left_out():
    data = comparison(measured(2.0, 4e-3)).to_dict()
    (entry,) = data["measurements"]
    entry["of another version"] = 1
    del entry["error"], entry["steps_planned"]
    assert Comparison.from_dict(data).measurements == [measured(2.0, None)]


def test_files_of_earlier_versions_are_read():
    """These called the baseline a floor."""
    data = json.loads((ROOT / "docs" / "results" / "compare_water.json").read_text(encoding="utf-8"))
    old = [m for m in data["measurements"] if m["status"] == "baseline"]
    for m in old:
        m |= {"status": "floor", "title": m["title"].replace("baseline", "floor")}
    found = Comparison.from_dict(data)
    assert len(found.measurements) == len(data["measurements"])
    assert old and {m["method"] for m in old} == {"verlet", "ase-verlet"}
    for name in ("verlet", "ase-verlet"):
        kept = found.of(name, "baseline")
        assert [m.step_seconds for m in kept] == [m["step_seconds"] for m in old if m["method"] == name]
        assert all(m.title.startswith("baseline: ") for m in kept)
    assert not any("floor" in (m.status, *m.title.split(": ")) for m in found.measurements)


def test_order_is_the_slope_of_the_two_finest_steps():
    found = comparison(measured(4.0, 1.0), measured(2.0, 4e-3), measured(1.0, 1e-3))
    assert found.observed_order("a") == pytest.approx(2.0)


def test_order_leaves_out_what_is_below_the_error_of_the_reference():
    points = (measured(4.0, 16e-3), measured(2.0, 4e-3), measured(1.0, 3.9e-3))
    assert comparison(*points).observed_order("a") < 0.1
    assert comparison(*points, error=7.9e-4).observed_order("a") == pytest.approx(2.0)
    assert comparison(*points, error=1e-3).observed_order("a") is None
