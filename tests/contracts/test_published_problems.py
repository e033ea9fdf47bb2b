"""Problems with published solutions, stated as they are published.

The car axis: two wheels on a road that moves one of them, an index-3 problem; parameters and the solution at t = 3 from
Mazzia and Magherini, Test Set for Initial Value Problem Solvers, release 2.4 (2008), II-1. Thomson's problem is that of
`motion/test_motion.py`.
"""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Distance, Formula
from kcons.steppers import BlanesMoan6

ROOT = Path(__file__).parents[2]
LENGTH, SPRING, EPSILON, MASS, HEIGHT, FREQUENCY = 1.0, 0.5, 1e-2, 10.0, 0.1, 10.0
WEIGHT = EPSILON**2 * MASS / 2
POSITIONS = [[0.0493455784275402809, 0.496989460230171154], [1.04174252488542151681, 0.373911027265361256927]]
VELOCITIES = [[-0.0770583684040972358, 0.00744686658723778553], [0.0175568157537232222, 0.770341043779251976]]
MULTIPLIERS = [-0.00473688659084893325, -0.00110468033125734369]


def springs(x, t):
    """Of the wheels, and their weight."""
    road = np.array([[0.0, 0.0, 0.0], [np.sqrt(LENGTH**2 - (HEIGHT * np.sin(FREQUENCY * t)) ** 2), 0.0, 0.0]])
    road[1, 1] = HEIGHT * np.sin(FREQUENCY * t)
    r = x - road
    length = np.linalg.norm(r, axis=1, keepdims=True)
    return (SPRING - length) * r / length - [0.0, WEIGHT, 0.0]


@pytest.fixture
def car():
    road = {"h": HEIGHT, "w": FREQUENCY, "L": LENGTH}
    upright = Formula("x1*sqrt(L**2 - (h*sin(w*t))**2) + y1*h*sin(w*t)", 0, road)
    x = np.array([[0.0, 0.5, 0.0], [1.0, 0.5, 0.0]])
    motion = Motion(ConstraintSet([upright, Distance([[0, 1]], LENGTH)], x, [WEIGHT, WEIGHT]), x)
    system = System(motion, springs)
    return system, system.initial_state(x, [[-0.5, 0.0, 0.0], [-0.5, 0.0, 0.0]])


def test_car_axis_to_order_six(car):
    system, start = car
    errors = []
    for n in (240, 480):
        end = run(system, start, 3.0 / n, n, stepper=BlanesMoan6())
        errors.append(np.abs(end.positions[:, :2] - POSITIONS).max())
    assert errors[1] < 2e-10
    assert np.log2(errors[0] / errors[1]) == pytest.approx(6, abs=0.3)
    np.testing.assert_allclose(end.velocities[:, :2], VELOCITIES, rtol=0, atol=5e-9)
    found = system.motion.multipliers(end.positions, end.velocities, springs(end.positions, 3.0), 3.0)
    # The published second row is the square of the length: its gradient is twice as long.
    np.testing.assert_allclose(found / [1.0, 2.0 * LENGTH], MULTIPLIERS, rtol=0, atol=1e-9)


def test_car_axis_by_no_more_evaluations_than_dop853():
    """Of what the study measures."""
    script = runpy.run_path(str(ROOT / "examples" / "studies" / "own_constraints.py"))
    found = {name: way() for name, way in script["CAR"].items()}
    errors = {name: script["car_error"](each) for name, each in found.items()}
    assert max(errors.values()) < 1e-7 and errors["BlanesMoan6"] < errors["SciPy alone, DOP853"]
    assert found["BlanesMoan6"][2] < found["SciPy alone, DOP853"][2]
