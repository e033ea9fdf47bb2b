"""One table of measurements: errors and costs, budgets, failures, rounds of timing, runs that go on."""

from __future__ import annotations

import functools
import signal
import sys
import time
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from kcons.comparison import METHODS, add_method, compare, measure, test_systems
from kcons.comparison.methods import on_arrays
from kcons.comparison.runs import OnArrays
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import Rattle, State, System


@pytest.fixture
def registry():
    with patch.dict(METHODS):
        yield


@functools.cache
def chain():
    """Five bonds, four steps of 20 fs and shorter."""
    return test_systems.build("chain", 5)


@functools.cache
def table():
    return compare(chain(), ["rattle", "ase-kcons", "dop853", "verlet"], budget=20, rounds=2)


def test_a_row_a_method_and_setting_and_beside_them_what_they_are_of():
    found = table()
    assert list(found.columns) == list(measure.COLUMNS)
    assert list(dict.fromkeys(found.method)) == ["rattle", "ase-kcons", "dop853", "verlet"]
    rattle = found[found.method == "rattle"]
    assert list(rattle.setting) == pytest.approx([dt / chain().units.time_unit for dt in chain().time_steps])
    assert list(rattle.steps) == [round(chain().horizon / dt) for dt in chain().time_steps]
    assert (rattle.status == "ok").all() and (found[found.method == "verlet"].status == "baseline").all()
    # Errors fall with the square of the step; forces are counted, one a step.
    ratios = rattle.error.to_numpy()[:-1] / rattle.error.to_numpy()[1:]
    np.testing.assert_allclose(ratios, 4.0, rtol=0.1)
    each = chain().units.long_time_unit / np.array(chain().time_steps)
    np.testing.assert_allclose(rattle.evaluations, each, rtol=1e-9)
    np.testing.assert_allclose(rattle.seconds, each * rattle.step_seconds, rtol=1e-9)
    assert rattle.sigma.max() < 1e-13 and rattle.tangency.max() < 1e-13
    about = found.attrs
    assert about["atoms"] == 6 and about["rows"] == about["rank"] == 5
    assert (about["length"], about["time"], about["long_time"]) == ("Å", "fs", "ps")
    assert about["reference_error"] < 1e-9 and "BlanesMoan6" in about["reference"]
    assert about["environment"]["versions"]["numpy"]
    assert 0 <= about["force_seconds"] < 1e-2 and about["margin"] is not None
    # The error is that of the trajectory.
    run = METHODS["rattle"].start(chain(), chain().time_steps[1])
    run.advance(rattle.steps.iloc[1])
    off = run.observe()[0] - chain().reference().positions
    assert rattle.error.iloc[1] == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=1e-6)


def test_the_slope_of_the_energy_is_found(registry):
    class Heated(Rattle):
        """Velocities grow by a fraction in each step."""

        def step(self, system, state, dt):
            after = super().step(system, state, dt)
            return replace(after, velocities=after.velocities * (1 + 1e-4))

    heated = add_method("heated", functools.partial(on_arrays, lambda dt: Heated()))
    row, plain = (
        measure.measure(chain(), method, chain().time_steps[-1], chain().reference(), 10.0)
        for method in (heated, METHODS["rattle"])
    )
    assert row["slope"] > 10 * row["slope_error"] and row["slope"] > 100 * abs(plain["slope"])


# -- budgets and failures ---------------------------------------------------------------------------


class Slow(OnArrays):
    """Sleeps in each step."""

    seconds = 0.1

    def advance(self, steps=1):
        time.sleep(steps * self.seconds)
        self.done += steps


def run(s, dt, stepper=Rattle, kind=OnArrays, **own):
    made = kind(System(s.motion, s.potential.forces), State(s.positions, s.velocities), stepper(), dt)
    return vars(made).update(own) or made


def test_what_exceeds_the_budget_is_stopped_after_a_step(registry):
    add_method("slow", functools.partial(run, kind=Slow))
    found = compare(chain(), ["slow", "rattle"], budget=0.4, rounds=0)
    slow = found[found.method == "slow"]
    assert "partial" in set(slow.status) and set(slow.status) <= {"ok", "partial", "not run"}
    first = slow[slow.status == "partial"].iloc[0]
    assert first.steps >= 1 and np.isnan(first.error) and first.step_seconds == pytest.approx(0.1, rel=0.5)
    assert "exceed the budget of 0.4 s" in first.note
    assert (found[found.method == "rattle"].status == "ok").all()


def test_a_step_that_does_not_end_is_interrupted(registry):
    add_method("hanging", functools.partial(run, kind=Slow, seconds=60.0))
    begun = time.perf_counter()
    (row,) = compare(chain(), ["hanging"], budget=0.2, rounds=0).to_dict("records")
    assert time.perf_counter() - begun < 10
    assert row["status"] == "partial" and "step 1 was not done" in row["note"]


def test_what_a_finalizer_swallows_is_raised_again(monkeypatch):
    class Lingering:
        def __del__(self):
            time.sleep(60.0)

    def body():
        lingering = Lingering()
        del lingering
        assert len(lost) == 1 and lost[0] is measure.OverBudgetError  # Python goes on
        time.sleep(10.0)

    lost, before = [], signal.getsignal(signal.SIGALRM)
    monkeypatch.setattr(sys, "unraisablehook", lambda said: lost.append(said.exc_type))
    begun = time.perf_counter()
    with pytest.raises(measure.OverBudgetError), measure.InterruptedAfter(0.05):
        body()
    assert time.perf_counter() - begun < 5
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0) and signal.getsignal(signal.SIGALRM) is before


def test_what_a_method_raises_or_does_wrong_is_a_result(registry, monkeypatch):
    class Failing(Rattle):
        def step(self, system, state, dt):
            if state.step == 2:
                raise InputError("no solution at this step", item="dt")
            return super().step(system, state, dt)

    class Unable(Rattle):
        def check(self, system):
            raise UnsupportedError("no such constraints here; use Rattle")

    class Lazy(OnArrays):
        def advance(self, steps=1):
            super().advance()
            self.done += steps - 1

    monkeypatch.setattr(measure, "MORE_SECONDS", 0.0)
    for start, status, words in (
        (functools.partial(run, stepper=Failing), "failed", "InputError: no solution at this step"),
        (functools.partial(run, stepper=Unable), "not run", "^no such constraints here; use Rattle$"),
        (functools.partial(run, kind=Lazy), "ok", "makes 1 force evaluations, not .*: make all steps"),
        (lambda s, dt: None, "failed", "start gives a NoneType"),
        (lambda s, dt: run(s, 2 * dt), "failed", "the run ends at 160 fs, not at the horizon"),
        (functools.partial(run, evaluations=0), "failed", "no force evaluation is counted"),
        (lambda s, dt: run(s, dt, observe=lambda: (s.positions[:1],) * 2), "failed", "positions must have shape"),
        (lambda s, dt: s.velocities.fill(0.0), "failed", "read-only"),
    ):
        add_method("wrong", start)
        found = compare(chain(), ["wrong", "rattle"], rounds=1)
        wrong = found[found.method == "wrong"]
        assert set(wrong.status) == {status} and wrong.note.str.contains(words).all() and not wrong.rounds.any()
        assert list(found.status)[-4:] == ["ok"] * 4


def test_a_set_up_of_openmm_beyond_the_budget_is_refused_from_then_on():
    rotor = test_systems.build("rotor").shortened(4)
    rotor.openmm._waited = 50.0
    found = compare(rotor, ["openmm-verlet", "openmm-held-rattle"], budget=49, rounds=0)
    refused = found.iloc[0]
    assert refused.status == "not run"
    assert "OpenMM took 50 s to set up its own solver for 6 constraints, longer than the budget of 49 s" in refused.note
    assert set(found.iloc[1:].status) == {"ok"}


# -- times ------------------------------------------------------------------------------------------


def test_kernels_of_kcons_are_loaded_before_a_budget_begins_also_in_openmm():
    begun, names = [], ("openmm-verlet", "openmm-kcons-rattle")
    methods = [replace(METHODS[name], start=lambda *_, name=name: begun.append(name)) for name in names]
    measure.warm_up(test_systems.build("rotor"), methods, 1.0)
    assert begun == ["openmm-kcons-rattle"]


def test_short_runs_are_timed_in_rounds_and_long_ones_once():
    assert (table()[table().method == "rattle"].rounds >= 2).all()
    once = compare(chain(), ["rattle"], rounds=0)
    assert (once.rounds == 0).all() and once.attrs["margin"] is None


def test_the_median_of_the_rounds_is_the_time_of_a_step(monkeypatch):
    given = iter((1.0, 3.0, 2.0))
    monkeypatch.setattr(measure.Rounds, "_one", lambda self, row: next(given))
    monkeypatch.setattr(measure, "MORE_SECONDS", 0.0)
    row = {"method": "rattle", "adaptive": False, "status": "ok", "note": "", "steps": 1, "rounds": 0}
    row |= {"seconds": 8.0, "step_seconds": 4.0}
    # The median of the odd rounds is 1.5, that of the even one 3.
    assert measure.Rounds(chain(), 3, 10.0, 30.0, measure.Watcher()).time([row]) == pytest.approx(1.0)
    assert (row["rounds"], row["step_seconds"], row["seconds"]) == (3, 2.0, 4.0)


def test_steps_that_cost_unevenly_are_timed_again_and_nine_tenths_of_the_medians_keep_to_the_margin():
    row = {"method": "rattle", "adaptive": False, "rounds": 3, "note": ""}
    for longest in (2.5, 1.9):
        rows = [row | {"step_seconds": cost} for cost in (1.0, 1.5, longest)]
        assert measure._uneven(rows) == (rows if longest == 2.5 else [])
    assert measure.margin([[1.0, 1.1], [1.0, 1.0], [2.0]]) == pytest.approx(0.09, abs=0.01)
    assert measure.margin([[1.0]]) is None and measure.margin([]) is None
