"""A bead on a curve that turns."""

from __future__ import annotations

from small_test_systems import end, small


def test_moving_constraint_is_followed_in_time():
    system = small("bead-rotating")
    state = end(system, system.time_steps[-1])
    assert system.residuals(state.positions, state.velocities, system.horizon) < (1e-12, 1e-12)
    assert system.residuals(state.positions, state.velocities)[0] > 0.1
