"""Drifts: constrained flight without forces, one piece at a time."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_systems import growing_rod, skate, system_of

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import (
    CustomVelocity,
    Distance,
    FixedAtoms,
    ImplicitSurface,
    KnifeEdge,
    LinearVelocity,
    MovingTarget,
    Plane,
    Rolling,
    Sphere,
)
from kcons.errors import ConvergenceError
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Fly
from kcons.steppers.program import Program


def flown(system, state, h: float, *, exact: bool = False, flights: int = 1):
    """Positions and velocities after a drift of h, by the engine."""
    if not exact:
        system.packed = None
    parts = (1.0 / flights,) * flights
    ends = (*np.cumsum(parts)[:-1], 1.0)
    steps = Interpreter(system, state, h, Program([Fly(1.0, parts, ends, exact)]))
    end = steps.through()
    return end.positions, end.velocities + (steps.push if steps.program.pairs else 0.0)


def literal_flight(system, state, h: float):
    """What a flight should be, by dense algebra on all rows at once: x1 and u."""
    held, x0, t0 = system.motion.constraint_set, state.positions, state.time
    rolls, weights = ~held.holonomic, np.repeat(system.inverse_masses, 3)
    pull = weights[:, None] * held.jacobian(x0, t0).toarray().T
    multipliers = np.zeros(held.n_rows)
    for _ in range(60):
        u = state.velocities.ravel() + pull @ multipliers
        x1 = x0 + h * u.reshape(x0.shape)
        middle, then = 0.5 * (x0 + x1), t0 + 0.5 * h
        rows = np.where(rolls[:, None], held.jacobian(middle, then).toarray(), held.jacobian(x1, t0 + h).toarray())
        speeds = held.jacobian(middle, then) @ u - held.velocity_target(middle, then)
        multipliers -= np.linalg.lstsq(rows @ pull, np.where(rolls, speeds, held.value(x1, t0 + h) / h), rcond=1e-10)[0]
    return x1, u.reshape(x0.shape)


def wheel():
    """A wheel of three masses and a hub that rolls, and is pushed at its hub in a direction that turns with it."""
    turns = np.radians([10, 130, 250])[:, None]
    x = np.array([0, 0, 1.0]) + np.vstack([np.zeros(3), 0.9 * np.hstack([np.sin(turns), 0 * turns, np.cos(turns)])])
    held = [
        Plane([0], [0.0, 0, 1]),
        Plane([0, 1, 2, 3], [0.0, 1, 0]),
        Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]),
    ]
    system = system_of([*held, Rolling([0], [1], 1.0, [1.0, 0, 0])], x, [0.5, 1.0, 2.0, 1.5])
    return system, system.initial_state(x, np.array([[1.0, 0, 0], [2, 0, 0.5], [0, 0, 1], [-1, 0, 0]]), project=True)


def pivoting_skate():
    """A blade that touches at its back, so that what keeps it from sliding turns it."""
    x = np.array([[0.2, -0.1, 0.0], [0.7, 0.3, 0.1]])
    rows = [Distance([0, 1]), Plane([0, 1], [0.0, 0.1, 1.0]), KnifeEdge(0, 1, [0.0, 0.0, 1.0], contact=0.1)]
    system = system_of(rows, x, [1.0, 3.0])
    return system, system.initial_state(x, np.array([[1.0, 0.5, 0], [0.2, 2.0, 0]]), project=True)


def bodies_apart():
    """An atom whose velocity is held, a rod, and a free atom."""
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0], [5.0, 1.2, 0], [9.0, 9, 9]])
    system = system_of([LinearVelocity(0, [[0, 0, 1]], target=lambda t: 0.5), Distance([2, 3])], x, np.ones(5))
    return system, system.initial_state(x, np.random.default_rng(1).normal(size=(5, 3)), project=True)


#: The plane of `swept` has turned by the end, and pushes where it was; speeds, and their directions, depend on time.
DENSE = [skate, pivoting_skate, wheel, bodies_apart, lambda: swept(), lambda: swept(pushed(np.cos)), growing_rod]


@pytest.mark.parametrize("h", [0.1, -0.3])
@pytest.mark.parametrize("make", DENSE)
def test_flights_are_those_of_dense_algebra(make, h) -> None:
    system, state = make()
    for one, other in zip(flown(system, state, h), literal_flight(system, state, h), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=3e-14)


def test_velocity_row_that_cannot_be_met_names_itself() -> None:
    """A skate that turns by more than it can in one step."""
    system, state = skate()
    with pytest.raises(ConvergenceError) as caught:
        flown(system, state, 40.0)
    assert caught.value.atoms == (0, 1)


def test_great_circles_only_where_every_row_allows_them() -> None:
    x = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [5.0, 5.0, 5.0]])
    unit, wide = Sphere(0, [0, 0, 0], 1.0), Sphere(1, [0, 0, 0], 2.0)
    growing = Sphere(0, [0, 0, 0], MovingTarget(lambda t: 1 + t, lambda t: 1.0, lambda t: 0.0))

    def circles(*rows):
        return system_of(rows, x, [1, 1, 1]).great_circles

    assert circles(unit)[:, 3].tolist() == [1, 0, 0]
    assert circles(unit, wide, FixedAtoms([2]))[:, 3].tolist() == [1, 2, -1]
    for rows in ([FixedAtoms([2])], [growing], [unit, Distance([1, 2])], [unit, Sphere(0, [1, 1, 0], 1.0)], []):
        assert circles(*rows) is None


def test_great_circles_end_on_the_sphere_wherever_they_start() -> None:
    """What rounding, or a start within the tolerance, left off the sphere is gone after any drift: |x - c| = R."""
    center = np.array([0.3, -0.2, 0.1])
    on = center + 2.0 * np.array([[0.6, 0.0, 0.8]])
    system = system_of([Sphere(0, center, 2.0)], on, [2.0])
    state = system.initial_state(on, [[0.8, 0.5, -0.6]])
    for off in (1e-7, -1e-10):
        start = type(state)(on + off * (on - center), state.velocities)
        for h in (1e-6, 0.4):
            at, _ = flown(system, start, h, exact=True)
            assert abs(np.linalg.norm(at[0] - center) - 2.0) <= 4 * np.spacing(2.0)


# -- times ------------------------------------------------------------------------------------------


def turning(rate: float = 1.3) -> ImplicitSurface:
    """Atom 0 in a plane through the z axis that turns: the gradient depends on the time, not only the value."""
    return ImplicitSurface(
        0,
        lambda r, t: r[:, 0] * np.sin(rate * t) - r[:, 1] * np.cos(rate * t),
        lambda r, t: np.tile([np.sin(rate * t), -np.cos(rate * t), 0.0], (len(r), 1)),
        time_dependent=True,
        length=1.0,
    )


def pushed(speed) -> CustomVelocity:
    """Atom 2 moves at a given speed in a direction that turns with the time and depends on the place."""
    return CustomVelocity(
        [2], lambda r, t: np.array([[np.cos(2 * t), np.sin(2 * t), r[0, 0]]]), target=speed, time_dependent=True
    )


def swept(*more) -> tuple:
    x = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.8], [1.7, 0.3, 0.8]])
    system = system_of([turning(), Distance([[0, 1], [1, 2]]), *more], x, [1.0, 0.4, 2.0])
    v = np.array([[0.3, 0.0, 0.1], [0.2, 0.5, -0.4], [0.0, 0.3, 0.6]])
    return system, system.initial_state(x, v, project=True)


@pytest.mark.parametrize("slope, dt", [(0.0, 0.0001), (0.17, 0.005), (0.17, 0.001)])
def test_a_wheel_starts_to_roll_from_rest(slope, dt) -> None:
    """Velocities are known to what rounding of the positions leaves of them, also where they vanish."""
    along, up = np.array([np.cos(slope), 0, -np.sin(slope)]), np.array([np.sin(slope), 0, np.cos(slope)])
    turns = np.radians([0, 120, 240])[:, None]
    x = up + np.vstack([np.zeros(3), np.cos(turns) * along + np.sin(turns) * up])
    masses = np.array([0.5, 1.0, 1.0, 1.0])
    held = [Plane([0], up), Plane([0, 1, 2, 3], [0.0, 1.0, 0.0]), Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]])]
    motion = Motion(ConstraintSet([*held, Rolling([0], [1], 1.0, along, up)], x, masses), x)
    weight = masses[:, None] * np.array([0.0, 0.0, -10.0])
    end = run(System(motion, lambda x, t: weight), State(x, np.zeros_like(x)), dt, 100)
    rolled = (end.positions[0] - x[0]) @ along
    assert rolled == pytest.approx(10 * np.sin(slope) * 3.5 / 6.5 * (100 * dt) ** 2 / 2, rel=1e-4, abs=1e-13)
