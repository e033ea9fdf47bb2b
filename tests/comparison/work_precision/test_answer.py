"""The answer of a comparison: who is first, who ties, and the sentence that says it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from kcons.comparison.averages.sampling import Sampled, SamplingComparison
from kcons.comparison.study.tables import plain_text
from kcons.comparison.work_precision import answer
from kcons.comparison.work_precision.measurement import Comparison, Measurement

RESULTS = Path(__file__).parents[3] / "docs" / "results"
SCENE = {"units": {"length": "Å", "energy": "eV", "time": "fs", "long_time": "ps"}, "title": "made up", "name": "x"}


def point(method, setting, error, wall, **more):
    title = {"rattle": "kcons RATTLE", "suzuki4": "kcons Suzuki4", "dop853": "SciPy DOP853"}[method]
    return Measurement(
        method,
        title,
        setting,
        method == "dop853",
        "ok",
        error=error,
        seconds_per_time=wall,
        evaluations_per_time=100.0,
        **more,
    )


def made(*points, margin=0.1):
    timing = {"force_seconds": 1.0, "margin": margin}
    return Comparison(SCENE, {"error": 0.0, "how": ""}, {}, {}, list(points), timing=timing)


RATTLE = [point("rattle", 4.0, 4e-3, 0.5), point("rattle", 2.0, 1e-3, 1.0), point("rattle", 1.0, 2.5e-4, 2.0)]


def test_the_limit_is_what_the_usual_method_makes_at_two_femtoseconds():
    found = answer.answer(made(*RATTLE, point("suzuki4", 8.0, 5e-4, 0.6), point("suzuki4", 4.0, 3e-5, 1.2)))
    assert found.limit == 1e-3 and found.limit_is == "what kcons RATTLE makes at 2 fs"
    assert [(r.place, r.point.title, r.point.setting) for r in found.ranked] == [
        (1, "kcons Suzuki4", "8 fs"),
        (2, "kcons RATTLE", "2 fs"),
    ]
    assert found.ranked[1].ratio == pytest.approx(1 / 0.6)
    assert answer.sentence(found) == (
        "Use kcons Suzuki4 at 8 fs: the least wall time a ps, 600 ms, for an error of at most 0.001 Å "
        "(what kcons RATTLE makes at 2 fs)."
    )


def test_what_is_within_the_margin_is_a_tie():
    found = answer.answer(made(*RATTLE, point("suzuki4", 8.0, 5e-4, 0.95)))
    assert [r.place for r in found.ranked] == [1, 1]
    assert "as good within the margin of 10 %: kcons RATTLE at 2 fs" in answer.sentence(found)
    assert [row[0] for row in answer.ranking(found).rows] == ["1=", "1="]
    apart = answer.answer(made(*RATTLE, point("suzuki4", 8.0, 5e-4, 0.95), margin=0.01))  # 5 % is the least of a margin
    assert [r.place for r in apart.ranked] == [1, 2]


def test_a_chain_of_ties_is_measured_from_its_first():
    """1, 1.08 and 1.16 with a margin of 10 %: the third is no tie with the first."""
    curves = [point("rattle", 2.0, 1e-3, 1.0), point("suzuki4", 2.0, 1e-3, 1.08), point("dop853", 1e-3, 1e-3, 1.16)]
    found = answer.answer(made(*curves))
    assert [r.place for r in found.ranked] == [1, 1, 3]
    assert found.ranked[2].point.setting == "rtol 1e-03"


def test_a_limit_that_is_asked_for():
    found = answer.answer(made(*RATTLE, point("suzuki4", 4.0, 3e-5, 1.2)), limit=1e-4)
    assert [r.point.method for r in found.ranked] == ["suzuki4"]
    assert [p.title for p in found.beyond] == ["kcons RATTLE"] and found.beyond[0].value == 2.5e-4
    none = answer.answer(made(*RATTLE), limit=1e-9)
    assert answer.sentence(none) == (
        "No method makes an error of at most 1e-09 Å (asked for); the least is 0.00025, by kcons RATTLE at 1 fs."
    )
    assert "Above 1e-09: kcons RATTLE 2.5e-04." in answer.text(none)


def test_a_limit_that_is_asked_for_is_kept_to_the_digit():
    near = made(*RATTLE, point("suzuki4", 4.0, 9.9e-4, 1.2))
    assert [r.point.method for r in answer.answer(near, limit=9.95e-4).ranked] == ["suzuki4", "rattle"]
    found = answer.answer(near, limit=9.95e-4).ranked[1].point
    assert found.setting == "1 fs"  # at 2 fs it makes 1e-3


def test_errors_that_the_reference_cannot_tell_apart():
    """A reference that is good to 1e-4 tells errors from 3e-4 on."""
    comparison = replace(made(*RATTLE, point("suzuki4", 4.0, 3e-5, 1.2)), reference={"error": 1e-4, "how": ""})
    asked = answer.answer(comparison, limit=1e-4)
    assert not asked.ranked
    assert "cannot be told from none" in answer.sentence(asked) and "Above" not in answer.text(asked)
    # 2.5e-4 and 3e-5 are the same, and the limit.
    fine = replace(made(*RATTLE[1:], point("suzuki4", 4.0, 3e-5, 1.9)), reference={"error": 1e-3, "how": ""})
    found = answer.answer(fine)
    assert found.limit == 3e-3 and "the reference can tell apart" in found.limit_is
    assert [(r.point.method, r.point.setting) for r in found.ranked] == [("rattle", "2 fs"), ("suzuki4", "4 fs")]


def test_drift_counts_with_twice_its_error():
    drifting = [
        point("rattle", 2.0, 1e-3, 1.0, energy_slope=-1e-4, energy_slope_error=5e-5),
        point("suzuki4", 2.0, 1e-3, 0.5, energy_slope=2.1e-4, energy_slope_error=0.0),
        point("suzuki4", 1.0, 1e-3, 2.0, energy_slope=1e-9, energy_slope_error=1e-9),
        point("dop853", 1e-3, 1e-3, 0.1),
    ]
    found = answer.answer(made(*drifting), "drift")
    assert found.limit == pytest.approx(2e-4)
    # 2.1e-4 is within 5 % of the limit, as are errors.
    assert [(r.point.title, r.point.setting) for r in found.ranked] == [
        ("kcons Suzuki4", "2 fs"),
        ("kcons RATTLE", "2 fs"),
    ]
    assert "eV/ps a degree of freedom" in answer.sentence(found)


def test_nothing_to_rank():
    assert answer.answer(made(replace(RATTLE[0], status="failed"))) is None


@pytest.mark.parametrize("criterion", ["error", "drift"])
def test_the_ranking_of_a_committed_run_fits_a_terminal(criterion):
    data = json.loads((RESULTS / "compare_water.json").read_text(encoding="utf-8"))
    found = answer.answer(Comparison.from_dict(data), criterion)
    lines = plain_text(answer.ranking(found)).splitlines()
    assert len(lines) > 10 and max(map(len, lines)) <= answer.WIDTH
    costs = [r.point.cost for r in found.ranked]
    assert costs == sorted(costs) and found.ranked[0].ratio == 1.0
    assert all(r.point.value <= 1.05 * found.limit for r in found.ranked)


# -- temperatures -----------------------------------------------------------------------------------


def sampled(method, setting, deviation, error, wall):
    return Sampled(
        method,
        method,
        setting,
        "ok",
        temperature_error=deviation,
        temperature_standard_error=error,
        seconds_to_goal=wall,
    )


def fluid(*points):
    return SamplingComparison({"units": {"time": "τ"}}, {}, {}, {}, list(points))


def test_a_deviation_that_is_known_badly_is_not_good_enough():
    """0.1 % off with an error of 3 %, as short runs have it, says nothing of 1 %."""
    found = answer.answer_of_averages(
        fluid(
            sampled("lucky", 0.02, 0.001, 0.03, 0.1),
            sampled("known", 0.02, 0.002, 0.002, 5.0),
            sampled("known", 0.01, 0.0, 0.001, 9.0),
        )
    )
    assert [(r.point.method, r.point.setting) for r in found.ranked] == [("known", "0.02 τ")]
    assert [point.method for point in found.beyond] == ["lucky"]
    assert found.ranked[0].point.value == pytest.approx(0.006)


def test_at_one_step_the_temperature_itself_decides():
    found = answer.answer_of_averages(
        fluid(
            sampled("cheap", 0.02, -0.05, 0.002, 0.1),
            sampled("best", 0.02, 0.004, 0.001, 9.0),
            sampled("near", 0.02, -0.008, 0.002, 1.0),
        )
    )
    assert [(r.place, r.point.method) for r in found.ranked] == [(1, "best"), (1, "near"), (3, "cheap")]
    assert found.ranked[2].ratio == pytest.approx(0.054 / 0.006)
    said = answer.text(found)
    assert said.startswith(
        "At 0.02 τ use best: the temperature of its configurations is off by 0.006 of it at most; "
        "within the errors as good: near."
    )
    assert "1=  best" in said and "3   cheap" in said
    assert max(map(len, plain_text(answer.ranking(found)).splitlines())) <= 80


def test_one_thermostat_at_one_step_is_judged_by_the_limit():
    assert answer.answer_of_averages(fluid(sampled("only", 0.02, 0.001, 0.001, 1.0))).limit == 0.01


def test_what_is_left_out_of_long_names_is_not_what_they_differ_by():
    tolerances = ("1e-4", "1e-5", "1e-12")
    long = [replace(m, title=f"OpenMM + kcons compiled RATTLE, {t}") for m, t in zip(RATTLE, tolerances, strict=True)]
    named = [replace(m, method=m.title, setting=2.0, error=1e-3) for m in long]
    found = answer.answer(made(*named))
    lines = plain_text(answer.ranking(found)).splitlines()
    for tolerance in tolerances:
        assert any("OpenMM + kcons compiled" in line and f"…, {tolerance} " in line for line in lines)
    assert max(len(line) for line in lines) <= 80
    assert found.ranked[0].point.number == 2.0
