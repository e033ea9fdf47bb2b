"""What is recommended for an error was measured, and reaches it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from kcons.cli import main
from kcons.comparison import test_systems
from kcons.comparison.work_precision import measure, recommendation
from kcons.comparison.work_precision.measurement import Measurement
from kcons.comparison.work_precision.timing_rounds import Rounds
from kcons.errors import InputError

CHAIN = 'test_systems.build("chain", 4)'


def point(error, setting, **changes):
    return Measurement(
        **{
            "method": "rattle",
            "title": "kcons RATTLE",
            "setting": setting,
            "adaptive": False,
            "status": "ok",
            "error": error,
            "evaluations_per_time": 1000 / setting,
            "seconds_per_time": 1 / setting,
            **changes,
        }
    )


# -- predictions ------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [1e-1, 3e-3, 1e-5])
def test_prediction_follows_the_order(target):
    curve = [point(1e-2 * dt**2 / 16, dt) for dt in (4.0, 2.0, 1.0)]
    found = recommendation.predicted(curve, target)
    assert found.order == pytest.approx(2.0)
    assert found.setting == pytest.approx(4 * (target / 1e-2) ** 0.5)
    assert found.evaluations == pytest.approx(1000 / found.setting)
    assert found.wall == pytest.approx(1 / found.setting)


def test_prediction_uses_the_points_around_the_error():
    # Order 2 above, order 6 below.
    curve = [point(1e-1, 4.0), point(1e-1 / 4, 2.0), point(1e-1 / 4 / 64, 1.0)]
    assert recommendation.predicted(curve, 5e-2).order == pytest.approx(2.0)
    assert recommendation.predicted(curve, 1e-3).order == pytest.approx(6.0)


def test_nothing_is_predicted_from_a_plateau_one_point_or_too_far():
    assert recommendation.predicted([point(1e-2, 4.0), point(1e-2, 2.0)], 1e-4) is None
    assert recommendation.predicted([point(1e-2, 4.0)], 1e-4) is None
    assert recommendation.predicted([point(1e-2, 4.0), point(1e-9, 2.0)], 1e-4, resolution=1e-8) is None
    assert recommendation.predicted([point(1e-2, 4.0), point(2.5e-3, 2.0)], 1e-9) is None


# -- a whole search ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chain():
    return test_systems.build("chain", 4)


@pytest.fixture(scope="module")
def reference(chain):
    return chain.reference()


@pytest.fixture(scope="module")
def found(chain, reference):
    names = ["rattle", "blanes-moan4", "ase-kcons", "ase-bonds"]
    plain = measure.compare(chain, methods=names, reference=reference, budget=20)
    return recommendation.recommend(chain, plain, 3e-7, reference=reference, made_by=CHAIN, budget=20)


def test_the_recommended_step_was_measured_and_reaches_the_error(chain, found):
    entry = found.recommendation
    assert entry["reached"] and entry["method"] == "blanes-moan4"
    (m,) = [m for m in found.of(entry["method"]) if m.setting == entry["setting"]]
    assert m.error == entry["error"] <= 3e-7
    # By hand: the next longer step that divides the horizon does not reach it, or was not a useful one to try.
    assert entry["error"] > 0.02 * 3e-7
    assert m.steps == round(found.scene["horizon"] / entry["setting"])


def test_nothing_cheaper_that_was_measured_reaches_it(found):
    entry = found.recommendation
    able = [m for m in found.measurements if m.status == "ok" and m.error is not None and m.error <= 3e-7]
    # Where forces take less than a microsecond, they are counted.
    cost = {"wall time": "seconds_per_time", "force evaluations": "evaluations_per_time"}[entry["decides"]]
    assert entry[cost] == min(getattr(m, cost) for m in able)


def test_the_default_is_at_its_usual_step_and_at_the_error(found):
    default = found.recommendation["default"]
    assert (default["method"], default["setting"]) == ("ase-bonds", 2.0)
    assert default["error"] > 3e-7
    assert default["needs"]["setting"] < 2.0
    # Order 2 against order 4.
    assert default["gain"]["evaluations"] > 3
    expected = default["needs"]["evaluations_per_time"] / found.recommendation["evaluations_per_time"]
    assert default["gain"]["evaluations"] == pytest.approx(expected)


def test_a_default_that_was_not_compared_is_asked_at_two_steps(chain, reference):
    """At 2 fs it makes far less than is asked for: what it needs is a longer step."""
    plain = measure.compare(chain, methods=["blanes-moan4"], reference=reference, budget=20)
    found = recommendation.recommend(chain, plain, 1e-3, reference=reference, made_by=CHAIN, budget=20)
    default = found.recommendation["default"]
    assert default["method"] == "ase-bonds" and default["error"] < 1e-4
    assert default["needs"]["measured"] and default["needs"]["setting"] > 4.0
    assert 1e-4 < default["needs"]["error"] <= 1e-3


def test_the_default_itself_may_be_the_cheapest(chain, reference, monkeypatch):
    plain = measure.compare(chain, methods=["rattle"], reference=reference, budget=20)
    slow = replace(plain, measurements=[replace(m, seconds_per_time=1e6) for m in plain.measurements], timing={})
    found = recommendation.recommend(chain, slow, 1e-4, reference=reference, made_by=CHAIN, budget=20)
    entry = found.recommendation
    assert entry["method"] == entry["default"]["method"] == "ase-bonds"
    assert "FixBondLengths" in entry["code"]
    assert entry["default"]["gain"]["wall"] == pytest.approx(1.0)


def test_what_was_found_is_said(found):
    text = recommendation.sentences(found)
    assert f"the cheapest in {found.recommendation['decides']}: kcons BlanesMoan4 at" in text
    assert "To compare: ASE Verlet + FixBondLengths at 2 fs, the default of its MD engine" in text
    assert "times the force evaluations" in text
    assert "ConstrainedDynamics" in text
    assert recommendation.sentences(replace(found, recommendation=None)) == ""


def test_an_error_below_that_of_the_reference_is_refused_with_the_reason(chain, reference, found):
    plain = replace(found, recommendation=None, reference={"how": "a run", "error": 1e-7})
    entry = recommendation.recommend(chain, plain, 1e-8, reference=reference, made_by=CHAIN).recommendation
    assert not entry["reached"]
    assert "good to 1e-07 Å" in entry["why"] and "harmonic sites" in entry["why"]
    said = recommendation.sentences(replace(plain, recommendation=entry))
    assert said.startswith("No method reaches an error of 1e-08 Å")
    assert "Best: " in said


def test_what_no_method_reaches_is_said_with_the_best(chain, reference):
    plain = measure.compare(chain, methods=["rattle"], reference=reference, budget=20)
    entry = recommendation.recommend(chain, plain, 1e-11, reference=reference, made_by=CHAIN).recommendation
    assert not entry["reached"]
    assert entry["best"]["error"] == min(m.error for m in plain.of("rattle"))


@pytest.mark.parametrize("target", [0.0, -1.0, float("nan")])
def test_a_target_has_to_be_positive(chain, reference, found, target):
    with pytest.raises(InputError, match="positive"):
        recommendation.recommend(chain, found, target, reference=reference, made_by=CHAIN)


def test_reach_stops_where_shorter_steps_do_not_help(chain, reference, monkeypatch):
    seen = []

    def plateau(bench, method, setting):
        seen.append(setting)
        return point(1e-3, setting, steps=1)

    monkeypatch.setattr(measure.Bench, "measure", plateau)
    prediction = recommendation.Prediction("rattle", 1.0, 2.0, 1e-3, 1.0)
    recommendation.reach(measure.Bench(chain, reference, 10.0), prediction, 1e-6)
    assert len(seen) == 2


def test_sharpening_tries_longer_steps_where_another_method_seems_ahead(chain, reference):
    fine = chain.with_time_steps([1.25, 0.625])
    plain = measure.compare(fine, methods=["blanes-moan4"], reference=reference, budget=20)
    fake = point(1e-5, 0.1, method="dop853", title="SciPy DOP853", evaluations_per_time=120.0, seconds_per_time=1e-3)
    there = replace(plain, measurements=[*plain.measurements, fake])
    sharper = recommendation.sharpen(measure.Bench(fine, reference, 20), there)
    longest = max(m.setting for m in sharper.of("blanes-moan4"))
    assert longest > 2 * max(m.setting for m in plain.of("blanes-moan4"))


def test_points_are_timed_as_the_comparison_was(chain, reference, monkeypatch):
    monkeypatch.setattr(
        "kcons.comparison.work_precision.timing_rounds.marched", lambda run, m, holds, pass_seconds: 7.0
    )
    rounds = Rounds(least=1, most=1)
    plain = measure.compare(chain, methods=["rattle", "ase-bonds"], reference=reference, rounds=rounds)
    found = recommendation.recommend(chain, plain, 1e-4, reference=reference, made_by=CHAIN, rounds=rounds)
    new = [m for m in found.measurements if m not in plain.measurements]
    assert new and {m.step_seconds for m in new} == {7.0}
    assert found.recommendation["default"]["seconds_per_time"] == pytest.approx(7000 / 2.0, rel=0.1)


# -- command line -----------------------------------------------------------------------------------


def test_command(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = [
        "compare",
        "sphere-pendulum",
        "--quick",
        "--methods",
        "rattle,suzuki4,dop853",
        "--target-error",
        "1e-5",
    ]
    assert main.main([*arguments, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "For an error of at most 1e-05 R at 2 τ" in printed
    assert "\nUse " not in printed  # the ranking has no sentence of its own
    entry = json.loads((out / "compare.json").read_text(encoding="utf-8"))["recommendation"]
    assert entry["reached"] and entry["error"] <= 1e-5
    assert 'test_system = test_systems.build("sphere-pendulum", quick=True)' in entry["code"]
    exec(compile(entry["code"], "recommended", "exec"), {})


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["compare", "chain", "--target-error", "0"], "positive number such as 1e-6"),
        (["compare", "chain", "--target-error", "nan"], "positive number such as 1e-6"),
        (["compare", "thermostat", "--target-error", "1e-6"], "is for trajectories"),
    ],
)
def test_mistakes(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main.main(arguments) == 2
    assert text in capsys.readouterr().err
