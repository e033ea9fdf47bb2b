"""Steps one after another: who looks, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_systems import (
    NYSTROM,
    rotor,
    system_of,
)

from kcons.constraints import Angle, Distance
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import (
    BlanesMoan4,
    Rattle,
    ReversibilityCheck,
    State,
    System,
    Trajectory,
    run,
)
from kcons.thermostats import Langevin


def molecule(force=None) -> tuple[System, State]:
    """A bent molecule and a free atom, tied by springs."""
    rng = np.random.default_rng(4)
    x = np.array([[1.0, 0.1, 0.0], [0.0, 0.0, 0.0], [-0.9, 0.3, 0.2], [0.4, 1.5, 0.3]])
    system = system_of([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], x, [1.0, 3.0, 2.0, 1.5], force or springs)
    return system, system.initial_state(x, 0.3 * rng.normal(size=(4, 3)), project=True)


def springs(x: np.ndarray, t: float) -> np.ndarray:
    """Between all pairs; independent of origin, orientation and order of the atoms."""
    d = x[:, None] - x[None]
    return -np.sum(d * (1 - 0.5 / (1 + np.sum(d**2, axis=-1, keepdims=True))), axis=1)


def test_observers_see_start_and_every_kth_step() -> None:
    system, state = rotor()
    seen: list[int] = []
    run(system, state, 0.01, 10, observers=[lambda s: seen.append(s.step)], every=4)
    assert seen == [0, 4, 8]


@pytest.mark.parametrize(("steps", "every"), [(-1, 1), (3, 0)])
def test_bad_run_arguments(steps, every) -> None:
    system, state = rotor()
    with pytest.raises(InputError, match="whole number"):
        run(system, state, 0.1, steps, every=every)


@pytest.mark.parametrize(
    "item, value",
    [
        ("dt", "0.1"),
        ("dt", None),
        ("dt", [0.1]),
        ("state", None),
        ("system", None),
        ("stepper", Rattle),
        ("observers", print),
        ("observers", [3]),
    ],
)
def test_what_is_no_system_state_time_or_stepper(item, value) -> None:
    system, state = rotor()
    given = {"system": system, "state": state, "dt": 0.1, "steps": 1} | {item: value}
    with pytest.raises(InputError, match=f"{item} is .*give") as caught:
        run(**given)
    assert caught.value.item == item


IMPOSSIBLE = [{"time": np.nan}, {"time": -np.inf}, {"time": 1j}, {"time": "a"}, {"time_remainder": np.nan}]
IMPOSSIBLE += [{"step": step} for step in (-3, 2.5, True, None)]


@pytest.mark.parametrize("impossible", IMPOSSIBLE, ids=str)
@pytest.mark.parametrize("stepper", [None, BlanesMoan4(), Langevin(1.0, 1.0, seed=1)], ids=str)
def test_states_made_by_hand_with_impossible_numbers(stepper, impossible) -> None:
    """In a run, which shows them to nobody, and in a step by itself."""
    system, state = rotor()
    wrong, seen = State(state.positions, state.velocities, **impossible), []
    (item,) = impossible
    with pytest.raises(InputError, match=f"^{item} is .*; give a") as caught:
        run(system, wrong, 0.1, 2, stepper=stepper, observers=[seen.append])
    assert caught.value.item == item and not seen
    with pytest.raises(InputError, match=f"^{item} is"):
        (stepper or Rattle()).step(system, wrong, 0.1)


def test_run_uses_rattle_unless_told() -> None:
    system, state = molecule()
    assert np.array_equal(
        run(system, state, 0.02, 10).positions, run(system, state, 0.02, 10, stepper=Rattle()).positions
    )


@pytest.mark.parametrize("stepper", NYSTROM, ids=repr)
def test_unsupported_forces_are_refused_before_the_first_observer(stepper) -> None:
    system, state = rotor(force=lambda x, v, t: -v, velocity_dependent=True)
    seen: list[State] = []
    for attempt in (
        lambda: run(system, state, 0.1, 1, stepper=stepper, observers=[seen.append]),
        lambda: run(system, state, 0.1, 0, stepper=ReversibilityCheck(stepper), observers=[seen.append]),
        lambda: stepper.step(system, state, 0.1),
    ):
        with pytest.raises(UnsupportedError, match="use Suzuki4 or KahanLi6"):
            attempt()
    assert not seen


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
    assert found[1] is found.frames[1] and len(found) == 3
    assert repr(found) == "Trajectory(3 frames, t = 0 to 0.08)"


def test_it_is_an_observer_as_well():
    system, state = rotor()
    mine = Trajectory()
    assert repr(mine) == "Trajectory(no frames)"
    with pytest.raises(IndexError, match="no frames"):
        _ = mine.last
    run(system, state, 0.01, 4, observers=[mine], every=2)
    assert len(mine) == 3 and mine.last.step == 4


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


@pytest.mark.parametrize("record", [0, -1])
def test_bad_rhythm(record):
    system, state = rotor()
    with pytest.raises(InputError, match=f"record is {record}; give a whole number, 1 or more"):
        run(system, state, 0.01, 10, record=record)


def test_what_raises_at_the_first_state_has_a_trajectory_too() -> None:
    def refuses(state: State) -> None:
        raise KeyError("first")

    system, state = molecule()
    with pytest.raises(KeyError) as raised:
        run(system, state, 0.01, 3, observers=[refuses], record=1)
    assert len(raised.value.trajectory) == 0
