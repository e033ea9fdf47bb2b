"""Every stepper of a registry becomes a method; methods say what they cannot run."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from kcons import steppers
from kcons.comparison import test_systems
from kcons.comparison.methods import methods
from kcons.comparison.methods.method import Method
from kcons.comparison.work_precision import measure, report
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import Rattle, State


class Triple:
    """Yoshida's composition of RATTLE: order 4."""

    order, reversible, symplectic, force_evaluations = 4, True, True, 3
    ends = 1 / (2 - 2 ** (1 / 3))

    def check(self, system):
        pass

    def step(self, system, state, dt):
        for share in (self.ends, 1 - 2 * self.ends, self.ends):
            state = Rattle().step(system, state, share * dt)
        return state


class KahanLi6(Triple):
    """Named like one of the usual ones."""


class Euler:
    """Needs the forces where a step begins, and leaves the end without them."""

    order, reversible, symplectic, force_evaluations = 1, False, False, 1

    def check(self, system):
        pass

    def step(self, system, state, dt):
        x, v, motion = state.positions, state.velocities, system.motion
        kick = dt * system.forces(x, v, state.time, 0) * system.inverse_masses
        v = motion.project_velocities(x, v + kick)
        following = motion.project_positions(x + dt * v, x)
        return State(following, motion.project_velocities(following, v), state.time + dt)


class Feedback(Triple):
    def __init__(self, rate):
        self.rate = rate


class Unable(Triple):
    def check(self, system):
        raise UnsupportedError("no such constraints here; use Rattle")


NAMED = {
    "rattle": Rattle,
    "geodesic": steppers.Geodesic,
    "suzuki4": steppers.Suzuki4,
    "yoshida4": steppers.Yoshida4,
    "kahan-li6": steppers.KahanLi6,
    "blanes-moan4": steppers.BlanesMoan4,
    "blanes-moan6": steppers.BlanesMoan6,
    "blanes-moan6a": steppers.BlanesMoan6a,
    "projected-verlet": steppers.ProjectedVerlet,
    "projected-rk4": steppers.ProjectedRungeKutta4,
    "baumgarte": steppers.Baumgarte,
}


@pytest.fixture
def pendulum():
    return test_systems.build("double-pendulum")


def test_every_stepper_is_a_method():
    # A stepper that is added to the package and not here is missed.
    concrete = {
        item
        for name, item in vars(steppers).items()
        if isinstance(item, type) and hasattr(item, "force_evaluations") and not name.startswith("_")
    } - {steppers.Stepper, steppers.Splitting, steppers.Composition, steppers.RungeKuttaNystrom}
    assert concrete == set(NAMED.values())
    for name, kind in NAMED.items():
        assert type(methods.METHODS[name].stepper) is kind


@functools.cache
def on_dependent_rows():
    """Of 21 rows, 19 are independent; with one reference for all methods."""
    system = test_systems.build("ethanol", forces="emt").shortened(4)
    return measure.compare(system.with_time_steps([0.5, 0.25]), methods=list(NAMED))


@pytest.mark.parametrize("name", NAMED)
def test_every_stepper_runs_dependent_rows_and_finds_the_trajectory(name):
    found = on_dependent_rows().of(name)
    assert [m.status for m in found] == ["ok", "ok"]
    assert found[-1].error < 1e-4


def test_steppers_have_names_and_titles():
    found = methods.of_steppers({"rattle": Rattle, "kahan-li6": KahanLi6, "triple": Triple})
    assert [m.name for m in found] == ["rattle", "kahan-li6", "triple"]
    assert [m.title for m in found] == ["kcons RATTLE", "kcons KahanLi6", "kcons Triple"]
    assert [m.usual for m in found] == [True, True, False]


def test_steps_cost_as_much_as_those_of_rattle(pendulum):
    for m in methods.of_steppers({"triple": Triple, "euler": Euler}):
        steps = m.settings(pendulum)
        s = m.stepper.force_evaluations
        np.testing.assert_allclose(steps, s * np.array(pendulum.time_steps), rtol=0.02)
        counts = pendulum.horizon / np.array(steps)
        np.testing.assert_allclose(counts, np.round(counts), rtol=1e-12)
    assert methods.METHODS["rattle"].settings(pendulum) == pytest.approx(pendulum.time_steps)
    # At least two steps, and no step twice.
    few = pendulum.with_time_steps([2.5, 5.0])
    (triple,) = methods.of_steppers({"triple": Triple})
    assert triple.settings(few) == pytest.approx([2.5, 1.25])


def test_rate_of_a_feedback_goes_with_the_step(pendulum):
    (found,) = methods.of_steppers({"feedback": Feedback})
    assert found.start(pendulum, 0.05)._stepper.rate == pytest.approx(2.0)
    assert found.stepper.order == 4


def registered(monkeypatch, *kinds):
    found = {m.name: m for m in methods.of_steppers({kind.__name__.lower(): kind for kind in kinds})}
    monkeypatch.setattr(methods, "METHODS", {**methods.METHODS, **found})


def test_registered_stepper_is_compared(monkeypatch, pendulum, tmp_path):
    registered(monkeypatch, Triple)
    result = measure.compare(pendulum.with_time_steps([0.0125, 0.00625]), methods=["rattle", "triple"])
    assert result.observed_order("rattle") == pytest.approx(2.0, abs=0.1)
    assert result.observed_order("triple") == pytest.approx(4.0, abs=0.15)
    for plain, high in zip(result.of("rattle"), result.of("triple"), strict=True):
        assert high.evaluations_per_time == pytest.approx(3 / high.setting)
        assert high.evaluations_per_time == pytest.approx(plain.evaluations_per_time, rel=0.02)
    assert result.of("triple")[-1].error < 0.1 * result.of("rattle")[-1].error
    report.figure(result).savefig(tmp_path / "x.png")


def test_what_a_stepper_does_not_support_is_not_run(monkeypatch, pendulum):
    registered(monkeypatch, Unable)
    (only,) = measure.compare(pendulum, methods=["unable"]).measurements
    assert only.status == "not run"
    assert only.note == "no such constraints here; use Rattle"


def test_usual_methods_and_all(monkeypatch):
    registered(monkeypatch, Triple, KahanLi6)
    usual = [m.name for m in methods.chosen()]
    assert "triple" not in usual
    assert {"rattle", "kahan-li6", "ase-kcons", "dop853", "verlet"} <= set(usual)
    assert methods.chosen(["all"]) == list(methods.METHODS.values())
    with pytest.raises(InputError, match="there is no method 'all'"):
        methods.chosen(["all", "rattle"])


def test_md_engines_fix_the_atoms_of_the_slab():
    system = test_systems.build("slab")
    for name in ("ase-bonds", "ase-internals", "ase-kcons"):
        run = methods.METHODS[name].start(system, system.time_steps[0])
        run.advance()
        moved = np.abs(run.positions - system.positions).max(axis=1) > 0
        assert not moved[system.fixed].any()
        assert np.delete(moved, system.fixed).all()
        assert run.constraints.seconds > 0


@pytest.mark.parametrize("name", ["triple-pendulum", "rotor", "bead-rotating"])
def test_projected_dop853_costs_no_more_forces_and_stays_on_the_constraints(name):
    # Along a constraint that moves, too.
    system = test_systems.build(name)
    found = measure.compare(system, methods=["dop853", "dop853-projected"])
    for free, held in zip(found.of("dop853"), found.of("dop853-projected"), strict=True):
        assert held.evaluations_per_time == pytest.approx(free.evaluations_per_time, rel=0.05)
        assert held.error < free.error
        assert held.constraint_residual < 1e-14
        assert held.velocity_residual < 1e-14
    errors = [m.error for m in found.of("dop853-projected")]
    assert errors[0] > 100 * errors[1] > 1e4 * errors[2]


def test_what_has_kernels_loads_them_before_the_clock_starts():
    for method in methods.METHODS.values():
        if "kcons" in method.title and method.md_engine in ("kcons", "ase") and method.marches:
            assert type(method).warm_up is not Method.warm_up, method.name
