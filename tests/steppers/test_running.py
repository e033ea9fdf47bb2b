"""Steps one after another: who looks, what is recorded, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_systems import rotor

from kcons.errors import InputError
from kcons.steppers import BlanesMoan4, Rattle, State, System, run
from kcons.thermostats import Langevin


def test_observers_see_start_and_every_kth_step() -> None:
    system, state = rotor()
    seen: list[int] = []
    run(system, state, 0.01, 10, observers=[lambda s: seen.append(s.step)], every=4)
    assert seen == [0, 4, 8]


IMPOSSIBLE = [{"time": np.nan}, {"time": -np.inf}, {"time": 1j}, {"time": "a"}, {"time_remainder": np.nan}]
IMPOSSIBLE += [{"step": step} for step in (-3, 2.5, True, None)]


@pytest.mark.parametrize("impossible", IMPOSSIBLE, ids=str)
@pytest.mark.parametrize("stepper", [None, BlanesMoan4(), Langevin(1.0, 1.0, rng=1)], ids=str)
def test_states_made_by_hand_with_impossible_numbers(stepper, impossible) -> None:
    """In a run, which shows them to nobody, and in a step by itself."""
    system, state = rotor()
    wrong, seen = State(state.positions, state.velocities, **impossible), []
    (item,) = impossible
    with pytest.raises(InputError, match=f"^{item} is .*; give a") as caught:
        run(system, wrong, 0.1, 2, stepper=stepper, observers=[seen.append])
    assert caught.value.item == item and not seen
    with pytest.raises(InputError, match=f"^{item} is"):
        run(system, wrong, 0.1, 0, stepper=stepper)
    with pytest.raises(InputError, match=f"^{item} is"):
        (stepper or Rattle()).step(system, wrong, 0.1)


# -- trajectories -----------------------------------------------------------------------------------


@pytest.mark.parametrize("stepper", [None, BlanesMoan4()], ids=repr)
def test_frames_are_states_of_the_run(stepper):
    system, state = rotor()
    seen: list = []
    found = run(system, state, 0.01, 10, stepper=stepper, observers=[seen.append], every=2, record=4)
    assert [frame.step for frame in found.frames] == [0, 4, 8]
    np.testing.assert_array_equal(found.times, [seen[k].time for k in (0, 2, 4)])
    np.testing.assert_array_equal(found.positions, [seen[k].positions for k in (0, 2, 4)])
    np.testing.assert_array_equal(found.velocities, [seen[k].velocities for k in (0, 2, 4)])
    assert found.positions.shape == (3, *state.positions.shape)
    alone = run(system, state, 0.01, 10, stepper=stepper)
    assert found.last.step == 10
    np.testing.assert_array_equal(found.last.positions, alone.positions)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_frames_of_a_run_that_stops_are_kept(error):
    system, state = rotor()

    def forces(x, t):
        if t > 0.065:
            raise error
        return np.zeros_like(x)

    with pytest.raises(error) as raised:
        run(System(system.motion, forces), state, 0.01, 10, record=2)
    assert [frame.step for frame in raised.value.trajectory.frames] == [0, 2, 4, 6]


def test_what_raises_at_the_first_state_has_a_trajectory_too() -> None:
    def refuses(state: State) -> None:
        raise KeyError("first")

    system, state = rotor()
    with pytest.raises(KeyError) as raised:
        run(system, state, 0.01, 3, observers=[refuses], record=1)
    assert raised.value.trajectory.frames == []
