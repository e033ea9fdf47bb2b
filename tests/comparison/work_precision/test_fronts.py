"""Fronts, losses and gains are what the points say."""

from __future__ import annotations

import math

import pytest

from kcons.comparison.work_precision import fronts
from kcons.comparison.work_precision.measurement import Comparison, Measurement

UNITS = {"length": "Å", "energy": "eV", "time": "fs", "long_time": "ps"}


def point(method, title, error, evaluations, wall, **changes):
    return Measurement(
        **{
            "method": method,
            "title": title,
            "setting": 1.0 / evaluations,
            "adaptive": False,
            "status": "ok",
            "error": error,
            "evaluations_per_time": float(evaluations),
            "seconds_per_time": wall,
            **changes,
        }
    )


def comparison(*measurements, reference=0.0, force=1e-3, margin=None):
    return Comparison(
        scene={"name": "x", "title": "a title", "horizon": 24.0, "units": UNITS, "rank": 1},
        reference={"how": "closed form", "error": reference},
        settings={},
        environment={},
        measurements=measurements,
        timing={"force_seconds": force, "margin": margin},
    )


RATTLE = (
    point("rattle", "kcons RATTLE", 1e-2, 100, 1.0),
    point("rattle", "kcons RATTLE", 1e-4, 1000, 10.0),
)


def test_front_has_what_nothing_dominates():
    a, b = RATTLE
    dominated = point("dop853", "SciPy", 2e-2, 200, 2.0)
    cheap = point("dop853", "SciPy", 0.5, 50, 0.5)
    assert fronts.front([b, dominated, a, cheap], "wall") == [cheap, a, b]


def test_front_takes_errors_as_one_below_the_resolution_and_within_five_percent():
    a = point("rattle", "kcons RATTLE", 1e-8, 10, 1.0)
    b = point("rattle", "kcons RATTLE", 1e-9, 20, 2.0)
    assert fronts.front([a, b], "wall", 1e-7) == [a]
    assert fronts.front([a, b], "wall") == [a, b]
    near = point("rattle", "kcons RATTLE", 0.97e-8, 20, 2.0)
    assert fronts.front([a, near], "wall") == [a]


def test_cost_between_points_is_on_the_line_of_logarithms():
    assert fronts.needed(RATTLE, "evaluations", 1e-3) == pytest.approx(100 * 10**0.5)
    assert fronts.needed(RATTLE, "evaluations", 1.0) == pytest.approx(100)
    assert fronts.needed(RATTLE, "wall", 1e-4) == pytest.approx(10.0)
    assert fronts.needed(RATTLE, "wall", 0.9e-4) == math.inf


def test_a_cheaper_method_is_a_loss_with_its_factor():
    peer = point("dop853", "SciPy DOP853", 1e-3, 100 * 10**0.5 / 2, 100.0)
    found = fronts.verdict(comparison(*RATTLE, peer))
    by_cost = {standing.cost: standing for standing in found.standings}
    assert not by_cost["wall"].losses
    (loss,) = by_cost["evaluations"].losses
    assert (loss.method, loss.errors) == ("dop853", (1e-3, 1e-3))
    assert loss.factor == pytest.approx(2.0, rel=0.03)  # errors within five per cent are the same
    assert by_cost["wall"].gain == pytest.approx(100.0 / 10**0.5, rel=0.03)
    assert (by_cost["wall"].ours, by_cost["wall"].rival) == ("kcons RATTLE", "SciPy DOP853")
    assert found.losses == [loss]  # evaluations count even where wall time decides
    assert fronts.sentence(loss, "Å").startswith("SciPy DOP853 at an error of 1e-03 Å: up to 49 % cheaper")


def test_what_is_more_accurate_than_anything_of_kcons_is_a_loss():
    peer = point("dop853", "SciPy DOP853", 1e-6, 1e5, 1e5)
    (loss, _) = fronts.verdict(comparison(*RATTLE, peer)).losses
    assert loss.factor == math.inf
    assert "nothing of kcons was measured" in fronts.sentence(loss, "Å")


def test_below_the_resolution_of_the_reference_nothing_is_lost():
    peer = point("dop853", "SciPy DOP853", 1e-6, 1e5, 1e5)
    assert fronts.verdict(comparison(*RATTLE, peer, reference=1e-4)).losses == []


def test_times_within_the_margin_are_the_same():
    peer = point("dop853", "SciPy DOP853", 1e-2, 100, 0.8)
    assert fronts.verdict(comparison(*RATTLE, peer)).losses
    assert not fronts.verdict(comparison(*RATTLE, peer, margin=0.3)).losses


@pytest.mark.parametrize(
    ("peer", "beaten"),
    [
        (point("dop853", "SciPy DOP853", 0.9e-2, 90, 0.9), [1e-2]),
        (point("dop853", "SciPy DOP853", 0.9e-2, 90, 0.96), []),
        (point("dop853", "SciPy DOP853", 0.97e-2, 90, 0.5), []),
        (point("dop853", "SciPy DOP853", 0.9e-4, 90, 0.9), [1e-2, 1e-4]),
        (point("dop853", "SciPy DOP853", 2e-2, 90, 0.1), []),
    ],
    ids=["both", "time within five percent", "error within five percent", "both of two", "cheaper only"],
)
def test_overtaken_is_what_another_method_beats_in_time_and_error(peer, beaten):
    dominated = point("yoshida4", "kcons Yoshida4", 2e-2, 100, 2.0)  # by RATTLE: not on the front
    found = fronts.overtaken(comparison(*RATTLE, dominated, peer, margin=0.3))
    assert [mine.error for mine, _ in found[fronts.ARRAYS]] == beaten
    assert all(other is peer for _, other in found[fronts.ARRAYS])


def test_overtaken_counts_evaluations_where_these_decide():
    peer = point("dop853", "SciPy DOP853", 0.9e-2, 97, 5.0)
    assert fronts.overtaken(comparison(*RATTLE, peer, force=1e-7)) == {fronts.ARRAYS: [(RATTLE[0], peer)]}
    assert fronts.overtaken(comparison(*RATTLE, peer)) == {fronts.ARRAYS: []}
    assert fronts.overtaken(comparison(*RATTLE)) == {}


def test_evaluations_decide_where_forces_take_no_time():
    assert fronts.verdict(comparison(*RATTLE, force=1e-7)).decides == "evaluations"
    assert fronts.verdict(comparison(*RATTLE, force=1e-5)).decides == "wall"


def test_md_engines_are_judged_by_themselves():
    # Within ASE nothing beats kcons, though OpenMM is cheaper; across MD engines evaluations are compared.
    points = (
        point("ase-kcons", "ASE Verlet + kcons", 1e-2, 100, 3.0),
        point("ase-bonds", "ASE Verlet + FixBondLengths", 1e-2, 100, 30.0),
        point("openmm-verlet", "OpenMM Verlet, 1e-5", 1e-2, 50, 0.1),
    )
    found = fronts.verdict(comparison(*points))
    standings = {(s.md_engine, s.cost): s for s in found.standings}
    assert standings["ASE", "wall"].gain == pytest.approx(10.0)
    assert not standings["ASE", "wall"].losses
    assert not standings["OpenMM", "wall"].rivals  # nothing of kcons there
    assert [loss.method for loss in standings[fronts.EVERY_MD_ENGINE, "evaluations"].losses] == ["openmm-verlet"]


def test_baselines_and_failures_are_no_points():
    baseline = point("verlet", "baseline", None, 10, 0.1, status="baseline")
    failed = point("dop853", "SciPy DOP853", None, 10, 0.1, status="failed")
    assert fronts.points(comparison(*RATTLE, baseline, failed), "wall") == list(RATTLE)


def test_many_losses_in_one_sentence():
    losses = [
        fronts.Loss("OpenMM", "wall", "a", "A", (1e-4, 1e-3), 1.5),
        fronts.Loss("OpenMM", "wall", "b", "B", (1e-3, 1e-2), 4.0),
    ]
    text = fronts.together(losses, "Å")
    assert text == "B and 1 other at errors from 1e-04 to 1e-02 Å: up to 4 times cheaper (wall time, OpenMM)"
    assert fronts.together([], "Å") == ""
    assert "33 % cheaper" in fronts.sentence(losses[0], "Å")


def test_summary_has_a_row_for_each_md_engine():
    peer = point("dop853", "SciPy DOP853", 1e-2, 300, 3.0)
    (row,) = fronts.summary(comparison(*RATTLE, peer))
    assert (row["md_engine"], row["cost"], row["losses"]) == ("arrays", "wall time", [])
    assert row["front"] == ["kcons RATTLE"]


def test_evaluations_decide_on_an_md_engine_that_computes_forces_in_no_time():
    ours = point("openmm-rattle", "OpenMM + kcons compiled RATTLE, 1e-12", 1e-3, 100, 2e-5)
    theirs = point("openmm-verlet", "OpenMM Verlet, 1e-5", 1e-3, 100, 1e-5)
    arrays = (point("rattle", "kcons RATTLE", 1e-3, 100, 1.0), point("shake-1e-8", "SHAKE", 1e-3, 100, 0.9))
    for baseline_step, decides, losses in ((2e-7, "evaluations", 0), (2e-6, "wall", 1)):
        baseline = point("openmm-free", "baseline", None, 100, 1e-5, status="baseline", step_seconds=baseline_step)
        found = fronts.verdict(comparison(ours, theirs, baseline, *arrays, force=1e-5, margin=0.05))
        assert found.decides_on("OpenMM") == decides
        assert found.decides_on("arrays") == "wall"
        assert [loss.md_engine for loss in found.losses if loss.md_engine == "OpenMM"] == ["OpenMM"] * losses
        assert any(loss.md_engine == "arrays" for loss in found.losses)
