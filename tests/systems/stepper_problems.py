"""Problems with known solutions: each gives the error of a stepper at a time step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from stepper_systems import angle_of, growing_rod, rotor, skate, slope, spherical_pendulum, system_of

from kcons.constraints import LinearVelocity
from kcons.steppers import Stepper, run

GlobalError = Callable[[Stepper, float], float]


def error_spherical_pendulum(stepper, dt):
    # 25-digit reference at t = 1 (minimal coordinates, 45-digit arithmetic).
    x1 = np.array([0.4497250024354154, 0.6418565722780616, -0.6211018940624181])
    v1 = np.array([-0.9582024352419465, 0.2904057756042812, -0.3937014830599042])
    system, state = spherical_pendulum()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    return np.abs(np.concatenate([end.positions[1] - x1, end.velocities[1] - v1])).max()


def error_free_rotor(stepper, dt):
    system, state = rotor(omega=1.3)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 2.6)


def error_growing_rod(stepper, dt):
    system, state = growing_rod(speed=2.7)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    phi = 2.7 / 0.5 * (1 - 1 / 2.0)
    exact = 2.0 * np.array([np.cos(phi), np.sin(phi), 0.0])
    return np.abs(end.positions[1] - exact).max()


def error_rotor_with_friction(stepper, dt):
    system, state = rotor(omega=1.3, force=lambda x, v, t: -0.4 * np.array([[1.0], [2.5]]) * v, velocity_dependent=True)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 1.3 / 0.4 * (1 - np.exp(-0.8)))


def error_skate(stepper, dt):
    system, state = skate()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    w, u0, g, t = 1.1, 0.4, 0.7, 1.0
    x = u0 / w * np.sin(w * t) + g / (2 * w**2) * np.sin(w * t) ** 2
    y = u0 / w * (1 - np.cos(w * t)) + g / w**2 * (w * t / 2 - np.sin(2 * w * t) / 4)
    return np.abs(end.positions.mean(axis=0) - [x, y, 0]).max()


def error_driven_atom(stepper, dt):
    system = system_of([LinearVelocity(0, [[1, 0, 0]], target=lambda t: np.cos(3 * t))], np.zeros((1, 3)), [2.0])
    end = run(system, system.initial_state(np.zeros((1, 3))), dt, round(2 / dt), stepper=stepper)
    return abs(end.positions[0, 0] - np.sin(6.0) / 3)


#: Rows and forces that depend on positions and time.
HOLONOMIC: list[GlobalError] = [error_spherical_pendulum, error_free_rotor, error_growing_rod]
VELOCITY_ROWS: list[GlobalError] = [error_skate, error_driven_atom]
FRICTION: list[GlobalError] = [error_rotor_with_friction]


def named(problem: GlobalError) -> str:
    return problem.__name__.removeprefix("error_")


def observed_order(stepper: Stepper, problem: GlobalError, steps: list[int]) -> float:
    """Slope over steps of 1/n, on errors that are far above rounding."""
    dts = 1.0 / np.array(steps)
    errors = [problem(stepper, dt) for dt in dts]
    assert min(errors) >= 30e-13, f"{errors} end in round-off"
    return slope(dts, errors)
