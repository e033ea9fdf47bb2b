"""Steps that are taken back: what is remembered, and what is seen."""

from __future__ import annotations

import numpy as np
import pytest
from monte_carlo_systems import trap, trap_potential, trimer
from thermostat_systems import dumbbells

from kcons.errors import ConvergenceError, ReversibilityError
from kcons.steppers import BlanesMoan4, BlanesMoan6a, Geodesic, Rattle, State, Suzuki4, System
from kcons.thermostats import thermal_velocities
from kcons.thermostats.monte_carlo.hamiltonian_monte_carlo import ReversedSteps


@pytest.mark.parametrize("stepper", [Rattle(), Geodesic(3), Suzuki4(), BlanesMoan4(), BlanesMoan6a()], ids=repr)
def test_the_way_back_costs_no_force_and_the_step_is_the_stepper_s(stepper):
    held, x = dumbbells(2)
    calls = []
    counted = System(held.motion, lambda x, t: (calls.append(1), held.force(x, t))[1], potential=held.potential)
    state = counted.with_forces(State(x, thermal_velocities(held, x, 0.5, 4)))
    steps = ReversedSteps(counted, stepper, 1e-9)
    for k in range(1, 4):
        calls.clear()
        state = steps.step(counted, state, 0.1)
        # A stepper that ends with a drift does not know the forces at its end.
        assert len(calls) == stepper.force_evaluations, k
    plain = State(x, thermal_velocities(held, x, 0.5, 4))
    for _ in range(3):
        plain = stepper.step(held, plain, 0.1)
    assert np.array_equal(plain.positions, state.positions) and np.array_equal(plain.velocities, state.velocities)


def test_forces_that_differ_on_the_way_back_are_not_remembered():
    """Where the way back leads elsewhere, the force is asked for there."""
    held, state = trimer(trap, trap_potential)
    steps = ReversedSteps(held, Rattle(), 1e-9)
    steps._known = [(state.positions, np.ones((3, 3)))]
    steps._back, steps._near = True, 1e-9
    assert np.array_equal(steps._force(state.positions + 1e-10, 0.0), np.ones((3, 3)))
    assert np.array_equal(steps._force(state.positions + 1e-8, 0.0), trap(state.positions + 1e-8))


class Skewed(Rattle):
    """A step that is not undone by the step back."""

    def step(self, system, state, dt):
        after = super().step(system, state, dt)
        return State(after.positions, after.velocities + 1e-6, after.time, after.forces, after.step)


class Stuck(Rattle):
    """A step that has no way back."""

    def step(self, system, state, dt):
        if dt < 0:
            raise ConvergenceError("no solution")
        return super().step(system, state, dt)


@pytest.mark.parametrize(("stepper", "words"), [(Skewed(), "misses its start by"), (Stuck(), "cannot be taken back")])
def test_what_cannot_be_taken_back_is_seen(stepper, words):
    held, x = dumbbells(2)
    state = State(x, thermal_velocities(held, x, 0.5, 4))
    with pytest.raises(ReversibilityError, match=words):
        ReversedSteps(held, stepper, 1e-9).step(held, state, 0.05)
