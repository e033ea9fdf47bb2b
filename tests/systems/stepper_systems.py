"""Small systems, and the steppers to run on them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from constraint_cases import blade

from kcons.comparison.projected_equation import ProjectedEquation
from kcons.constraints import Distance, FixedAtoms, MovingTarget
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import RungeKuttaNystrom, State, Stepper, System
from kcons.steppers.splitting import SCHEMES, Splitting

#: Every stepper by fractions, and those whose forces may depend on velocities, and those whose may not.
SYMMETRIC: list[Splitting] = [make() for make in SCHEMES.values()]
COMPOSED = [stepper for stepper in SYMMETRIC if not isinstance(stepper, RungeKuttaNystrom)]
NYSTROM = [stepper for stepper in SYMMETRIC if isinstance(stepper, RungeKuttaNystrom)]
#: For comparison only.
PROJECTED: list[Stepper] = [
    ProjectedEquation(),
    ProjectedEquation(project=True),
    ProjectedEquation(4),
    ProjectedEquation(4, project=True),
]


def system_of(constraints, positions, masses, force=None, potential=None, time=0.0, **options) -> System:
    positions = np.asarray(positions, dtype=float)
    held = ConstraintSet(constraints, positions, masses, time=time)
    return System(Motion(held, positions, time=time), force, potential=potential, **options)


def gravity(masses, g=(0.0, 0.0, -1.0)) -> Callable:
    field = np.outer(masses, g)
    return lambda x, t: field


def spherical_pendulum() -> tuple[System, State]:
    """Mass 1 on a rod of length 1 about a fixed atom, gravity 1 (reference case A02_spherical_pendulum_generic)."""
    theta = 1.2
    positions = np.array([[0.0, 0.0, 0.0], [np.sin(theta), 0.0, -np.cos(theta)]])
    masses = np.array([1.0, 1.0])
    system = system_of(
        [FixedAtoms([0]), Distance([0, 1], 1.0)],
        positions,
        masses,
        gravity(masses),
        potential=lambda x, t: float(x[1, 2]),
    )
    return system, system.initial_state(positions, [[0, 0, 0], [0, 0.8, 0]])


def planar_pendulum(angle: float) -> tuple[System, State]:
    positions = np.array([[0.0, 0.0, 0.0], [np.sin(angle), 0.0, -np.cos(angle)]])
    system = system_of(
        [FixedAtoms([0]), Distance([0, 1])], positions, [1, 1], gravity([1, 1]), potential=lambda x, t: float(x[1, 2])
    )
    return system, system.initial_state(positions)


def rotor(omega=1.0, force=None, offset=0.0, **options) -> tuple[System, State]:
    """Two unlike masses at distance 1.2, turning in the xy plane about their center."""
    masses = np.array([1.0, 2.5])
    arms = 1.2 * np.array([2.5, -1.0]) / 3.5
    positions = np.zeros((2, 3)) + offset
    positions[:, 0] += arms
    velocities = np.zeros((2, 3))
    velocities[:, 1] = omega * arms
    system = system_of([Distance([0, 1], 1.2)], positions, masses, force, **options)
    return system, system.initial_state(positions, velocities)


def skate() -> tuple[System, State]:
    """A skate (two equal masses, blade under their center) on a slope: a closed cycloid-like motion."""
    positions = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    rows = [Distance([0, 1]), blade([0, 1], contact=0.5)]
    system = system_of(
        rows, positions, [1, 1], gravity([1, 1], (0.7, 0, 0)), potential=lambda x, t: -0.7 * x[:, 0].sum()
    )
    omega, u0 = 1.1, 0.4
    velocities = np.array([[u0, -0.5 * omega, 0.0], [u0, 0.5 * omega, 0.0]])
    return system, system.initial_state(positions, velocities)


def angle_of(state: State) -> float:
    d = state.positions[0] - state.positions[1]
    return float(np.arctan2(d[1], d[0]))


def slope(dts, errors) -> float:
    return float(np.polyfit(np.log(dts), np.log(errors), 1)[0])


def assert_same(a: State, b: State) -> None:
    """To the last bit, in everything a state holds."""
    for name, value in a.__getstate__().items():
        other = getattr(b, name)
        assert type(value) is type(other), name
        assert np.array_equal(value, other), name


def growing_rod(speed: float = 0.9) -> tuple[System, State]:
    """Mass on a rod whose length grows as 1 + t/2 about a fixed point: angular momentum is conserved."""
    positions = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    length = MovingTarget(lambda t: 1 + 0.5 * t, lambda t: 0.5, lambda t: 0.0)
    system = system_of([FixedAtoms([0]), Distance([0, 1], length)], positions, [1, 1])
    return system, system.initial_state(positions, [[0, 0, 0], [0.5, speed, 0]])
