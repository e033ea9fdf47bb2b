"""Compositions: conditions on the fractions, order with rows that move, velocity rows and friction."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, GlobalError, named, observed_order
from stepper_systems import rotor, skate, system_of

from kcons.constraints import LinearVelocity, MovingTarget, Sphere
from kcons.errors import InputError
from kcons.steppers import Composition, KahanLi6, Rattle, Suzuki4, Yoshida4, run
from kcons.steppers.splitting import KAHAN_LI_6, SUZUKI_4, YOSHIDA_4

#: Coarser with velocity rows, where a projection takes ten milliseconds.
STEPS = {4: [16, 32], 6: [8, 16]}
COARSE = {4: [8, 16], 6: [4, 8]}
COMPOSITIONS = pytest.mark.parametrize("stepper", [Yoshida4(), Suzuki4(), KahanLi6()], ids=repr)


@COMPOSITIONS
@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS, *FRICTION], ids=named)
def test_observed_order(stepper, problem: GlobalError) -> None:
    steps = (COARSE if problem in VELOCITY_ROWS else STEPS)[stepper.order]
    assert observed_order(stepper, problem, steps) == pytest.approx(stepper.order, abs=0.15)


def test_one_fraction_is_rattle() -> None:
    system, state = skate()
    a = run(system, state, 0.05, 20, stepper=Composition([1.0], 2))
    b = run(system, state, 0.05, 20, stepper=Rattle())
    np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-14)


@COMPOSITIONS
def test_it_is_rattle_steps_in_turn(stepper) -> None:
    system, state = rotor(force=lambda x, t: -np.cos(3 * t) * x)
    whole = stepper.step(system, state, 0.1)
    for g in stepper.fractions:
        state = Rattle().step(system, state, g * 0.1)
    np.testing.assert_allclose(whole.positions, state.positions, rtol=0, atol=1e-15)
    np.testing.assert_allclose(whole.velocities, state.velocities, rtol=0, atol=2e-15)
    assert whole.time == pytest.approx(state.time, abs=1e-16)


@COMPOSITIONS
def test_rows_and_forces_are_asked_for_the_times_of_the_stages(stepper) -> None:
    asked: set[float] = set()
    forced: list[float] = []

    def radius(t):
        asked.add(round(float(t), 12))
        return 1 + 0.1 * t

    def force(x, t):
        forced.append(t)
        return 0 * x

    positions = np.array([[1.0, 0.0, 0.0]])
    target = MovingTarget(radius, lambda t: 0.1, lambda t: 0.0)
    system = system_of([Sphere(0, [0, 0, 0], target)], positions, [1.0], force)
    state = system.with_forces(system.initial_state(positions, [[0.1, 1.0, 0.0]]))
    asked.clear()
    forced.clear()
    end = stepper.step(system, state, 0.5)
    nodes = 0.5 * np.cumsum(stepper.fractions)
    np.testing.assert_allclose(forced, nodes, rtol=0, atol=1e-15)
    assert {round(t, 12) for t in nodes.tolist()} <= asked
    assert end.time == 0.5
    assert np.linalg.norm(end.positions[0]) == pytest.approx(1.05, abs=1e-15)
    assert end.positions[0] @ end.velocities[0] == pytest.approx(1.05 * 0.1, abs=1e-15)


def test_which_stages_leave_the_step() -> None:
    for fractions, inside in ((SUZUKI_4, True), (KAHAN_LI_6, True), (YOSHIDA_4, False)):
        nodes = np.cumsum(fractions)
        assert (nodes.min() >= 0 and nodes.max() <= 1 + 1e-15) == inside


@COMPOSITIONS
def test_velocity_rows_hold_at_every_step(stepper) -> None:
    system, state = skate()
    held = system.motion.constraint_set
    slips = []
    run(
        system,
        state,
        0.05,
        10,
        stepper=stepper,
        observers=[lambda s: slips.append(held.jacobian(s.positions) @ s.velocities.ravel())],
    )
    assert np.abs(slips).max() <= 1e-13


@COMPOSITIONS
def test_velocity_rows_and_friction_together(stepper) -> None:
    """An atom driven by cos t in x, slowed down in y: x = sin t, y = (1 - exp(-t/2))/0.5."""
    system = system_of(
        [LinearVelocity(0, [[1, 0, 0]], target=np.cos)],
        np.zeros((1, 3)),
        [2.0],
        lambda x, v, t: -1.0 * v,
        velocity_dependent=True,
    )
    start = system.initial_state(np.zeros((1, 3)), [[1.0, 1.0, 0.0]])
    exact = np.array([np.sin(2.0), 2 * (1 - np.exp(-1.0)), 0.0])
    steps = [4, 6, 8] if stepper.order == 6 else [8, 16, 32]
    errors = [np.abs(run(system, start, 2.0 / n, n, stepper=stepper).positions[0] - exact).max() for n in steps]
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(stepper.order, abs=0.15)


@COMPOSITIONS
def test_friction_is_taken_back(stepper) -> None:
    system, start = rotor(force=lambda x, v, t: -0.4 * v, velocity_dependent=True)
    back = run(system, run(system, start, 0.05, 20, stepper=stepper), -0.05, 20, stepper=stepper)
    assert np.abs(back.positions - start.positions).max() <= 1e-12
    assert np.abs(back.velocities - start.velocities).max() <= 1e-12


@pytest.mark.parametrize(
    ("fractions", "order", "match"),
    [
        ([], 2, "no palindrome"),
        ([0.3, 0.7], 2, "no palindrome"),
        ([0.5, 0.4, 0.5], 2, "add up to 1.4"),
        ([0.25, 0.5, 0.25], 4, "powers of 3 do not cancel"),
        (SUZUKI_4, 6, "powers of 5 do not cancel"),
        ([KAHAN_LI_6[k] for k in (1, 0, 2, 3, 4, 5, 6, 8, 7)], 6, "not in this sequence"),
    ],
)
def test_bad_fractions(fractions, order, match) -> None:
    with pytest.raises(InputError, match=match):
        Composition(fractions, order)


def test_own_fractions() -> None:
    """Suzuki's fractal within itself: order 4 still, and said so."""
    stepper = Composition([a * b for a in SUZUKI_4 for b in SUZUKI_4], 4)
    assert stepper.order == 4 and stepper.force_evaluations == 25
    system, state = rotor(force=lambda x, t: -x)
    np.testing.assert_allclose(
        run(system, state, 0.1, 10, stepper=stepper).positions,
        run(system, state, 0.1, 10, stepper=KahanLi6()).positions,
        rtol=0,
        atol=1e-7,
    )
