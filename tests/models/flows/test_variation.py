"""From a Lagrangian to action, momenta, Lagrange's and Hamilton's equations."""

import numpy as np
import pytest

from kcons.errors import ConvergenceError, InputError
from kcons.models.flows import Pendulum, action, hamiltonian, lagrange_residual, momentum, velocity_of_momentum

M, LENGTH, G = 1.3, 0.8, 9.81


def pendulum(q, v, t):
    return 0.5 * M * LENGTH**2 * v[0] ** 2 - M * G * LENGTH * (1 - np.cos(q[0]))


def polar(q, v, t):
    """A particle in the plane, in polar coordinates."""
    return 0.5 * M * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + 1.0 / q[0]


def test_momentum_and_its_inverse():
    q, v = np.array([1.4, 0.3]), np.array([0.2, -0.9])
    p = momentum(polar, q, v)
    assert p == pytest.approx([M * 0.2, M * 1.4**2 * -0.9], rel=1e-10)
    assert velocity_of_momentum(polar, q, p) == pytest.approx(v, rel=1e-9)


def test_hamiltonian_is_the_energy():
    q, v = np.array([1.4, 0.3]), np.array([0.2, -0.9])
    p = momentum(polar, q, v)
    energy = p[0] ** 2 / (2 * M) + p[1] ** 2 / (2 * M * 1.4**2) - 1 / 1.4
    assert hamiltonian(polar, q, p) == pytest.approx(energy, rel=1e-9)
    # T is homogeneous of order two: sum v dT/dv = 2T (54).
    T = lambda q, v, t: polar(q, v, t) - 1 / q[0]  # noqa: E731
    assert v @ momentum(T, q, v) == pytest.approx(2 * T(q, v, 0.0), rel=1e-9)


def test_energy_is_a_function_of_time_as_the_lagrangian_is():
    moving = lambda q, v, t: 0.5 * v[0] ** 2 - np.sin(t) * q[0]  # noqa: E731
    h = 1e-4
    dH = (hamiltonian(moving, [0.7], [0.2], 0.3 + h) - hamiltonian(moving, [0.7], [0.2], 0.3 - h)) / (2 * h)
    dL = (moving([0.7], [0.2], 0.3 + h) - moving([0.7], [0.2], 0.3 - h)) / (2 * h)
    assert dH == pytest.approx(-dL, abs=1e-6)


def test_true_motion_obeys_lagrange():
    omega = np.sqrt(G / LENGTH)
    theta, rate = Pendulum(omega).exact(0.4, [1.0, 0.0])
    q, v, a = [theta], [omega * rate], [-(omega**2) * np.sin(theta)]
    assert lagrange_residual(pendulum, q, v, a) == pytest.approx([0.0], abs=1e-6)
    assert abs(lagrange_residual(pendulum, q, v, [a[0] + 1.0])[0] - M * LENGTH**2) < 1e-5


def test_action_is_stationary_on_the_true_path():
    t = np.linspace(0.0, 0.4, 401)
    omega = np.sqrt(G / LENGTH)
    path = Pendulum(omega).exact(t, [0.3, 0.5])[:, 0]
    bump = np.sin(np.pi * t / 0.4)
    S = [action(pendulum, t, path + e * bump) for e in (-0.02, 0.0, 0.02)]
    # Least: both neighbours are larger, by equal amounts.
    assert S[0] > S[1] < S[2]
    assert abs(S[2] - S[0]) < 1e-2 * (S[0] + S[2] - 2 * S[1])


def test_momentum_without_a_velocity():
    with pytest.raises(ConvergenceError, match="guess"):
        velocity_of_momentum(lambda q, v, t: float(np.tanh(v[0])), [0.0], [2.0])


@pytest.mark.parametrize(("times", "path"), [([0.0, 0.0, 1.0], np.zeros(3)), ([0.0, 1.0, 2.0], np.zeros(7))])
def test_paths_that_do_not_go_with_their_times(times, path) -> None:
    with pytest.raises(InputError, match="times increase"):
        action(lambda q, v, t: 0.5 * v @ v, times, path)
