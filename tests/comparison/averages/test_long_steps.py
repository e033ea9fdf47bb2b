"""Bias against evaluations of expensive forces: counts are right, what is right is found so, what fails is shown."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from ase import units

from kcons.comparison import fluid, long_steps
from kcons.comparison.averages.layers import of_fluid
from kcons.comparison.averages.long_steps import METHODS, Stepped, best, compare, measure
from kcons.errors import InputError

FS = units.fs


@pytest.fixture(scope="module")
def layers():
    return of_fluid(fluid.water(27), 3.8, sweeps=2000, inner=2 * FS)


@pytest.fixture(scope="module")
def runs(layers):
    steps = {"langevin": 2, "langevin-respa": 4, "langevin-halfway": 4, "spheres": 4, "hmc": 4}
    return {name: measure(layers, METHODS[name], dt * FS, 0.01 / FS, length=4000 * FS) for name, dt in steps.items()}


def test_every_method_is_right_at_a_fine_step(layers, runs):
    for run in runs.values():
        assert run.status == "ok", run.note
        for value, error in [*run.kinds.values(), run.energy_off]:
            assert abs(value) <= 4 * error
        assert set(run.kinds) == {"shift", "turn"} and run.kinds["shift"][1] < 0.1
        assert run.samples >= long_steps.FEWEST and run.seconds > 0


def test_evaluations_are_counted(runs):
    """One of the expensive forces a step, with several steps cheap ones besides; in Monte Carlo those of its scheme."""
    for name, per_step in (("langevin", 1), ("langevin-respa", 1), ("langevin-halfway", 1), ("spheres", 1)):
        run = runs[name]
        assert run.evaluations == pytest.approx(per_step * run.length / run.step, abs=2)
    assert runs["langevin"].cheap == 0 and runs["hmc"].cheap == 0
    # Of two inner steps each ends where the next begins, and the expensive forces are asked for at one of these places.
    for name in ("langevin-respa", "spheres"):
        assert runs[name].cheap == pytest.approx(2 * runs[name].evaluations, abs=3)
    assert runs["hmc"].evaluations == pytest.approx(6 * runs["hmc"].length / 4, rel=0.1)
    assert runs["hmc"].accepted > 0.9 and runs["langevin"].accepted is None


def test_bias_beyond_noise(runs):
    """Of the temperature that is most standard errors off; what three explain does not count."""
    assert all(run.bias <= 0.01 for run in runs.values())
    assert run_of(kinds={"shift": (0.01, 0.005), "turn": (-0.07, 0.01)}).bias == pytest.approx(0.04)
    run = runs["langevin"]
    assert run.per_time == pytest.approx(run.evaluations / run.length)


def test_results_can_be_repeated(layers, runs):
    again = measure(layers, METHODS["spheres"], 4 * FS, 0.01 / FS, length=4000 * FS)
    assert again.energy == runs["spheres"].energy and again.kinds == runs["spheres"].kinds


def test_observables_beside_the_energy(layers, runs):
    """Averages, errors and calls for a sample are those of the energy, where the energy is what is observed."""
    seen = {"energy": lambda x: layers.slow.watched_energy(x) / layers.molecules, "nothing": lambda x: 1.0}
    run = measure(replace(layers, observables=seen), METHODS["spheres"], 4 * FS, 0.01 / FS, length=4000 * FS)
    value, error, calls = run.observed["energy"]
    assert (value, error) == pytest.approx(runs["spheres"].energy) and runs["spheres"].observed == {}
    assert calls == pytest.approx(run.correlation) and run.correlation == runs["spheres"].correlation
    # What does not change has a sample in every look at it.
    assert run.observed["nothing"] == pytest.approx((1.0, 0.0, run.evaluations / run.samples))


def test_a_step_that_is_too_long_is_shown(layers):
    run = measure(layers, METHODS["langevin"], 60 * FS, 0.01 / FS, length=60_000 * FS)
    assert run.status == "failed" and "Error" in run.note and run.kinds == {}
    short = measure(layers, METHODS["langevin"], 2 * FS, 0.01 / FS, length=60 * FS)
    assert short.status == "partial" and "too few" in short.note


def run_of(**changes):
    values = {"method": "spheres", "step": 4.0, "friction": 1.0, "status": "ok", "evaluations": 1000, "length": 4000.0}
    return Stepped(**{**values, "energy": (1.0, 0.1), "energy_off": (0.2, 0.1), "correlation": 50.0, **changes})


def test_the_best_friction():
    """Of each method and step, by the bias; where there is none to see, by the cost of a sample."""
    warm, warmer = run_of(kinds={"turn": (0.05, 0.01)}), run_of(kinds={"turn": (0.09, 0.01)}, correlation=1.0)
    failed, found = run_of(step=8.0, status="failed"), run_of(step=8.0, kinds={"turn": (3.0, 0.1)})
    assert best([warmer, warm, failed, found]) == [warm, found]
    slow, quick = run_of(kinds={"turn": (0.01, 0.01)}), run_of(kinds={"turn": (0.02, 0.01)}, correlation=5.0)
    assert best([slow, quick]) == [quick]
    lame = run_of(kinds={"turn": (0.02, 0.01)}, correlation=1.0, observed={"length": (1.0, 0.1, 60.0)})
    assert best([lame, slow]) == [slow]


def test_comparison(layers):
    found = compare(layers, methods=["langevin-respa"], steps=[4 * FS], frictions=[0.01 / FS, 0.02 / FS], budget=1.0)
    assert [(run.step, run.friction) for run in found.runs] == [(4.0, pytest.approx(0.01)), (4.0, pytest.approx(0.02))]
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["format"] == "kcons-long-steps-1" and data["settings"]["methods"] == ["langevin-respa"]
    assert data["reference"][0] == pytest.approx(layers.reference.value / 27)


def test_between_kicks_an_odd_number_of_inner_steps_becomes_even(layers):
    """They get shorter, and never longer than asked for."""
    stepper = METHODS["langevin-halfway"].make(layers, 6 * FS, 0.01 / FS, 1)
    assert [(level.group, level.steps) for level in stepper.levels] == [("slow", 1), ("fast", 4)]
    run = measure(layers, METHODS["langevin-halfway"], 6 * FS, 0.01 / FS, length=60 * FS)
    assert run.status == "partial" and run.cheap == 4 * run.evaluations


@pytest.mark.parametrize("wrong", [{"steps": [4 * FS, 1000 * FS]}, {"frictions": [0.01 / FS, -1.0]}], ids=str)
def test_nothing_runs_where_one_run_cannot_be(layers, monkeypatch, wrong):
    monkeypatch.setattr(long_steps, "measure", lambda *_, **__: pytest.fail("a run was made"))
    with pytest.raises(InputError, match=r"is too long|friction is"):
        compare(layers, **{"methods": ["spheres"], "budget": 1.0, **wrong})


def test_bad_input(layers):
    with pytest.raises(InputError, match="there is no method 'rattle'; there are langevin"):
        compare(layers, methods=["rattle"])
    for text, arguments in (
        ("dt is", {"step": 0.0}),
        ("friction is", {"friction": -1.0}),
        ("length is", {"length": float("nan")}),
        ("either length or budget", {"budget": 1.0}),
        ("is too long", {"step": 1000 * FS}),
    ):
        given = {"step": 2 * FS, "friction": 1.0, "length": 1.0, **arguments}
        step, friction = given.pop("step"), given.pop("friction")
        with pytest.raises(InputError, match=text):
            measure(layers, METHODS["spheres"], step, friction, **given)
    with pytest.raises(InputError, match="time step -3 fs: give a positive number"):
        compare(layers, methods=["langevin"], steps=[4 * FS, -3 * FS])
    with pytest.raises(InputError, match="give a positive number of seconds"):
        compare(layers, budget=0)
