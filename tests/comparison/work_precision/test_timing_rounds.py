"""Steps are timed while nobody looks on, in rounds that take turns, and what goes wrong there is said."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods.method import STRETCH, OverBudgetError, Run, Stopwatch
from kcons.comparison.methods.peers import lammps_shake, shake
from kcons.comparison.work_precision import measure
from kcons.comparison.work_precision.measurement import Measurement
from kcons.comparison.work_precision.timing_rounds import (
    BASELINE_BLOCK,
    FULL_ROUNDS,
    QUICK_ROUNDS,
    WARM_STEPS,
    Rounds,
    interleaved,
    marched,
    margin,
)
from kcons.errors import ConvergenceError, KconsError

#: Few and short.
SHORT = Rounds(least=2, most=2, seconds=0.0, pass_seconds=1e-4)


@pytest.fixture(scope="module")
def chain():
    return test_systems.build("chain", 6)


@pytest.fixture(scope="module")
def spheres():
    return test_systems.build("sphere-pendulum", 2)


MARCHING = ("rattle", "suzuki4", "blanes-moan6", "geodesic", "projected-rk4", "baumgarte", "verlet")
IN_OPENMM = ("ase-kcons", "ase-bonds", "ase-internals", "ase-verlet", "shake-1e-4", "shake-1e-8", "mici", "mici-tight")


def started(system, name):
    if name.startswith("mici"):
        pytest.importorskip("mici")
    method = methods.METHODS[name]
    assert method.marches
    return method.start(system, min(method.settings(system)))


# -- steps that nobody looks at ---------------------------------------------------------------------


@pytest.mark.parametrize("name", [*MARCHING, *IN_OPENMM])
def test_marching_is_advancing(chain, name):
    looked_at, alone = started(chain, name), started(chain, name)
    for _ in range(7):
        looked_at.advance()
    alone.march(3)
    alone.march(4)
    np.testing.assert_array_equal(alone.positions, looked_at.positions)
    np.testing.assert_array_equal(alone.velocities, looked_at.velocities)
    assert alone.time == looked_at.time
    assert not np.array_equal(alone.positions, chain.positions)


@pytest.mark.parametrize("name", ["rattle", "mici", "kahan-li6"])
def test_marching_is_advancing_with_friction(name):
    fekete = test_systems.build("fekete", 4)
    looked_at, alone = started(fekete, name), started(fekete, name)
    for _ in range(3):
        looked_at.advance()
    alone.march(3)
    np.testing.assert_array_equal(alone.positions, looked_at.positions)


@pytest.mark.parametrize("name", [*MARCHING, *IN_OPENMM])
def test_back_at_the_start_everything_is_as_it_was(chain, name):
    run = started(chain, name)
    evaluations = chain.potential.evaluations
    run.march(4)
    took = chain.potential.evaluations - evaluations
    ends = run.positions, run.velocities
    run.rewind()
    np.testing.assert_allclose(run.positions, chain.positions, rtol=0, atol=1e-15)
    np.testing.assert_allclose(run.velocities, chain.velocities, rtol=0, atol=1e-15)
    evaluations = chain.potential.evaluations
    run.march(4)
    np.testing.assert_array_equal(run.positions, ends[0])
    np.testing.assert_array_equal(run.velocities, ends[1])
    # The forces at the start are known.
    assert chain.potential.evaluations == evaluations + took


def test_what_cannot_go_back_does_not_march():
    for name, method in methods.METHODS.items():
        whole = method.adaptive or isinstance(method, lammps_shake.LammpsShake)
        assert method.marches is not whole, name


@pytest.mark.skipif(find_spec("openmm") is None, reason="OpenMM is not installed")
@pytest.mark.parametrize("name", ["openmm-verlet", "openmm-rattle", "openmm-kcons-suzuki4", "openmm-held-rattle"])
def test_openmm_goes_back_to_the_start_and_one_step_on(chain, name):
    run = methods.METHODS[name].start(chain, min(chain.time_steps))
    run.march(5)
    positions, velocities = run.positions, run.velocities
    assert run.time == pytest.approx(5 * min(chain.time_steps))
    for _ in range(2):
        run.rewind()
        run.settle()
        run.march(4)
        np.testing.assert_allclose(run.positions, positions, rtol=0, atol=1e-12)
        np.testing.assert_allclose(run.velocities, velocities, rtol=0, atol=1e-11)


def test_sweeps_that_do_not_converge_are_an_error_without_onlookers(chain, monkeypatch):
    monkeypatch.setattr("kcons.comparison.methods.peers.gauss_seidel.MANY_SWEEPS", 2)
    run = shake.Shake("shake", "sweeps", tolerance=1e-12).start(chain, max(chain.time_steps))
    with pytest.raises(ConvergenceError, match="SHAKE did not converge to 1e-12 in 2 sweeps"):
        run.march(3)


# -- the stopwatch lets go --------------------------------------------------------------------------


def test_stopwatch_lets_go():
    class Object:
        def __init__(self):
            self.own = lambda: "own"

        def of_class(self):
            return "class"

    watch, thing = Stopwatch(), Object()
    own = thing.own
    watch.watch(thing, ("own", "of_class"))
    assert thing.own is not own
    watch.watch(thing, ("own",))
    watch.release()
    assert thing.own is own
    assert vars(thing) == {"own": own}
    assert (thing.own(), thing.of_class()) == ("own", "class")
    before = watch.seconds
    thing.of_class()
    assert watch.seconds == before


@pytest.mark.parametrize("name", ["geodesic", "projected-rk4", "ase-kcons", "ase-bonds", "shake-1e-4", "mici"])
def test_released_runs_are_not_watched(spheres, chain, name):
    run = started(chain, name)
    run.advance()
    run.constraints.release()
    spent = run.constraints.seconds
    run.march(2)
    run.advance()
    assert run.constraints.seconds == spent
    if name != "geodesic":
        assert spent > 0


# -- one round --------------------------------------------------------------------------------------


class Noted(Run):
    """Writes down what it is asked for."""

    def __init__(self, end=1.0):
        super().__init__()
        self.asked, self.end, self.let_go = [], end, False
        self.constraints.release = lambda: setattr(self, "let_go", True)

    def advance(self):
        raise AssertionError("nobody looks on")

    def march(self, steps):
        assert self.let_go
        self.asked.append(steps)

    def rewind(self):
        self.asked.append("back")

    @property
    def finished(self):
        return False

    @property
    def positions(self):
        return np.full((1, 3), self.end)

    velocities = positions


def measurement(**more):
    return Measurement(
        **{"method": "rattle", "title": "kcons RATTLE", "setting": 1.0, "adaptive": False, "status": "ok", **more}
    )


@pytest.mark.parametrize(
    ("step_seconds", "holds", "warm", "block"),
    [(1e-6, True, WARM_STEPS, 120), (1.0, True, 1, 120), (1e-6, False, WARM_STEPS, BASELINE_BLOCK)],
)
def test_warm_first_and_every_pass_from_the_start(step_seconds, holds, warm, block):
    run = Noted()
    found = marched(run, measurement(steps=120, step_seconds=step_seconds), holds, 1e-4)
    first, *passes = run.asked
    assert first == warm
    assert passes == ["back", block] * (len(passes) // 2)
    assert len(passes) > 2  # a pass takes nothing here: they go on until enough is timed
    assert 0 < found < 1e-4 / block


@pytest.mark.parametrize(("limit", "end", "block"), [(1000, 1.0, STRETCH), (90, 1.0, 12), (1000, np.inf, 12)])
def test_few_short_steps_go_on_beyond_the_horizon_where_they_can(limit, end, block):
    class Limited(Noted):
        def march(self, steps):
            super().march(steps)
            self.far = steps > 12
            if steps > limit:
                raise ArithmeticError("too far")

        @property
        def positions(self):
            return np.full((1, 3), end if self.far else 1.0)

    run = Limited()
    marched(run, measurement(steps=12, step_seconds=1e-6), True, 1e-3)
    warm, back, tried, *passes = run.asked
    assert (warm, back, tried) == (WARM_STEPS, "back", STRETCH)
    while passes[-2:] == ["back", block]:
        del passes[-2:]
    # What was tried in vain has left nothing but one more way back.
    assert passes == [] or (block == 12 and set(passes) <= {"back", STRETCH})


def test_few_long_steps_end_at_the_horizon():
    run = Noted()
    marched(run, measurement(steps=12, step_seconds=1e-4), True, 1e-3)
    assert set(run.asked) == {WARM_STEPS, 12, "back"}


def test_time_is_up_beyond_the_horizon_too():
    class Endless(Noted):
        def march(self, steps):
            super().march(steps)
            if steps == STRETCH:
                raise OverBudgetError("not done after 1 s")

    run = Endless()
    with pytest.raises(OverBudgetError):
        marched(run, measurement(steps=12, step_seconds=1e-6), True, 1e-3)
    assert run.asked == [WARM_STEPS, "back", STRETCH]


def test_running_away_is_an_error():
    with pytest.raises(KconsError, match="positions are not finite"):
        marched(Noted(np.nan), measurement(steps=3, step_seconds=1e-6), True, 1e-4)


# -- rounds -----------------------------------------------------------------------------------------


def test_rounds_take_turns():
    order = []
    tasks = [lambda k=k: order.append(k) or 1.0 for k in range(3)]
    told = []
    found = interleaved(tasks, Rounds(least=1, most=4, seconds=10.0), told.append)
    assert order == [0, 1, 2] * 4
    assert told == [1, 2, 3, 4]
    assert [mine.steps for mine in found] == [[1.0] * 4] * 3


def test_long_ones_have_the_least_number_of_rounds(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("kcons.comparison.work_precision.timing_rounds.clock", lambda: clock[0])

    def taking(seconds):
        def task():
            clock[0] += seconds
            return seconds

        return task

    found = interleaved([taking(0.05), taking(0.2), taking(1.5)], Rounds(least=2, most=8, seconds=0.61))
    assert [len(mine.steps) for mine in found] == [8, 3, 2]


def test_a_failure_ends_the_rounds_of_its_own_only():
    calls = []

    def failing():
        calls.append(1)
        if len(calls) == 2:
            raise ValueError("as an example\nwith more lines")
        return 1.0

    bad, good = interleaved([failing, lambda: 2.0], Rounds(least=3, most=3))
    assert bad.failure == "round 2: ValueError: as an example"
    assert len(calls) == 2
    assert good.failure == "" and good.steps == [2.0] * 3


def test_margin_is_the_difference_of_odd_and_even_rounds():
    assert margin([]) is None
    assert margin([[1.0]]) is None
    # Medians of odd rounds 2, of even rounds 3.
    assert margin([[1.0, 3.0, 2.0, 3.0, 9.0]]) == pytest.approx(0.5)
    assert margin([[3.0, 2.0], [1.0]]) == pytest.approx(0.5)
    # One of ten is off: nine tenths repeat exactly. Of two of ten, one is left out.
    assert margin([[1.0, 1.0]] * 10) == pytest.approx(0.0)
    assert margin([[1.0, 1.0]] * 11 + [[1.0, 5.0]]) == pytest.approx(0.0)
    assert margin([[1.0, 1.0]] * 2 + [[1.0, 1.2]] * 9) == pytest.approx(0.2)


# -- in a comparison --------------------------------------------------------------------------------


def test_times_are_medians_over_rounds(chain, monkeypatch):
    seen = {}

    def fake(run, m, holds, pass_seconds):
        mine = seen.setdefault((m.method, m.setting), [1.0, 3.0])
        return mine.pop(0)

    monkeypatch.setattr("kcons.comparison.work_precision.timing_rounds.marched", fake)
    found = measure.compare(chain, methods=["rattle", "ase-kcons", "verlet"], rounds=SHORT)
    assert len(seen) == 3 * len(chain.time_steps)
    assert {m.step_seconds for m in found.measurements} == {2.0}
    for m in found.of("rattle"):
        assert m.seconds_per_time == pytest.approx(2.0 * 1000 / m.setting)
    # Of the run that was observed.
    assert all(0 < m.constraint_seconds < 0.1 for m in found.of("ase-kcons"))
    assert found.timing["repeats"] == 2
    assert found.timing["margin"] == pytest.approx(2.0)


def test_whole_runs_are_made_again_where_steps_cannot_be(chain, monkeypatch):
    runs = []
    start = methods.ProjectedOde.start

    def noted(self, system, setting):
        run = start(self, system, setting)
        runs.append((run, run.constraints.seconds))
        return run

    monkeypatch.setattr(methods.ProjectedOde, "start", noted)
    found = measure.compare(chain, methods=["dop853"], rounds=SHORT)
    settings = len(found.measurements)
    assert settings > 1 and len(runs) == 3 * settings
    assert all(run.finished for run, _ in runs)
    # Only the first of each is watched after it was set up.
    assert all(run.constraints.seconds > before for run, before in runs[:settings])
    assert all(run.constraints.seconds == before for run, before in runs[settings:])
    assert found.timing["margin"] is not None


def test_without_rounds_nothing_is_made_again(chain, monkeypatch):
    monkeypatch.setattr("kcons.comparison.work_precision.timing_rounds.timed", None)
    found = measure.compare(chain, methods=["rattle"])
    assert found.timing["repeats"] == 0 and found.timing["margin"] is None


def test_what_fails_in_a_round_is_said(chain, monkeypatch):
    plain = measure.compare(chain, methods=["rattle"])

    def failing(self, steps):
        raise ConvergenceError("not this time")

    monkeypatch.setattr(methods._CoreRun, "march", failing)
    found = measure.compare(chain, methods=["rattle"], rounds=SHORT)
    for before, m in zip(plain.measurements, found.measurements, strict=True):
        assert m.status == "ok" and m.error == before.error and m.step_seconds > 0
        assert m.note == "time as observed: round 1: ConvergenceError: not this time"
    assert found.timing["margin"] is None


def test_a_round_that_does_not_come_back_is_interrupted(chain, monkeypatch):
    def endless(self, steps):
        while True:
            pass

    monkeypatch.setattr(methods._CoreRun, "march", endless)
    system = replace(chain, time_steps=chain.time_steps[:1])
    (only,) = measure.compare(system, methods=["rattle"], rounds=SHORT, budget=0.5).measurements
    assert only.status == "ok"
    assert "round 1: OverBudgetError: not done after 1.5 s" in only.note


def test_quick_rounds_are_fewer_and_shorter():
    full, quick = FULL_ROUNDS, QUICK_ROUNDS
    # Runs of 50 ms are timed seven times at least.
    assert full.seconds / 0.05 >= 7 and full.most >= 7
    assert quick.least < full.least and quick.most < full.most
    assert quick.seconds < full.seconds and quick.pass_seconds < full.pass_seconds


@pytest.mark.skipif(find_spec("openmm") is None, reason="OpenMM is not installed")
@pytest.mark.usefixtures("usual_amounts")
def test_openmm_makes_many_steps_at_a_stretch(chain):
    run = methods.METHODS["openmm-rattle"].start(chain, min(chain.time_steps))
    assert [run.stretch(each, 0.01) for each in (1e-6, 1.3e-5, 1e-3, 0.007, 1.0)] == [2000, 769, 500, 85, 10]


@pytest.mark.skipif(find_spec("openmm") is None, reason="OpenMM is not installed")
def test_openmm_is_timed_in_rounds():
    system = test_systems.build("chain", 4)
    system = replace(system, time_steps=system.time_steps[:1])
    found = measure.compare(system, methods=["openmm-verlet", "openmm-held-rattle"], rounds=SHORT)
    assert {m.status for m in found.measurements} == {"ok"}, [m.note for m in found.measurements]
    assert not any(m.note for m in found.measurements)
    assert found.timing["margin"] is not None
