"""The page on step lengths shows the committed results, and these say what the page says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from committed_pages import page, printed

FILE = Path(__file__).parents[2] / "docs" / "results" / "step_length.json"
RESULT = json.loads(FILE.read_text(encoding="utf-8"))


def of_group(group):
    return [part for part in RESULT["parts"].values() if part["group"] == group]


RUNS = {(run["method"], run["step"], round(1000 * run["friction"])): run for run in of_group("rigid water")}


def test_page_shows_the_committed_results():
    assert RESULT["full"]
    assert printed("studies/step_length.py", FILE.name) in page("step_length.md")


@pytest.mark.parametrize("run", of_group("velocities"), ids=lambda run: f"{run['step']:g} fs")
def test_what_velocities_at_the_positions_miss_is_the_step(run):
    """(frequency dt/2)^2 with measured frequencies, and nothing to fit; turns miss six times as much as shifts."""
    for (missing, error), frequency in zip(run["missing"], run["frequencies"], strict=True):
        expected = (0.5 * frequency * run["step"]) ** 2
        assert abs(missing - expected) <= 0.15 * expected + 3 * error
    assert 5 < run["missing"][1][0] / run["missing"][0][0] < 9


@pytest.mark.parametrize("run", of_group("equipartition"), ids=lambda run: f"{run['thermostat']}, {run['step']:g} fs")
def test_configurations_agree_with_velocities_in_the_middle(run):
    """For Verlet; BAOAB has right configurations, and velocities that lack the same everywhere."""
    for kind in (0, 1):
        found, error = run["configurations"][kind]
        other, doubt = run["in the middle"][kind] if run["thermostat"] == "Nose-Hoover" else (1.0, 0.0)
        assert abs(found - other) <= 3.5 * (error**2 + doubt**2) ** 0.5 + 0.001 * run["step"]
        assert error < 0.02
        estimate, doubt = run["with signs"][kind]
        assert abs(estimate - found) <= 3.5 * doubt


def test_equipartition_of_velocities_is_broken_at_the_positions_only():
    for run in together("Nose-Hoover", 4.0):
        (moving, _), (turning, doubt) = run["at the positions"]
        assert turning < 1 - 3 * doubt and turning < moving - 0.02


def together(thermostat, step):
    """The runs of a kind, which begin apart."""
    found = [r for r in of_group("equipartition") if (r["thermostat"], r["step"]) == (thermostat, step)]
    assert len(found) == 4
    return found


def apart(thermostat, step, place):
    """By how much turns are warmer than shifts, over all runs, and its standard error."""
    pairs = [np.array(run[place]) for run in together(thermostat, step)]
    difference = np.mean([turning[0] - moving[0] for moving, turning in pairs])
    return difference, np.sqrt(sum(float((pair[:, 1] ** 2).sum()) for pair in pairs)) / len(pairs)


@pytest.mark.parametrize(
    ("thermostat", "step", "told"),
    [("Nose-Hoover", 2.0, "0.6 0.2"), ("Langevin", 2.0, "-0.1 0.2"), ("Nose-Hoover", 4.0, "1.6 0.2")],
)
def test_turns_and_shifts_of_configurations(thermostat, step, told):
    """The same to one percent at 2 fs; with BAOAB they are, at 4 fs as well."""
    difference, error = apart(thermostat, step, "configurations")
    assert f"{100 * difference:.1f} {100 * error:.1f}" == told
    assert step > 2 or abs(difference) < 0.01
    assert apart("Langevin", 4.0, "configurations")[0] == pytest.approx(0.007, abs=5e-4)


def off(key, kind):
    return RUNS[key]["kinds"][kind]


def test_fine_steps_are_right():
    for key in (("langevin", 2.0, 5), ("langevin", 4.0, 5)):
        value, error = RUNS[key]["energy_off"]
        assert abs(value) <= 3 * error
        assert all(abs(off(key, kind)[0]) <= 3 * off(key, kind)[1] for kind in ("shift", "turn"))


def test_turns_are_the_first_to_go():
    """At the kicks, from 12 fs on: three times as many standard errors too warm as the energy is off, or more."""
    several = [key for key in RUNS if key[0] in ("langevin-respa", "spheres") and key[1] >= 12]
    assert len(several) == 11
    for key in several:
        energy, doubt = RUNS[key]["energy_off"]
        turn, error = off(key, "turn")
        assert turn > 3 * error and turn / error > 3 * abs(energy) / doubt


def test_halfway_between_kicks_sixteen_femtoseconds_are_right():
    """Within three standard errors where the same run read at the kicks is eight and more off."""
    there = RUNS["langevin-halfway", 16.0, 5]
    assert abs(there["energy_off"][0]) <= 3 * there["energy_off"][1]
    for kind in ("shift", "turn"):
        value, error = there["kinds"][kind]
        assert abs(value) <= 3 * error and error < 0.01
    value, error = off(("langevin-respa", 16.0, 5), "turn")
    assert value > 8 * error
    assert RUNS["langevin", 2.0, 5]["evaluations"] == pytest.approx(8 * there["evaluations"], rel=0.01)
    assert off(("langevin-halfway", 24.0, 20), "turn")[0] > 0.1


def test_errors_and_calls_are_told():
    for run in RUNS.values():
        assert run["status"] == "ok" and run["samples"] >= 64 and run["evaluations"] > 0
        assert all(0 < error < 0.05 for _, error in run["kinds"].values())
    assert {key[0] for key in RUNS} == {"langevin", "langevin-respa", "langevin-halfway", "spheres", "hmc"}
