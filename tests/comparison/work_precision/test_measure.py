"""What `compare` measures is right, and what goes wrong in a method is shown."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.work_precision import measure
from kcons.errors import ConvergenceError, InputError
from kcons.steppers import State, System, run


@pytest.fixture(scope="module")
def chain():
    return test_systems.build("chain", 4)


@pytest.fixture(scope="module")
def result(chain):
    return measure.compare(chain, budget=30)


@pytest.fixture(scope="module")
def spheres():
    return measure.compare(test_systems.build("sphere-pendulum", 2), budget=30)


def test_all_methods_are_there(chain, result):
    usual = [method.name for method in methods.usual(chain)]
    assert list(dict.fromkeys(m.method for m in result.measurements)) == usual
    assert {m.status for m in result.measurements} == {"ok", "baseline"}


@pytest.mark.parametrize("method", ["rattle", "ase-kcons", "ase-bonds"])
def test_error_falls_with_the_square_of_the_step(result, method):
    errors = [m.error for m in result.of(method)]
    assert len(errors) == 4
    assert errors == sorted(errors, reverse=True)
    assert result.observed_order(method) == pytest.approx(2.0, abs=0.05)


def test_rattle_is_the_same_in_the_core_and_in_ase(result):
    for core, in_openmm in zip(result.of("rattle"), result.of("ase-kcons"), strict=True):
        assert in_openmm.error == pytest.approx(core.error, rel=1e-6)
        assert in_openmm.evaluations_per_time == pytest.approx(core.evaluations_per_time)


def test_error_is_the_distance_from_the_reference(chain, result):
    # By hand, for one step size.
    dt = chain.time_steps[1]
    system = System(chain.motion, chain.potential.forces)
    state = run(system, State(chain.positions, chain.velocities), dt, round(chain.horizon / dt))
    wanted = np.sqrt(np.mean(np.sum((state.positions - chain.reference().positions) ** 2, axis=1)))
    assert result.of("rattle")[1].error == pytest.approx(wanted, rel=1e-9)


def test_costs_of_fixed_steps(chain, result):
    for m in result.of("rattle"):
        assert m.steps == m.steps_planned == round(result.scene["horizon"] / m.setting)
        # One force evaluation a step; a picosecond has 1000/dt steps.
        assert m.evaluations_per_time == pytest.approx(1000 / m.setting)
        assert m.seconds_per_time == pytest.approx(m.step_seconds * 1000 / m.setting)
        # Kicks, flights and constraints of few atoms are one call.
        assert m.constraint_seconds is None
    for m in result.of("ase-kcons"):
        assert 0 < m.constraint_seconds < m.step_seconds


def test_residuals_tell_the_methods_apart(spheres):
    for m in spheres.of("rattle"):
        assert m.constraint_residual < 1e-13
        assert m.velocity_residual < 1e-14
    # The projected equation of motion drifts off the surface.
    drift = [m.constraint_residual for m in spheres.of("dop853")]
    assert drift[0] > 1e-5
    assert drift[-1] > 1e-12
    assert drift == sorted(drift, reverse=True)


def test_adaptive_method_gets_better_with_its_tolerance(spheres):
    found = spheres.of("dop853")
    assert [m.error for m in found] == sorted((m.error for m in found), reverse=True)
    assert [m.evaluations_per_time for m in found] == sorted(m.evaluations_per_time for m in found)
    assert found[-1].error < 1e-7
    assert spheres.observed_order("dop853") is None


def test_baseline_states_no_error(result):
    for name in ("verlet", "ase-verlet"):
        (baseline, *_) = result.of(name, "baseline")
        assert baseline.error is None
        assert baseline.step_seconds > 0


@pytest.mark.parametrize("name", ["verlet", "ase-verlet"])
def test_baseline_repeats_its_first_step_for_one_evaluation_each(chain, name):
    baseline = methods.METHODS[name].start(chain, chain.time_steps[0])
    ends = []
    for _ in range(3):
        baseline.rewind()
        before = chain.potential.evaluations
        baseline.advance()
        assert chain.potential.evaluations == before + 1
        ends.append(baseline.positions)
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])
    assert baseline.time == pytest.approx(3 * chain.time_steps[0])
    # x + v dt + f dt^2/2m: nothing is held.
    dt = chain.time_steps[0]
    kick = chain.potential.forces(chain.positions) / chain.masses[:, None]
    expected = chain.positions + dt * chain.velocities + 0.5 * dt**2 * kick
    np.testing.assert_allclose(ends[0], expected, rtol=0, atol=1e-13)


def test_methods_that_cannot_hold_a_sphere_say_so(spheres):
    (refused,) = spheres.of("ase-bonds", "not run")
    assert "sphere" in refused.note
    assert spheres.of("rattle")


def test_a_step_that_is_too_long_does_not_rule_shorter_ones_out(chain, monkeypatch):
    """ASE's dynamics are refused at a step where they move atoms far off, which shorter steps do not."""
    from kcons.ase import respect

    monkeypatch.setattr(respect, "ABSURD", 1e-4)
    monkeypatch.setattr(respect, "_SMALL", 1e-4)
    found = measure.compare(chain.with_time_steps([10.0, 0.5]), methods=["ase-kcons"], budget=30).measurements
    assert [(m.setting, m.status) for m in found] == [(10.0, "failed"), (0.5, "ok")]
    assert "the time step is far too large" in found[0].note


def test_energy_slope_is_the_fit():
    system = test_systems.build("sphere", 2)
    log = measure._Log(times=[0.0, 1.0, 2.0, 3.0, 4.0], energies=[1.0, 3.0, 5.0, 7.0, 9.0])
    slope, error = measure._energy_slope(system, log)
    assert slope == pytest.approx(2.0 / system.motion.degrees_of_freedom)
    assert error == pytest.approx(0.0, abs=1e-12)
    log.energies = [0.0, 1.0, 0.0, 1.0, 0.0]
    slope, error = measure._energy_slope(system, log)
    assert abs(slope) < 2 * error


# -- budget and failures ----------------------------------------------------------------------------


class Slow(methods.CoreStepper):
    """A peer whose every step takes a while."""

    pause = 0.6

    def start(self, system, setting):
        started = super().start(system, setting)
        advance, pause = started.advance, self.pause

        def slowly():
            time.sleep(pause)
            advance()

        started.advance = slowly
        return started


class Broken(methods.CoreStepper):
    def start(self, system, setting):
        raise ConvergenceError("did not converge, as an example\nwith more lines")


def compare_with(monkeypatch, method, chain, **options):
    monkeypatch.setattr(methods, "METHODS", {method.name: method})
    return measure.compare(chain, **options)


def test_method_over_budget_is_stopped_after_one_step(monkeypatch, chain):
    result = compare_with(monkeypatch, Slow("slow", "slow one"), chain, budget=1.5)
    first, *others = result.measurements
    assert first.status == "partial"
    assert first.steps == 1
    assert first.error is None
    assert first.step_seconds >= 0.6
    assert "exceed the budget of 1.5 s" in first.note
    assert first.constraint_residual < 1e-13  # the state after that step is known
    assert [m.status for m in others] == ["not run"] * 3


def test_method_that_does_not_come_back_is_interrupted(monkeypatch, chain):
    method = Slow("slow", "slow one")
    monkeypatch.setattr(Slow, "pause", 30.0)
    begun = time.perf_counter()
    (only,) = compare_with(monkeypatch, method, chain, budget=0.2).measurements
    assert time.perf_counter() - begun < 20
    assert only.status == "partial"
    assert only.steps == 0
    assert "step 1 was not done" in only.note


def test_failure_of_a_method_is_a_result(monkeypatch, chain):
    result = compare_with(monkeypatch, Broken("broken", "broken one"), chain)
    assert {m.status for m in result.measurements} == {"failed"}
    assert result.measurements[0].note == "step 1: ConvergenceError: did not converge, as an example"


def test_runaway_trajectory_is_a_failure(monkeypatch, chain):
    class Runaway(methods.CoreStepper):
        def start(self, system, setting):
            started = super().start(system, setting)
            advance = started.advance

            def away():
                advance()
                started._state = replace(started._state, positions=np.full_like(system.positions, np.nan))

            started.advance = away
            return started

    result = compare_with(monkeypatch, Runaway("away", "runaway"), chain)
    assert {m.status for m in result.measurements} == {"failed"}
    assert not any(m.error for m in result.measurements)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"methods": ["shake"]}, "there is no method 'shake' .did you mean 'shake-1e-[0-9]*'.*; there are rattle"),
        ({"budget": 0}, "positive number of seconds"),
        ({"budget": float("nan")}, "positive number of seconds"),
    ],
)
def test_bad_arguments(chain, options, text):
    with pytest.raises(InputError, match=text):
        measure.compare(chain, **options)


# -- every small test system ------------------------------------------------------------------------------------

PIVOT, SURFACE, TIME = "the pivot is a point", "ASE has no constraint that holds an atom on", "cannot move"
REFUSED = {
    "butane": {},
    "dumbbells": {},
    "rotor": {},
    "tennis-racket": {},
    "pendulum": {"ase-bonds": PIVOT, "ase-internals": PIVOT},
    "double-pendulum": {"ase-bonds": PIVOT, "ase-internals": PIVOT},
    "triple-pendulum": {"ase-bonds": PIVOT, "ase-internals": PIVOT},
    "bead-ellipse": {"ase-bonds": SURFACE, "ase-internals": SURFACE},
    "bead-rotating": {"ase-kcons": TIME, "ase-bonds": TIME, "ase-internals": TIME},
    "bead-torus": {"ase-bonds": SURFACE, "ase-internals": SURFACE},
    "slab": {},
}


COMPOSED = ("suzuki4", "kahan-li6", "blanes-moan4", "blanes-moan6")


#: Nothing is refused of these either: bodies and rows as of the rotor and of butane, which a usual run has.
LIKE_OTHERS = ("dumbbells", "tennis-racket")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.validation) if n in LIKE_OTHERS else n for n in REFUSED]
)
def test_quick_comparison(name):
    system = test_systems.build(name, quick=True)
    if name in ("bead-ellipse", "bead-torus"):
        system = system.shortened(3)  # nothing is compiled on these surfaces
    steps = system.time_steps[:2]
    result = measure.compare(replace(system, time_steps=steps), budget=60)
    refused = {m.method: m.note for m in result.measurements if m.status == "not run" and m.setting == 0}
    assert refused.keys() == REFUSED[name].keys()
    for method, text in REFUSED[name].items():
        assert text in refused[method]
    # Compositions take their longest steps where RATTLE takes a ninth of them.
    for m in result.measurements:
        assert m.status != "failed" or (m.method in COMPOSED and "time step too large" in m.note)
    for name in COMPOSED:
        errors = [m.error for m in result.of(name)]
        assert errors == sorted(errors, reverse=True)
    plain = result.of("rattle")
    assert len(plain) == len(steps)
    assert result.observed_order("rattle") == pytest.approx(2.0, abs=0.2)
    for m in plain:
        assert m.constraint_residual < 1e-12
        assert m.velocity_residual < 1e-12
        assert m.evaluations_per_time == pytest.approx(system.units.long_time_unit / system.units.time_unit / m.setting)
    for core, in_openmm in zip(plain, result.of("ase-kcons"), strict="ase-kcons" not in refused):
        assert in_openmm.error == pytest.approx(core.error, rel=1e-5)
    # The projected equation, at its tightest tolerance, is closer than RATTLE.
    assert result.of("dop853")[-1].error < 0.1 * plain[-1].error
    assert result.reference["error"] < 1e-3 * plain[-1].error


# -- environment ------------------------------------------------------------------------------------


def test_environment_names_machine_and_versions():
    found = measure.environment()
    assert found["cpu"]
    assert found["cores"] >= 1
    assert found["versions"]["numpy"] == np.__version__
    assert found["commit"] is None or len(found["commit"].rstrip("+")) == 40


def test_kernels_are_looked_for_where_they_are_cached(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not measure.kernels_cached()
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "kernel.nbi").touch()
    assert measure.kernels_cached()


def test_watcher_hears_of_everything(chain):
    class Listener(measure.Watcher):
        def __init__(self):
            self.heard, self.open = [], 0

        def begin(self, what, total):
            self.heard.append(what)
            self.open += 1

        def advance(self, done):
            assert self.open == 1

        def end(self):
            self.open -= 1

    listener = Listener()
    measure.compare(chain, methods=["rattle"], watcher=listener)
    assert listener.open == 0
    assert "kernels" in listener.heard[0]
    assert listener.heard[1] == "reference solution"
    assert len(listener.heard) == 2 + len(chain.time_steps)


def test_first_steps_that_grow_are_no_measure_of_the_time():
    """Multistep begins with steps of 1e-6: at that length they would take ten times the budget."""
    test_system = replace(test_systems.build("dumbbells"), tolerances=(1e-10,))
    (found,) = measure.compare(test_system, methods=["multistep"], budget=10.0).of("multistep")
    assert found.status == "ok" and found.error < 1e-8 and 300 < found.steps < 600
