"""The stability study: it is resumed, and what is added goes into results and page."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kcons.comparison.stability import fuzz, put_into, report, run
from kcons.comparison.study import json_files
from kcons.errors import InputError

ROOT = Path(__file__).parents[3]
RESULTS = ROOT / "docs" / "results" / "stability.json"


def test_study_goes_on(tmp_path, monkeypatch):
    kept = tmp_path / "stability.json"
    monkeypatch.setattr(fuzz, "trial", lambda seed: fuzz.Trial(seed, "tree", "solved"))
    first = run(only=["fuzz"], quick=True, kept=kept)
    assert len(first["pieces"]["fuzz/0"]) == 300
    monkeypatch.setattr(fuzz, "trial", lambda seed: pytest.fail("done before"))
    assert run(only=["fuzz"], quick=True, kept=kept)["pieces"] == first["pieces"]
    with pytest.raises(InputError, match="there is no part 'fuz'"):
        run(only=["fuz"])


def test_a_system_that_is_added_goes_into_results_and_page(tmp_path):
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


def test_a_system_that_is_not_there():
    with pytest.raises(InputError, match="no test system 'methane'"):
        run(only=["drift"], test_systems=["methane"], quick=True)
