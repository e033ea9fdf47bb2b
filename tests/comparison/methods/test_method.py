"""Time that is counted for a method, and its end."""

from __future__ import annotations

import time

import numpy as np
import pytest

from kcons.comparison import test_systems
from kcons.comparison.methods import method as runs
from kcons.comparison.methods import methods
from kcons.comparison.work_precision import measure
from kcons.constraints.compilation import announcer
from kcons.steppers import State


def test_stopwatch_counts_nested_calls_once():
    class Object:
        def outer(self):
            self.inner()

        def inner(self):
            time.sleep(0.01)

    watch, thing = runs.Stopwatch(), Object()
    watch.watch(thing, ("outer", "inner", "absent"))
    start = time.perf_counter()
    thing.outer()
    elapsed = time.perf_counter() - start
    assert 0.01 <= watch.seconds <= elapsed


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


@pytest.fixture
def pendulum():
    return test_systems.build("double-pendulum")


def registered(monkeypatch, *kinds):
    found = {m.name: m for m in methods.of_steppers({kind.__name__.lower(): kind for kind in kinds})}
    monkeypatch.setattr(methods, "METHODS", {**methods.METHODS, **found})


def test_onlookers_do_not_save_a_stepper_its_evaluations(monkeypatch, pendulum):
    registered(monkeypatch, Euler)
    result = measure.compare(pendulum, methods=["euler"])
    for m in result.of("euler"):
        # The forces at the start are in place; between steps the energy is written down, which must not help.
        assert m.evaluations_per_time * result.scene["horizon"] == pytest.approx(m.steps - 1)


def test_energies_are_read_without_being_counted(pendulum):
    potential = test_systems.build("butane").potential
    x = test_systems.build("butane").positions
    potential.forget()
    potential.forces(x)
    assert potential.watched_energy(x) == potential.energy(x)
    assert potential.watched_energy(x + 0.1 * np.eye(4, 3)) != potential.energy(x)
    assert potential.evaluations == 1
    potential.forces(x)
    assert potential.evaluations == 1


def test_interrupted_when_the_time_is_up():
    begun = time.perf_counter()
    with pytest.raises(runs.OverBudgetError, match=r"not done after 0\.1 s"), runs.interrupted_after(0.1):
        time.sleep(20)
    assert 0.1 <= time.perf_counter() - begun < 10
    with runs.interrupted_after(0.1):
        pass
    time.sleep(0.2)  # nothing rings any more


def test_a_kernel_that_is_being_compiled_is_waited_for():
    """Interrupted, it would begin again with the next step, and never be done."""
    done = []
    with pytest.raises(runs.OverBudgetError), runs.interrupted_after(0.1):
        announcer.begin()
        try:
            for _ in range(10):
                time.sleep(0.03)
            done.append("compiled")
        finally:
            announcer.end()
        time.sleep(20)
    assert done == ["compiled"]
