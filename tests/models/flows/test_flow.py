"""Flows in general: Jacobians by differences, trajectories, phase volume, equilibria; from a Lagrangian to a flow."""

from functools import partial

import numpy as np
import pytest
from model_references import case

from kcons.errors import ConvergenceError, InputError
from kcons.models import flows
from kcons.models.growth import Hypercycle, LotkaVolterra


def own(t, X):
    return np.array([np.sin(X[1]) * X[0], np.exp(-(X[0] ** 2)) + 0.1 * t * X[1]])


def own_jacobian(t, X):
    return np.array([[np.sin(X[1]), X[0] * np.cos(X[1])], [-2 * X[0] * np.exp(-(X[0] ** 2)), 0.1 * t]])


def test_jacobian_by_differences():
    X = np.array([0.4, -1.2])
    np.testing.assert_allclose(flows.jacobian_by_differences(lambda t, X: X @ X, 0.0, 100 * X), 200 * X, rtol=1e-9)
    assert flows.Flow(own, 2).jacobian(0.5, X) == pytest.approx(own_jacobian(0.5, X), abs=1e-11)
    assert flows.Flow(own, 2).divergence(0.5, X) == pytest.approx(np.sin(-1.2) + 0.05, abs=1e-11)


def test_jacobians_by_differences_know_their_error():
    rng = np.random.default_rng(1)
    for X in rng.normal(size=(20, 2)):
        off = abs(flows.Flow(own, 2).jacobian(0.5, X) - own_jacobian(0.5, X))
        error = flows.Flow(own, 2).jacobian_error(0.5, X)
        assert np.all(off <= error)
        assert np.all(error < 1e-9)
    # Waves shorter than the steps: nothing is known, and said so.
    rough = flows.Flow(lambda t, X: [np.sin(1e3 * X[0])], 1)
    assert abs(rough.jacobian(0.0, [0.1])[0, 0] - 1e3 * np.cos(100.0)) < rough.jacobian_error(0.0, [0.1])[0, 0]


@pytest.mark.parametrize("given", [True, False])
def test_volume_by_the_variational_equation_is_the_integral_of_the_divergence(given):
    flow = flows.Flow(own, 2, own_jacobian if given else None)
    found = flows.phase_volume(flow, [0.7, 0.3], [0.0, 1.0, 3.0])
    assert abs(found.log_volume[1:]).min() > 0.05
    assert found.log_volume == pytest.approx(found.integrated_divergence, abs=1e-9)
    # The propagator is what neighboring trajectories do.
    h = 1e-5
    ends = [flow.solve((0.0, 3.0), np.array([0.7, 0.3]) + h * e).y[:, -1] for e in (*np.eye(2), *-np.eye(2))]
    differences = np.stack([(ends[0] - ends[2]) / (2 * h), (ends[1] - ends[3]) / (2 * h)], axis=1)
    assert found.propagators[-1] == pytest.approx(differences, rel=1e-5, abs=1e-6)


def test_infinitesimal_volume():
    flow, X = flows.Flow(own, 2, own_jacobian), np.array([0.7, 0.3])
    dt = 1e-4
    J = flows.phase_volume(flow, X, [0.0, dt]).propagators[-1]
    assert pytest.approx(np.eye(2) + dt * own_jacobian(0.0, X), abs=2e-8) == J
    assert np.linalg.det(J) == pytest.approx(1 + dt * flow.divergence(0.0, X), abs=2e-8)


def test_examples_of_the_notes():
    # No divergence: the volume is kept; friction: e^(-eta t); Lotka-Volterra comes back to it after a period.
    assert flows.phase_volume(flows.Pendulum(), [2.0, 0.3], [0.0, 10.0]).log_volume[-1] == pytest.approx(0.0, abs=1e-9)
    damped = flows.phase_volume(flows.DampedOscillator(1.0, 0.2), [1.0, 0.0], [0.0, 10.0])
    assert damped.log_volume[-1] == pytest.approx(-2.0, rel=1e-10)
    model = LotkaVolterra()
    found = flows.phase_volume(flows.Flow(model.velocity, 2, model.jacobian), [1.0, 0.5], [0.0, 3.0])
    assert abs(found.log_volume[-1]) > 0.1
    assert found.log_volume[-1] == pytest.approx(found.integrated_divergence[-1], abs=1e-9)


def test_time_dependent_trajectory():
    flow = flows.Flow(lambda t, X: [2 * t], 1)
    assert flow.solve((0.0, 3.0), [1.0]).y[0, -1] == pytest.approx(10.0, rel=1e-10)
    assert flow.solve((0.0, 3.0), [1.0], "Radau", rtol=1e-8).y[0, -1] == pytest.approx(10.0, rel=1e-7)


def test_a_jacobian_that_is_wrong_or_cannot_be_differenced_is_refused() -> None:
    with pytest.raises(InputError, match="jacobian gives 5 for entry"):
        flows.phase_volume(flows.Flow(lambda t, X: -X, 1, lambda t, X: [[5.0]]), [1.0], [0.0, 1.0])
    steep = lambda t, X: [-1e-9 * np.tanh(X[0] / 1e-9)]  # noqa: E731
    with pytest.raises(InputError, match="too fast for differences: give its jacobian"):
        flows.phase_volume(flows.Flow(steep, 1), [1e-9], [0.0, 1.0])
    given = flows.Flow(steep, 1, lambda t, X: [[-1 / np.cosh(X[0] / 1e-9) ** 2]])
    found = flows.phase_volume(given, [1e-9], [0.0, 1.0], atol=1e-20)
    np.testing.assert_allclose(found.log_volume, found.integrated_divergence, rtol=1e-6)


def test_a_volume_beyond_the_digits_of_its_propagator() -> None:
    flow = flows.LinearFlow([[-50.0, 1.0], [0.0, -1.0]])
    with pytest.raises(ConvergenceError, match="give more times"):
        flows.phase_volume(flow, [1.0, 0.0], [0.0, 10.0])
    found = flows.phase_volume(flow, [1.0, 0.0], np.linspace(0.0, 10.0, 51))
    assert found.log_volume[-1] == pytest.approx(-510, rel=1e-6)


# -- equilibria ------------------------------------------------------------------------------------------


def test_pendulum_alternates_between_stable_and_unstable():
    pendulum = flows.Pendulum(1.3)
    found = flows.find_equilibria(pendulum, [[-7.0, 7.0], [-2.0, 2.0]])
    assert [e.position.tolist() for e in found] == [pytest.approx([k * np.pi, 0.0], abs=1e-10) for k in range(-2, 3)]
    for k, e in zip(range(-2, 3), found, strict=True):
        assert e.classification.kind is (flows.Kind.CENTER if k % 2 == 0 else flows.Kind.SADDLE)
        wanted = [1.3j, -1.3j] if k % 2 == 0 else [1.3, -1.3]
        assert sorted(e.classification.eigenvalues, key=lambda z: (-z.real, -z.imag)) == pytest.approx(wanted, abs=1e-9)
        # The linear flow does not decide about a center.
        assert e.classification.hyperbolic == (k % 2 == 1)


def test_hypercycle_turns_unstable_with_five_species():
    system = Hypercycle(5).with_fixed_total()
    e = flows.equilibrium_at(flows.Flow(system.velocity, 5), np.full(5, 0.2))
    assert e.residual < 1e-15
    assert e.classification.stability is flows.Stability.UNSTABLE
    wanted = [complex(*pair) for pair in case("A11_hypercycle_limit_cycle")["eigenvalues_at_fixed_point_tangent"]]
    off = [min(abs(e.classification.eigenvalues - w)) for w in wanted]
    assert max(off) < 1e-9


def test_many_roots_by_differences():
    flow = flows.Flow(lambda t, X: [np.sin(X[0]) * np.cos(X[1]), np.sin(X[1])], 2)
    found = flows.find_equilibria(flow, [[-4.0, 4.0], [-4.0, 4.0]], starts=200)
    assert len(found) == 9
    assert max(e.residual for e in found) < 1e-12
    assert {e.classification.kind for e in found} == {flows.Kind.NODE, flows.Kind.SADDLE}


# -- mechanics ------------------------------------------------------------------------------------------


def coupled(q, p, t):
    """Not separable."""
    return 0.5 * p[0] ** 2 * (1 + 0.3 * q[0] ** 2) + 0.5 * p[1] ** 2 + 0.5 * q[0] ** 2 + np.cos(q[1] - q[0])


def test_equations_by_differences():
    flow, X = flows.Pendulum(1.4), np.array([0.8, -0.5])
    plain = flows.HamiltonianFlow(lambda q, p, t: flow.energy([*q, *p]), 1)
    assert flow.velocity(0.0, X) == pytest.approx([1.4 * -0.5, -1.4 * np.sin(0.8)])
    assert plain.velocity(0.0, X) == pytest.approx(flow.velocity(0.0, X), abs=1e-11)
    assert plain.jacobian(0.0, X) == pytest.approx(flow.jacobian(0.0, X), abs=1e-8)


def test_divergence_vanishes():
    flow = flows.HamiltonianFlow(coupled, 2)
    for seed in range(3):
        assert abs(flow.divergence(0.0, np.random.default_rng(seed).normal(size=4))) < 1e-7


OMEGA, ETA = 1.3, 0.2


def damped():
    """Caldirola's and Kanai's H: in p = e^(eta t) dq/dt it has the motion of an oscillator with friction."""
    return flows.HamiltonianFlow(
        lambda q, p, t: np.exp(-ETA * t) * p[0] ** 2 / 2 + np.exp(ETA * t) * OMEGA**2 * q[0] ** 2 / 2,
        1,
    )


def test_flow_of_a_hamiltonian_that_depends_on_time():
    flow, X = damped(), np.array([0.8, -0.5])
    for t in (0.0, 1.5):
        slope = [np.exp(-ETA * t) * X[1], -np.exp(ETA * t) * OMEGA**2 * X[0]]
        assert flow.velocity(t, X) == pytest.approx(slope, abs=1e-10)
        assert flow.energy(X, t) == pytest.approx(flow.hamiltonian(X[:1], X[1:], t))
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
    made = flows.HamiltonianFlow(partial(flows.hamiltonian, lagrangian), 1)
    assert made.velocity(1.0, found.y[:, 1]) == pytest.approx(flow.velocity(1.0, found.y[:, 1]), abs=1e-6)


def test_user_functions_cannot_change_the_state():
    def push(t, X):
        X[0] += 1.0
        return X

    with pytest.raises(ValueError, match="read-only"):
        flows.Flow(push, 2).solve((0.0, 1.0), [1.0, 0.0])
    with pytest.raises(ValueError, match="read-only"):
        flows.Flow(lambda t, X: X, 2, push).jacobian(0.0, [1.0, 0.0])


def test_an_energy_too_fine_for_differences() -> None:
    fine = lambda q, p, t: 0.5 * p[0] ** 2 - 1e-4 * np.cos(q[0] / 1e-3)  # noqa: E731
    with pytest.raises(InputError, match="too fast for differences: give its gradient to a Flow"):
        flows.HamiltonianFlow(fine, 1).solve((0, 1e-3), [1e-3, 0.1])


# -- from a Lagrangian -----------------------------------------------------------------------------------


M, LENGTH, G = 1.3, 0.8, 9.81


def pendulum(q, v, t):
    return 0.5 * M * LENGTH**2 * v[0] ** 2 - M * G * LENGTH * (1 - np.cos(q[0]))


def polar(q, v, t):
    """A particle in the plane, in polar coordinates."""
    return 0.5 * M * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + 1.0 / q[0]


PLACE = np.array([[1.4, 0.3], [0.2, -0.9]])


def test_momentum():
    q, v = PLACE
    assert flows.momentum(polar, q, v) == pytest.approx([M * 0.2, M * 1.4**2 * -0.9], rel=1e-10)


def test_hamiltonian_is_the_energy():
    q, v = PLACE
    p = flows.momentum(polar, q, v)
    energy = p[0] ** 2 / (2 * M) + p[1] ** 2 / (2 * M * 1.4**2) - 1 / 1.4
    assert flows.hamiltonian(polar, q, p) == pytest.approx(energy, rel=1e-9)
    # T is homogeneous of order two: sum v dT/dv = 2T (54).
    T = lambda q, v, t: polar(q, v, t) - 1 / q[0]  # noqa: E731
    assert v @ flows.momentum(T, q, v) == pytest.approx(2 * T(q, v, 0.0), rel=1e-9)


def test_true_motion_obeys_lagrange():
    omega = np.sqrt(G / LENGTH)
    theta, rate = flows.Pendulum(omega).solve((0, 0.4), [1.0, 0.0]).y[:, -1]
    q, v, a = [theta], [omega * rate], [-(omega**2) * np.sin(theta)]
    assert flows.lagrange_residual(pendulum, q, v, a) == pytest.approx([0.0], abs=1e-6)
    assert abs(flows.lagrange_residual(pendulum, q, v, [a[0] + 1.0])[0] - M * LENGTH**2) < 1e-5


def test_action_is_stationary_on_the_true_path():
    t = np.linspace(0.0, 0.4, 401)
    omega = np.sqrt(G / LENGTH)
    path = flows.Pendulum(omega).solve((0, 0.4), [0.3, 0.5], t_eval=t).y[0]
    bump = np.sin(np.pi * t / 0.4)
    S = [flows.action(pendulum, t, path + e * bump) for e in (-0.02, 0.0, 0.02)]
    # Least: both neighbors are larger, by equal amounts.
    assert S[0] > S[1] < S[2]
    assert abs(S[2] - S[0]) < 1e-2 * (S[0] + S[2] - 2 * S[1])
