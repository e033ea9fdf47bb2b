"""Sets of distances that break OpenMM's own constraints run through kcons, or are refused with the reason."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent.parent / "examples" / "studies" / "openmm_constraints.py"


def _example():
    spec = importlib.util.spec_from_file_location("openmm_constraints_example", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


EXAMPLE = _example()
CASES = EXAMPLE.hard_cases()
REFUSED = {"hexagon, 9 (with para)"}
RANKS = {
    "methane, 10 distances": 9,
    "bipyramid, 10": 9,
    "hexagon, 12 (with meta)": 12,
    "hexagon, 15": 12,
    "square, 6": 6,
    "collinear, 3": 4,
    "honeycomb, 91 bonds": 91,
}


@pytest.mark.parametrize("name", CASES)
def test_kcons_holds_it_or_says_why_not(name):
    result = EXAMPLE.run_carried(*CASES[name])
    if name in REFUSED:
        assert "SingularGeometryError" in result["refused"]
        assert "linearized degrees of freedom" in result["refused"]
        return
    assert "refused" not in result, result
    assert result["error"] <= 1e-13
    if name in RANKS:
        assert result["rank"] == RANKS[name]


def test_cases_have_the_rows_they_claim():
    assert [len(CASES[name][2]) for name in ("honeycomb, 91 bonds", "hexagon, 15", "methane, 10 distances")] == [
        91,
        15,
        10,
    ]
