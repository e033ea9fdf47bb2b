"""Friction of the system: exact where it can be, of the order of the stepper elsewhere, stable however strong."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from stepper_systems import SYMMETRIC, gravity, slope, system_of

from kcons.constraints import Distance, FixedAtoms, KnifeEdge, LinearVelocity, MovingTarget, Sphere
from kcons.errors import InputError
from kcons.steppers import (
    BlanesMoan6,
    BlanesMoan6a,
    Geodesic,
    KahanLi6,
    Rattle,
    State,
    System,
    run,
)

MASSES = np.array([1.0, 2.0, 0.5])
RATE = 0.8


def pendulum(friction: float = RATE, moving: bool = False, by_force: bool = False) -> tuple[System, State]:
    """A double pendulum in three dimensions; the first rod at rest, or growing and shrinking."""
    x = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, -0.8], [1.4, 0.0, -0.2]])
    swing = MovingTarget(lambda t: 1 + 0.2 * np.sin(t), lambda t: 0.2 * np.cos(t), lambda t: -0.2 * np.sin(t))
    rows = [FixedAtoms([0]), Distance([0, 1], swing if moving else None), Distance([1, 2])]
    weight = np.outer(MASSES, [0.0, 0.3, -1.0])
    drag = friction * MASSES[:, None]
    if by_force:
        force = lambda x, v, t: weight - 0.2 * x - drag * v  # noqa: E731
        system = system_of(rows, x, MASSES, force, velocity_dependent=True)
    else:
        system = system_of(rows, x, MASSES, lambda x, t: weight - 0.2 * x, friction=friction)
    v = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.2, 0.4, 0.1]]
    return system, system.initial_state(x, v, project=True)


@cache
def solution(moving: bool) -> np.ndarray:
    """Positions and velocities at t = 1, with friction as a force that depends on velocities."""
    system, start = pendulum(moving=moving, by_force=True)
    end = run(system, start, 1 / 40, 40, stepper=KahanLi6())
    return np.stack([end.positions, end.velocities])


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "moving"])
@pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)
def test_every_stepper_keeps_its_order(stepper, moving: bool) -> None:
    system, start = pendulum(moving=moving)
    counts = {2: (8, 32), 4: (4, 8), 6: (2, 4)}[stepper.order]
    errors = []
    for n in counts:
        end = run(system, start, 1 / n, n, stepper=stepper)
        errors.append(np.abs(np.stack([end.positions, end.velocities]) - solution(moving)).max())
    assert min(errors) > 1e-12  # above what the solution itself is good to
    assert slope(1 / np.array(counts), errors) == pytest.approx(stepper.order, abs=0.35)


# -- exact ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stepper", [Rattle(), Geodesic(), KahanLi6(), BlanesMoan6(), BlanesMoan6a()], ids=repr)
def test_free_flight_is_exact_at_any_step(stepper) -> None:
    """x = x0 + v0 (1 - exp(-gamma t))/gamma; a free atom, one on a sphere, and one that is fixed."""
    x = np.array([[0.3, 0.1, 0.0], [0.0, 1.0, 0.0], [5.0, 5.0, 5.0]])
    v = np.array([[1.0, -2.0, 0.5], [1.4, 0.0, 0.0], [0.0, 0.0, 0.0]])
    system = system_of([Sphere(1, np.zeros(3), 1.0), FixedAtoms([2])], x, [1.0, 3.0, 0.0], friction=0.7)
    dt, steps = 1.3, 3
    way, left = (1 - np.exp(-0.7 * dt * steps)) / 0.7, np.exp(-0.7 * dt * steps)
    great_circles = stepper.exact_flight
    if not great_circles:  # flights along a sphere by RATTLE are of order 2
        v[1] = 0.0
    end = run(system, system.initial_state(x, v), dt, steps, stepper=stepper)
    np.testing.assert_allclose(end.positions[0], x[0] + way * v[0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(end.velocities[0], left * v[0], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(end.positions[2], x[2])
    if great_circles:
        angle = 1.4 * way
        np.testing.assert_allclose(end.positions[1], [np.sin(angle), np.cos(angle), 0.0], rtol=0, atol=1e-13)
        assert np.linalg.norm(end.velocities[1]) == pytest.approx(1.4 * left, rel=1e-13)


@pytest.mark.parametrize("strength", [0.01, 1.0, 100.0])
def test_a_body_sinks_as_fast_as_it_should_however_strong_the_friction(strength: float) -> None:
    """Under a steady force the way of a step is f dt/(m gamma), also where friction times the step is large."""
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    masses = np.array([1.0, 4.0])
    dt = 0.5
    rate = strength / dt
    system = system_of([Distance([0, 1])], x, masses, gravity(masses, (0.0, 0.0, -2.0)), friction=rate)
    start = system.initial_state(x)
    settled = run(system, start, dt, int(40 / min(strength, 1.0)))
    after = run(system, settled, dt, 1)
    np.testing.assert_allclose((after.positions - settled.positions)[:, 2], -2.0 * dt / rate, rtol=1e-12)


# -- what it goes together with ---------------------------------------------------------------------


@pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)
def test_a_step_can_be_taken_back(stepper) -> None:
    system, start = pendulum(moving=True)
    back = stepper.step(system, stepper.step(system, start, 0.2), -0.2)
    np.testing.assert_allclose(back.positions, start.positions, rtol=0, atol=3e-14)
    np.testing.assert_allclose(back.velocities, start.velocities, rtol=0, atol=3e-14)


@pytest.mark.parametrize("stepper", [Rattle(), Geodesic(3)], ids=repr)
def test_rows_of_velocities_keep_order_and_way_back(stepper) -> None:
    """A blade whose contact is driven sideways: its rows hold at the middle of the time, not of the flight."""
    x = np.array([[-0.5, 0.0, 0.0], [0.6, 0.1, 0.0]])
    blade = KnifeEdge([0], [1], [0, 0, 1], contact=0.4, target=lambda t: 0.3 * np.cos(2 * t))
    lift = LinearVelocity(0, [[0, 0, 1]], target=lambda t: 0.2 * t)
    masses = np.array([1.0, 2.0])
    system = system_of([Distance([0, 1]), blade, lift], x, masses, gravity(masses, (0.7, 0.2, -0.1)), friction=0.9)
    start = system.initial_state(x, [[0.4, -0.3, 0.0], [0.4, 0.5, 0.0]], project=True)
    ends = [run(system, start, 0.8 / n, n, stepper=stepper) for n in (4, 8, 16)]
    far, near = (np.abs(a.positions - b.positions).max() for a, b in zip(ends[1:], ends, strict=False))
    assert np.log2(far / near) == pytest.approx(2, abs=0.3)
    back = run(system, ends[0], -0.2, 4, stepper=stepper)
    np.testing.assert_allclose(back.positions, x, rtol=0, atol=1e-13)


# -- refusals ---------------------------------------------------------------------------------------


def test_a_step_that_leaves_nothing_is_refused() -> None:
    system, start = pendulum(1e4)
    with pytest.raises(InputError, match="use a shorter step"):
        Rattle().step(system, start, 1.0)
