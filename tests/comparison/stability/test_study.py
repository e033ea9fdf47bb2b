"""The stability study: fuzz, largest steps, drift and reversal; and that its page shows the committed results."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from kcons.cli import main
from kcons.comparison.stability import (
    SYSTEMS,
    attempt,
    drift,
    fuzz,
    largest_step,
    put_into,
    report,
    reversal,
    run,
    trial,
)
from kcons.comparison.stability.runs import Copies
from kcons.comparison.study import json_files
from kcons.errors import InputError

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "docs" / "results" / "stability.json"


def test_fuzz_finds_no_fault():
    trials = [trial(seed) for seed in range(120)]
    found = fuzz.summary(trials)
    assert found["faults"] == []
    assert found["outcomes"]["solved"] > 60
    assert found["outcomes"]["refused in a step"] > 5
    assert set(found["shapes"]) == set(fuzz.SHAPES)


def test_trials_repeat():
    assert trial(7) == trial(7)
    assert trial(7) != trial(8)


def test_fuzz_sees_faults(monkeypatch):
    """A stepper that shifts one atom by 1e-6 is found; so is one that returns NaN."""
    steady = fuzz.Rattle

    class Sloppy(steady):
        off = 1e-6

        def step(self, system, state, dt):
            after = super().step(system, state, dt)
            after.positions[0, 0] += self.off
            return after

    class Broken(Sloppy):
        off = np.nan

    seed = next(s for s in range(100) if trial(s).outcome == "solved" and trial(s).shape == "tree")
    monkeypatch.setattr(fuzz, "STEPPERS", (Sloppy,))
    assert trial(seed).outcome == "silent"
    monkeypatch.setattr(fuzz, "STEPPERS", (Broken,))
    assert trial(seed).outcome == "NaN"


def test_largest_step_of_the_free_rotor_is_one():
    """omega = 1: asin(omega dt) has no value beyond, and the failure is an error."""
    found = largest_step("Rattle", "rotor", quick=True)
    assert 0.9 <= found["largest_step"] <= 1.0 < found["fails_at"]
    assert found["how"] == "ConvergenceError"
    assert found["silent_residual"] <= 1e-13
    assert attempt("Rattle", "rotor", 0.99, 50)[0] == "stable"


@pytest.mark.parametrize("scene", SYSTEMS)
def test_copies_have_the_forces_of_the_scene(scene):
    problem = SYSTEMS[scene](2)
    copies = Copies([SYSTEMS[scene](1), problem])
    y = problem.x + 0.01 * np.random.default_rng(0).standard_normal(problem.x.shape)
    both = np.vstack([y, y])
    np.testing.assert_allclose(copies.forces(both, 0.0)[problem.n_atoms :], problem.forces(y), atol=1e-14)
    total, kinetic = copies.energies(both, copies.v)
    assert total[1] == pytest.approx(problem.potential(y) + problem.kinetic(problem.v), rel=1e-13)
    assert kinetic[1] == pytest.approx(problem.kinetic(problem.v), rel=1e-13)
    assert copies.residual(copies.x) <= 1e-15


def test_drift_and_reversal():
    found = drift("pendulum", 4, 2000)
    assert len(found["slopes"]) == 4 and found["residual"] <= 1e-14
    assert abs(found["slope"]) <= 1e-6
    assert reversal("Rattle", "butane", 100)["missed_by"] <= 1e-12
    assert "cannot" in reversal("OpenMM", "butane", 10)


def test_study_goes_on(tmp_path, monkeypatch):
    kept = tmp_path / "stability.json"
    monkeypatch.setattr(fuzz, "trial", lambda seed: fuzz.Trial(seed, "tree", "solved"))
    first = run(only=["fuzz"], quick=True, kept=kept)
    assert len(first["pieces"]["fuzz/0"]) == 300
    monkeypatch.setattr(fuzz, "trial", lambda seed: pytest.fail("done before"))
    assert run(only=["fuzz"], quick=True, kept=kept)["pieces"] == first["pieces"]
    with pytest.raises(InputError, match="there is no part 'fuz'"):
        run(only=["fuz"])


def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fuzz, "trial", lambda seed: fuzz.Trial(seed, "tree", "solved"))
    assert main.main(["stability", "--quick", "--only", "fuzz", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "300 random molecules" in shown and "stability.html" in shown


def test_page_shows_the_committed_results():
    result = json_files.read(RESULTS)
    shown = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    for part, words in report.markdown(result).items():
        assert words in shown, part


def test_committed_results_have_no_faults():
    result = json_files.read(RESULTS)
    assert result["environment"]["commit"]
    assert report.failures(result) == []
    assert result["fuzz"]["faults"] == []
    assert result["fuzz"]["trials"] >= 10_000


def test_a_scene_that_is_added_goes_into_results_and_page(tmp_path):
    """As the command does it; results from before stay what they are."""
    page, numbers = tmp_path / "stability.md", tmp_path / "stability.json"
    page.write_text((ROOT / "docs" / "stability.md").read_text(encoding="utf-8"), encoding="utf-8")
    stored = json_files.read(RESULTS)
    stored["pieces"].pop("drift/butane", None)
    before_it = report.markdown(stored)["drift"]
    page.write_text(
        page.read_text(encoding="utf-8").replace(report.markdown(json_files.read(RESULTS))["drift"], before_it),
        encoding="utf-8",
    )
    numbers.write_text(json.dumps(stored), encoding="utf-8")
    found = run(only=["drift"], test_systems=["butane"], quick=True)
    assert list(found["pieces"]) == ["drift/butane"]
    with pytest.raises(InputError, match="quick"):
        put_into(found, numbers)
    found["made_by"]["quick"] = False
    before, after = put_into(found, numbers)
    assert json.loads(numbers.read_text(encoding="utf-8")) == after
    assert {k: v for k, v in after["pieces"].items() if k != "drift/butane"} == stored["pieces"]
    assert after["fuzz"] == stored["fuzz"] and set(after["added"]) - set(stored.get("added", {})) == {"drift/butane"}
    # The sum of the fuzz run goes along, where there was one.
    summed = {**after["fuzz"], "trials": 7}
    assert put_into({**found, "pieces": {}, "fuzz": summed}, numbers)[1]["fuzz"] == summed
    numbers.write_text(json.dumps(after), encoding="utf-8")
    report.renew(page, before, after)
    assert "| butane | 0.02 | 10,000 | 8 |" in page.read_text(encoding="utf-8")
    once = page.read_text(encoding="utf-8")
    report.renew(page, before, after)
    assert page.read_text(encoding="utf-8") == once
    page.write_text("# Another page", encoding="utf-8")
    with pytest.raises(InputError, match="does not show the"):
        report.renew(page, before, after)


def test_a_scene_that_is_not_there():
    with pytest.raises(InputError, match="no test system 'methane'"):
        run(only=["drift"], test_systems=["methane"], quick=True)
