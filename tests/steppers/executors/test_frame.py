"""What a step counts from."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import State, System
from kcons.steppers.executors.frame import Frame


def far(at: float) -> tuple[System, State]:
    x = np.array([[0.0, 0.0, 0.0], [1.0 / 3.0, 0.2, 0.1], [2.0, 0.7, 0.3]]) + at
    system = System(Motion(ConstraintSet([Distance([[1, 2]])], x, np.ones(3)), x))
    return system, system.initial_state(x, np.zeros_like(x))


@pytest.mark.parametrize("at", [0.0, 1e7])
def test_a_step_of_no_operations_ends_where_it_began(at) -> None:
    system, state = far(at)
    assert (state.remainder is not None) == (at > 0)
    frame = Frame(system, state, 0.1)
    end = frame.closed(frame.x, frame.v, None)
    assert np.array_equal(end.positions, state.positions)
    assert (end.remainder is None) == (state.remainder is None)
    if state.remainder is not None:
        np.testing.assert_allclose(end.remainder, state.remainder, rtol=0, atol=1e-16)
        # Relative to the anchor, with all digits.
        assert np.array_equal(frame.x[system.anchor], state.remainder[system.anchor])
        assert abs(np.linalg.norm(frame.x[1] - frame.x[2]) - system.motion.constraint_set.target(0.0)[0]) <= 1e-15
    assert np.array_equal(frame.whole(frame.x), state.positions)
    assert system.last is end and end.step == 1 and end.time == 0.1


def test_times_within_a_step_are_exact() -> None:
    system, state = far(0.0)
    state = State(state.positions, state.velocities, 1e8, time_remainder=3e-9)
    frame = Frame(system, state, 1e-7)
    assert (frame.time, frame.left_over) == state.later(1e-7)
    assert frame.at(1.0) == frame.time
    assert frame.at(0.5) == 1e8 + (0.5e-7 + 3e-9) > 1e8
    end = frame.closed(frame.x, frame.v, None)
    assert (end.time, end.time_remainder) == state.later(1e-7)


def test_remainders_that_begin_here() -> None:
    system, state = far(0.0)
    frame = Frame(system, state, 0.1)
    low = np.full_like(frame.x, 1e-18)
    thermostat = np.array([2.0])
    end = frame.closed(frame.x, frame.v, frame.v, thermostat, low)
    assert end.remainder is low and end.thermostat is thermostat and end.forces is frame.v
