"""A bead on a curve that turns."""

from __future__ import annotations

from small_test_systems import end, small


def test_moving_constraint_is_followed_in_time():
    scene = small("bead-rotating")
    state = end(scene, scene.time_steps[-1])
    assert scene.residuals(state.positions, state.velocities, scene.horizon) < (1e-12, 1e-12)
    assert scene.residuals(state.positions, state.velocities)[0] > 0.1
