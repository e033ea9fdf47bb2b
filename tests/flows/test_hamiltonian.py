"""Hamiltonian flows: equations, no divergence, symplectic steps."""

import numpy as np
import pytest

from kcons.errors import ConvergenceError, InputError
from kcons.flows import HamiltonianFlow, Pendulum

J = np.array([[0.0, 1.0], [-1.0, 0.0]])


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


@pytest.mark.parametrize(("method", "order"), [("leapfrog", 2), ("suzuki4", 4), ("gauss6", 6)])
def test_order(method, order):
    flow, T = Pendulum(), 4.0
    wanted = flow.exact(T, [1.2, 0.4])
    errors = []
    steps = np.array([20, 40, 80]) // (2 if method == "gauss6" else 1)
    for n in steps:
        found = flow.symplectic(1.2, 0.4, T / n, n, method)
        errors.append(np.hypot(found.q[-1, 0] - wanted[0], found.p[-1, 0] - wanted[1]))
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("method", ["leapfrog", "suzuki4", "gauss6"])
def test_steps_are_symplectic(method):
    flow, X = Pendulum(), np.array([1.2, 0.4])

    def end(X):
        found = flow.symplectic(X[:1], X[1:], 0.3, 5, method)
        return np.array([found.q[-1, 0], found.p[-1, 0]])

    h = 1e-4
    M = np.stack([(end(X + h * e) - end(X - h * e)) / (2 * h) for e in np.eye(2)], axis=1)
    assert pytest.approx(J, abs=1e-7) == M.T @ J @ M


def test_energy_does_not_drift():
    found = Pendulum().symplectic(2.5, 0.0, 0.2, 20_000, "leapfrog", every=10)
    energy = found.energy / found.energy[0] - 1
    first, last = energy[: len(energy) // 4], energy[-len(energy) // 4 :]
    assert np.ptp(energy) > 1e-4  # an error of second order, but
    assert abs(first.mean() - last.mean()) < 1e-3 * np.ptp(energy) * 10
    assert max(abs(last.max() - first.max()), abs(last.min() - first.min())) < 0.02 * np.ptp(energy)


def test_hamiltonian_that_is_not_separable():
    flow = HamiltonianFlow(coupled, 2)
    found = flow.symplectic([0.5, 0.2], [0.3, -0.4], 0.1, 50)
    wanted = flow.solve((0.0, 5.0), [0.5, 0.2, 0.3, -0.4], rtol=1e-9, atol=1e-10).y[:, -1]
    assert np.concatenate([found.q[-1], found.p[-1]]) == pytest.approx(wanted, abs=1e-6)
    back = flow.symplectic(found.q[-1], found.p[-1], -0.1, 50)
    assert np.concatenate([back.q[-1], back.p[-1]]) == pytest.approx([0.5, 0.2, 0.3, -0.4], abs=1e-10)


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="degree"):
        HamiltonianFlow(coupled, 0)
    flow = HamiltonianFlow(coupled, 2)
    with pytest.raises(InputError, match="separable"):
        flow.symplectic([0.0, 0.0], [0.0, 0.0], 0.1, 1, "leapfrog")
    with pytest.raises(InputError, match="method"):
        flow.symplectic([0.0, 0.0], [0.0, 0.0], 0.1, 1, "euler")
    with pytest.raises(InputError, match="dt"):
        flow.symplectic([0.0, 0.0], [0.0, 0.0], 0.0, 1)
    with pytest.raises(ConvergenceError, match="smaller"):
        HamiltonianFlow(lambda q, p: float(p[0] ** 2 + q[0] ** 4), 1).symplectic(30.0, 0.0, 1.0, 1)
