"""The judges against each other: no solver of kcons takes part."""

from __future__ import annotations

import numpy as np
import pytest

from hard_cases import truths
from hard_cases.problem import Problem

MASSES = np.array([16.0, 1.0, 2.0])
WATER = truths.rotated([[0.0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]])
OMEGA = np.array([0.9, -0.5, 0.7])


def test_euler_agrees_with_the_dense_theory():
    v = truths.spinning(WATER, MASSES, OMEGA)
    problem = Problem(WATER, MASSES, [(0, 1), (0, 2), (1, 2)], velocities=v)
    found = truths.true_motion(problem, 2.0)
    np.testing.assert_allclose(found, truths.rigid_flight(WATER, MASSES, OMEGA, 2.0), atol=1e-9)


def test_the_map_of_moser_and_veselov_is_rattle():
    v = truths.spinning(WATER, MASSES, OMEGA)
    problem = Problem(WATER, MASSES, [(0, 1), (0, 2), (1, 2)], velocities=v)
    found = truths.dense_rattle(problem, 0.05, 20)
    np.testing.assert_allclose(found, truths.rigid_rattle(WATER, MASSES, OMEGA, 0.05, 20), atol=1e-11)


@pytest.mark.parametrize("angle", [0.1, 1.0, 2.9])
def test_pendulum(angle):
    x = np.array([[0.0, 0, 0], [np.sin(angle), 0, -np.cos(angle)]])
    push = np.array([[0, 0, 0], [0, 0, -1.0]])
    problem = Problem(x, [1.0, 1.0], [(0, 1)], [1.0], fixed=[0], push=push)
    np.testing.assert_allclose(truths.true_motion(problem, 1.7)[1], truths.pendulum(angle, 1.7), atol=1e-9)


def test_linear_flight():
    x = np.array([[-1.2, 0, 0], [0, 0, 0], [1.2, 0, 0]])
    v = truths.spinning(x, MASSES, np.array([0, 0.3, 0.8]), (0.1, 0, -0.2))
    later = truths.linear_flight(x, v, MASSES, 1.3)
    turn = np.hypot(0.3, 0.8) * 1.3
    cosine = (later[2] - later[0]) @ (x[2] - x[0]) / 2.4**2
    assert cosine == pytest.approx(np.cos(turn), abs=1e-13)
    np.testing.assert_allclose(MASSES @ later, MASSES @ x + 1.3 * MASSES @ v, atol=1e-13)
