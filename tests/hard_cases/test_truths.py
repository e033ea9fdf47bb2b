"""The judges against each other: no solver of kcons takes part."""

from __future__ import annotations

import numpy as np
import pytest

from hard_cases import truths
from hard_cases.long_runs import pendulum
from hard_cases.problem import Problem

MASSES = np.array([16.0, 1.0, 2.0])
WATER = truths.rotated([[0.0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]])
OMEGA = np.array([0.9, -0.5, 0.7])


def test_euler_and_the_map_of_moser_and_veselov_agree_with_the_dense_theory():
    body = WATER, MASSES, OMEGA
    problem = Problem(WATER, MASSES, [(0, 1), (0, 2), (1, 2)], velocities=truths.spinning(*body))
    np.testing.assert_allclose(truths.true_motion(problem, 2.0), truths.rigid_flight(*body, 2.0), atol=1e-9)
    rattle = truths.dense_rattle(problem, 0.05, 20)
    np.testing.assert_allclose(rattle, truths.rigid_rattle(*body, 0.05, 20), atol=1e-11)


@pytest.mark.parametrize("angle", [0.1, 1.0, 2.9])
def test_pendulum(angle):
    found = truths.true_motion(pendulum(angle), 1.7)[1]
    np.testing.assert_allclose(found, truths.pendulum(angle, 1.7), atol=1e-9)


def test_linear_flight():
    x = np.array([[-1.2, 0, 0], [0, 0, 0], [1.2, 0, 0]])
    v = truths.spinning(x, MASSES, np.array([0, 0.3, 0.8]), (0.1, 0, -0.2))
    problem = Problem(x, MASSES, [(0, 1), (1, 2)], velocities=v)
    np.testing.assert_allclose(truths.linear_flight(x, v, MASSES, 1.3), truths.true_motion(problem, 1.3), atol=1e-9)
