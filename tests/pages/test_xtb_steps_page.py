"""The page on step lengths shows what was measured with GFN2-xTB outside, and this says what the page says."""

from __future__ import annotations

import json
import math

import pytest
from committed_pages import FOLDER, page, printed

RESULT = json.loads((FOLDER / "long_steps_xtb.json").read_text(encoding="utf-8"))
SYSTEMS = ("four waters", "ethanol")
KT = 300 * 8.617330337217213e-05


def runs(name):
    return {
        (part["method"], part["step"], round(1000 * part["friction"])): part
        for part in RESULT["parts"].values()
        if part["system"] == name and "method" in part
    }


def averages(run):
    """Means, standard errors and calls for a sample, the energy in kT."""
    energy, error = run["energy"]
    return {"U": (energy / KT, error / KT, run["correlation"]), **run["observed"]}


def test_page_shows_the_committed_results():
    assert RESULT["full"]
    assert printed("studies/xtb_steps.py", "long_steps_xtb.json") in page("step_length.md")


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_average_is_visibly_off(name):
    """Within three standard errors of single steps of 2 fs, and temperatures of the one asked for."""
    found = runs(name)
    known = averages(found["langevin", 2.0, 5])
    for run in found.values():
        assert run["status"] == "ok" and run["samples"] >= 200
        for key, (value, error, _) in averages(run).items():
            assert abs(value - known[key][0]) <= 3 * math.hypot(error, known[key][1])
        assert all(abs(value) <= 3 * error for value, error in run["kinds"].values())


@pytest.mark.parametrize("name", SYSTEMS)
def test_four_times_fewer_calls(name):
    """Than single steps of 2 fs, for an independent sample of every average, read between kicks or on spheres."""
    found = runs(name)
    known = averages(found["langevin", 2.0, 5])
    for key in (("langevin-halfway", 16.0, 20), ("spheres", 32.0, 5)):
        assert all(known[which][2] >= 4 * calls for which, (_, _, calls) in averages(found[key]).items())


@pytest.mark.parametrize("name", SYSTEMS)
def test_less_time(name):
    """Processor time of as many fs, over that of steps of 2 fs, in paired turns."""
    over = RESULT["parts"][f"{name}, cost"]["over_two_fs"]
    assert over["langevin, 2 fs"] == 1.0
    assert over["langevin, 4 fs"] == pytest.approx(0.5, abs=0.15)
    assert over["spheres, 32 fs"] < over["spheres, 16 fs"] < 0.5
