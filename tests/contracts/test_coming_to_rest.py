"""Forces that depend on velocities, velocity rows and checks where nothing is left of the speed but rounding."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import blade
from stepper_systems import gravity, system_of

from kcons.constraints import Distance, FixedAtoms
from kcons.steppers import Geodesic, KahanLi6, Rattle, ReversibilityCheck, State, Suzuki4, System, Yoshida4, run

MASSES = np.array([1.0, 2.0, 0.5])


def pendulum(rate: float = 1.2) -> tuple[System, State]:
    """Two bobs on rods, held out sideways; friction a mass of `rate`."""
    x = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, -0.8], [1.4, 0.0, -0.2]])
    weight = gravity(MASSES)(x, 0.0)
    rows = [FixedAtoms([0]), Distance([[0, 1], [1, 2]])]
    force = lambda x, v, t: weight - rate * MASSES[:, None] * v  # noqa: E731
    system = system_of(rows, x, MASSES, force, velocity_dependent=True)
    return system, system.initial_state(x)


@pytest.mark.parametrize(
    "stepper",
    [Rattle(), Geodesic(3), Yoshida4(), Suzuki4(), KahanLi6(), ReversibilityCheck(Rattle())],
    ids=repr,
)
def test_a_damped_pendulum_comes_to_rest(stepper) -> None:
    """At the end the kick is all that velocities have been rounded from: they settle relative to it."""
    system, start = pendulum()
    end = run(system, start, 0.1, 800, stepper=stepper)
    assert np.abs(end.velocities).max() <= 1e-12
    np.testing.assert_allclose(end.positions, [[0, 0, 0], [0, 0, -1], [0, 0, -2]], atol=1e-12)
    # And it may start again from there.
    again = system.initial_state(end.positions, end.velocities)
    assert run(system, again, 0.1, 10, stepper=stepper).step == 10


def test_settled_velocities_are_those_of_the_implicit_equation() -> None:
    """v = drifted + half a kick with f(v), to rounding, in motion as at rest: the rule is not loose."""
    system, start = pendulum()
    dt = 0.1
    state = run(system, start, dt, 3)
    after = Rattle().step(system, state, dt)
    motion, half = system.motion, 0.5 * dt * system.inverse_masses
    u = state.velocities + half * system.forces(state.positions, state.velocities, 0.0, 0)
    motion.project_positions(state.positions + dt * u, state.positions, velocities=u, dt=dt, out=np.empty_like(u))
    v = motion.project_velocities(after.positions, u + half * system.forces(after.positions, after.velocities, 0.0, 0))
    np.testing.assert_allclose(after.velocities, v, rtol=0, atol=4e-16)


@pytest.mark.parametrize("seed", range(4))
def test_a_blade_takes_up_a_kick_from_the_side_whole(seed: int) -> None:
    """Nothing moves: the velocity row has only the rounding of the kick to be compared with."""
    rng = np.random.default_rng(seed)
    along = rng.normal(size=3)
    along /= np.linalg.norm(along)
    normal = np.cross(along, rng.normal(size=3))
    normal /= np.linalg.norm(normal)
    x = np.array([-0.5 * along, 0.6 * along]) + rng.normal(size=3)
    pull = np.outer([3.5, 1.5], np.cross(normal, along))  # at the contact
    rows = [Distance([0, 1]), blade([0, 1], normal, 0.3)]
    system = system_of(rows, x, rng.uniform(0.3, 3, 2), lambda x, t: pull)
    end = run(system, system.initial_state(x), 0.05, 3)
    assert np.abs(end.positions - x).max() <= 1e-15
    assert np.abs(end.velocities).max() <= 1e-15


def test_the_check_of_reversibility_still_sees_what_moves() -> None:
    """Rounding of the kick is allowed for, not a part of it."""
    system, start = pendulum()
    rest = run(system, start, 0.1, 800)

    class Pushed(Rattle):
        def step(self, system, state, dt):
            after = super().step(system, state, dt)
            return State(
                after.positions, after.velocities + np.array([0.0, 1e-12, 0.0]), after.time, after.forces, after.step
            )

    with pytest.raises(Exception, match="not reversible"):
        ReversibilityCheck(Pushed()).step(system, rest, 0.1)
