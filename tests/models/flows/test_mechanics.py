"""Mechanics: from a Lagrangian to Hamilton's equations, no divergence."""

import numpy as np
import pytest

from kcons.errors import ConvergenceError, InputError
from kcons.models.flows import (
    DampedOscillator,
    Flow,
    HamiltonianFlow,
    Pendulum,
    action,
    hamiltonian,
    lagrange_residual,
    momentum,
    phase_volume,
    velocity_of_momentum,
)


def coupled(q, p):
    """Not separable."""
    return 0.5 * p[0] ** 2 * (1 + 0.3 * q[0] ** 2) + 0.5 * p[1] ** 2 + 0.5 * q[0] ** 2 + np.cos(q[1] - q[0])


def test_equations_by_differences():
    flow = Pendulum(1.4)
    plain = HamiltonianFlow(flow.hamiltonian, 1)
    X = np.array([0.8, -0.5])
    assert flow.velocity(0.0, X) == pytest.approx([1.4 * -0.5, -1.4 * np.sin(0.8)])
    assert plain.velocity(0.0, X) == pytest.approx(flow.velocity(0.0, X), abs=1e-11)
    assert plain.jacobian(0.0, X) == pytest.approx(flow.jacobian(0.0, X), abs=1e-8)


def test_divergence_vanishes():
    flow = HamiltonianFlow(coupled, 2)
    for seed in range(3):
        assert abs(flow.divergence(0.0, np.random.default_rng(seed).normal(size=4))) < 1e-7


OMEGA, ETA = 1.3, 0.2


def damped():
    """Caldirola's and Kanai's H: in p = e^(eta t) dq/dt it has the motion of an oscillator with friction."""
    return HamiltonianFlow(
        lambda q, p, t: np.exp(-ETA * t) * p[0] ** 2 / 2 + np.exp(ETA * t) * OMEGA**2 * q[0] ** 2 / 2,
        1,
        lambda q, p, t: np.exp(ETA * t) * OMEGA**2 * q,
        lambda q, p, t: np.exp(-ETA * t) * p,
        time_dependent=True,
    )


def test_friction_by_a_hamiltonian_that_depends_on_time():
    # q and dq/dt by the closed form of the damped oscillator, whose variables are Omega q and dq/dt.
    t0, T, q, v = 0.7, 4.0, 1.2, 0.4
    found = damped().solve((t0, t0 + T), [q, v * np.exp(ETA * t0)]).y[:, -1]
    x1, x2 = DampedOscillator(OMEGA, ETA).closed_form(T) @ [OMEGA * q, v]
    assert found == pytest.approx([x1 / OMEGA, x2 * np.exp(ETA * (t0 + T))], rel=1e-8)


def test_flow_of_a_hamiltonian_that_depends_on_time():
    flow = damped()
    plain = HamiltonianFlow(flow.hamiltonian, 1, time_dependent=True)
    X = np.array([0.8, -0.5])
    for t in (0.0, 1.5):
        assert plain.velocity(t, X) == pytest.approx(flow.velocity(t, X), abs=1e-10)
        assert flow.energy(X, t) == pytest.approx(flow.hamiltonian(X[:1], X[1:], t))
    # In phase space of (q, p) the volume is kept, though friction takes it from (q, dq/dt).
    assert phase_volume(flow, X, [0.0, 5.0]).log_volume[-1] == pytest.approx(0.0, abs=1e-9)
    # (51): along a trajectory H changes by its own change in time, dH/dt = -dL/dt.
    found = flow.solve((0.0, 2.0), X, t_eval=[0.999, 1.0, 1.001])
    slope = np.diff([flow.energy(X, t) for X, t in zip(found.y.T, found.t, strict=True)][::2])[0] / 0.002
    q, p = found.y[:, 1]
    own = 0.5 * ETA * (-np.exp(-ETA) * p**2 + np.exp(ETA) * OMEGA**2 * q**2)
    assert slope == pytest.approx(own, rel=1e-5)

    def lagrangian(q, v, t):
        return np.exp(ETA * t) * (v[0] ** 2 - OMEGA**2 * q[0] ** 2) / 2

    v, h = np.exp(-ETA) * p, 1e-4
    dL = (lagrangian([q], [v], 1 + h) - lagrangian([q], [v], 1 - h)) / (2 * h)
    assert slope == pytest.approx(-dL, rel=1e-5)
    # From the Lagrangian, all by differences.
    made = HamiltonianFlow(lambda q, p, t: hamiltonian(lagrangian, q, p, t), 1, time_dependent=True)
    assert made.velocity(1.0, found.y[:, 1]) == pytest.approx(flow.velocity(1.0, found.y[:, 1]), abs=1e-6)


def test_user_functions_cannot_change_the_state():
    def push(t, X):
        X[0] += 1.0
        return X

    with pytest.raises(ValueError, match="read-only"):
        Flow(push, 2).solve((0.0, 1.0), [1.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):
        Flow(lambda t, X: X, 2, push).jacobian(0.0, [1.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):
        HamiltonianFlow(lambda q, p: 0.0, 1, lambda q, p: push(0.0, q), lambda q, p: p).solve((0, 1), [1.0, 0.0])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((2, lambda q, p: -q, lambda q, p: p), "dH_dq gives .* differences of H give"),
        ((2, lambda q, p: q, lambda q, p: 2 * p), "dH_dp gives .* differences of H give"),
        ((2, lambda q, p: q[:1], lambda q, p: p), r"dH_dq returned shape \(1,\), not \(2,\)"),
        ((2, lambda q, p: q, lambda q, p: p[0]), r"dH_dp returned shape \(\), not \(2,\)"),
        ((2, lambda q: q, None), "dH_dq takes"),
        ((0,), "f is 0"),
        ((3,), "state of this flow"),
    ],
)
def test_wrong_gradients_and_sizes_are_refused(given, words: str) -> None:
    with pytest.raises(InputError, match=words):
        HamiltonianFlow(lambda q, p: 0.5 * p @ p + 0.5 * q @ q, *given).solve((0, 1), [1.0, 2.0, 0.5, 0.25])
    with pytest.raises(InputError, match="hamiltonian takes"):
        HamiltonianFlow(coupled, 2, time_dependent=True)


def test_an_energy_too_fine_for_differences() -> None:
    fine = lambda q, p: 0.5 * p[0] ** 2 - 1e-4 * np.cos(q[0] / 1e-3)  # noqa: E731
    with pytest.raises(InputError, match="too fast for differences: give its dH_dq"):
        HamiltonianFlow(fine, 1).solve((0, 1e-3), [1e-3, 0.1])
    HamiltonianFlow(fine, 1, lambda q, p: 0.1 * np.sin(q / 1e-3)).solve((0, 1e-3), [1e-3, 0.1])


# -- from a Lagrangian -----------------------------------------------------------------------------------


M, LENGTH, G = 1.3, 0.8, 9.81


def pendulum(q, v, t):
    return 0.5 * M * LENGTH**2 * v[0] ** 2 - M * G * LENGTH * (1 - np.cos(q[0]))


def polar(q, v, t):
    """A particle in the plane, in polar coordinates."""
    return 0.5 * M * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + 1.0 / q[0]


PLACE = np.array([[1.4, 0.3], [0.2, -0.9]])


def test_momentum_and_its_inverse():
    q, v = PLACE
    p = momentum(polar, q, v)
    assert p == pytest.approx([M * 0.2, M * 1.4**2 * -0.9], rel=1e-10)
    assert velocity_of_momentum(polar, q, p) == pytest.approx(v, rel=1e-9)


def test_hamiltonian_is_the_energy():
    q, v = PLACE
    p = momentum(polar, q, v)
    energy = p[0] ** 2 / (2 * M) + p[1] ** 2 / (2 * M * 1.4**2) - 1 / 1.4
    assert hamiltonian(polar, q, p) == pytest.approx(energy, rel=1e-9)
    # T is homogeneous of order two: sum v dT/dv = 2T (54).
    T = lambda q, v, t: polar(q, v, t) - 1 / q[0]  # noqa: E731
    assert v @ momentum(T, q, v) == pytest.approx(2 * T(q, v, 0.0), rel=1e-9)


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
    # Least: both neighbors are larger, by equal amounts.
    assert S[0] > S[1] < S[2]
    assert abs(S[2] - S[0]) < 1e-2 * (S[0] + S[2] - 2 * S[1])


def test_what_has_no_velocity_and_no_action():
    with pytest.raises(ConvergenceError, match="guess"):
        velocity_of_momentum(lambda q, v, t: float(np.tanh(v[0])), [0.0], [2.0])
    for times, path in (([0.0, 0.0, 1.0], np.zeros(3)), ([0.0, 1.0, 2.0], np.zeros(7))):
        with pytest.raises(InputError, match="times increase"):
            action(lambda q, v, t: 0.5 * v @ v, times, path)
