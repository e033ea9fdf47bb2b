"""Flows in general: Jacobians by differences, trajectories, phase volume, equilibria."""

import numpy as np
import pytest
from model_references import case

from kcons.errors import ConvergenceError, InputError
from kcons.models.flows import (
    DampedOscillator,
    Flow,
    Kind,
    LinearFlow,
    ParticleOnSphere,
    Pendulum,
    Stability,
    Thermostat,
    action,
    equilibrium_at,
    find_equilibria,
    hamiltonian,
    jacobian_by_differences,
    phase_volume,
)
from kcons.models.growth import Hypercycle, LotkaVolterra


def own(t, X):
    return np.array([np.sin(X[1]) * X[0], np.exp(-(X[0] ** 2)) + 0.1 * t * X[1]])


def own_jacobian(t, X):
    return np.array([[np.sin(X[1]), X[0] * np.cos(X[1])], [-2 * X[0] * np.exp(-(X[0] ** 2)), 0.1 * t]])


def test_jacobian_by_differences():
    X = np.array([0.4, -1.2])
    np.testing.assert_allclose(jacobian_by_differences(lambda t, X: X @ X, 0.0, 100 * X), 200 * X, rtol=1e-9)
    assert jacobian_by_differences(own, 0.5, X) == pytest.approx(own_jacobian(0.5, X), abs=1e-11)
    assert Flow(own, 2).jacobian(0.5, X) == pytest.approx(Flow(own, 2, own_jacobian).jacobian(0.5, X), abs=1e-11)
    assert Flow(own, 2).divergence(0.5, X) == pytest.approx(np.sin(-1.2) + 0.05, abs=1e-11)


def test_jacobians_by_differences_know_their_error():
    rng = np.random.default_rng(1)
    for X in rng.normal(size=(20, 2)):
        off = abs(Flow(own, 2).jacobian(0.5, X) - own_jacobian(0.5, X))
        error = Flow(own, 2).jacobian_error(0.5, X)
        assert np.all(off <= error)
        assert np.all(error < 1e-9)
    assert not Flow(own, 2, own_jacobian).jacobian_error(0.5, X).any()
    # Waves shorter than the steps: nothing is known, and said so.
    rough = Flow(lambda t, X: [np.sin(1e3 * X[0])], 1)
    assert abs(rough.jacobian(0.0, [0.1])[0, 0] - 1e3 * np.cos(100.0)) < rough.jacobian_error(0.0, [0.1])[0, 0]


@pytest.mark.parametrize("given", [True, False])
def test_volume_by_the_variational_equation_is_the_integral_of_the_divergence(given):
    flow = Flow(own, 2, own_jacobian if given else None)
    found = phase_volume(flow, [0.7, 0.3], [0.0, 1.0, 3.0])
    assert abs(found.log_volume[1:]).min() > 0.05
    assert found.log_volume == pytest.approx(found.integrated_divergence, abs=1e-9)
    # The propagator is what neighboring trajectories do.
    h = 1e-5
    ends = [flow.solve((0.0, 3.0), np.array([0.7, 0.3]) + h * e).y[:, -1] for e in (*np.eye(2), *-np.eye(2))]
    differences = np.stack([(ends[0] - ends[2]) / (2 * h), (ends[1] - ends[3]) / (2 * h)], axis=1)
    assert found.propagators[-1] == pytest.approx(differences, rel=1e-5, abs=1e-6)


def test_infinitesimal_volume():
    flow, X = Flow(own, 2, own_jacobian), np.array([0.7, 0.3])
    dt = 1e-4
    J = phase_volume(flow, X, [0.0, dt]).propagators[-1]
    assert pytest.approx(np.eye(2) + dt * own_jacobian(0.0, X), abs=2e-8) == J
    assert np.linalg.det(J) == pytest.approx(1 + dt * flow.divergence(0.0, X), abs=2e-8)


def test_examples_of_the_notes():
    # No divergence: the volume is kept; friction: e^(-eta t); Lotka-Volterra comes back to it after a period.
    assert phase_volume(Pendulum(), [2.0, 0.3], [0.0, 10.0]).log_volume[-1] == pytest.approx(0.0, abs=1e-9)
    damped = phase_volume(DampedOscillator(1.0, 0.2), [1.0, 0.0], [0.0, 10.0])
    assert damped.log_volume[-1] == pytest.approx(-2.0, rel=1e-10)
    model = LotkaVolterra()
    found = phase_volume(Flow(model.velocity, 2, model.jacobian), [1.0, 0.5], [0.0, 3.0])
    assert abs(found.log_volume[-1]) > 0.1
    assert found.log_volume[-1] == pytest.approx(found.integrated_divergence[-1], abs=1e-9)


def test_time_dependent_trajectory():
    flow = Flow(lambda t, X: [2 * t], 1)
    assert flow.solve((0.0, 3.0), [1.0]).y[0, -1] == pytest.approx(10.0, rel=1e-10)
    assert flow.solve((0.0, 3.0), [1.0], "Radau", rtol=1e-8).y[0, -1] == pytest.approx(10.0, rel=1e-7)


@pytest.mark.parametrize(
    "act",
    [
        lambda: Flow(own, 0),
        lambda: Flow(3, 2),
        lambda: Flow(lambda X: X, 2),
        lambda: find_equilibria(Pendulum(), [[0.0, 1.0]]),
        lambda: find_equilibria(Pendulum(), [[1.0, 0.0], [0.0, 1.0]]),
        lambda: find_equilibria(Pendulum(), [[0.0, 1.0]] * 2, starts=0),
        lambda: Flow(own, 2).velocity(0.0, [1.0]),
        lambda: Flow(own, 2).velocity(0.0, [1.0, np.nan]),
        lambda: Flow(lambda t, X: [1.0], 2).velocity(0.0, [1.0, 1.0]),
        lambda: Flow(own, 2, lambda t, X: [1.0]).jacobian(0.0, [1.0, 1.0]),
        lambda: phase_volume(Flow(own, 2), [1.0, 1.0], [0.0, 1.0, 0.5]),
        # What a conversion to float64 would drop: imaginary parts and masks.
        lambda: Flow(own, 2).velocity(0.0, [1.0, 1j]),
        lambda: Flow(lambda t, X: X * 1j, 2).velocity(0.0, [1.0, 1.0]),
        lambda: Flow(own, 2, lambda t, X: 1j * np.eye(2)).jacobian(0.0, [1.0, 1.0]),
        lambda: Thermostat([1.0, 1.0], lambda x: 1j * x).friction([1.0, 0.0, 1.0, 0.0]),
        lambda: ParticleOnSphere(force=lambda x: 1j * x).acceleration([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        lambda: action(lambda q, v, t: 0.0, [0.0, 1.0], [[0.0], [1j]]),
        lambda: hamiltonian(lambda q, v, t: 0.5 * v[0] ** 2, [0.0], [1j]),
    ],
)
def test_bad_input_is_refused(act):
    with pytest.raises(InputError):
        act()


def test_a_jacobian_that_is_wrong_or_cannot_be_differenced_is_refused() -> None:
    with pytest.raises(InputError, match="jacobian gives 5 for entry"):
        phase_volume(Flow(lambda t, X: -X, 1, lambda t, X: [[5.0]]), [1.0], [0.0, 1.0])
    steep = lambda t, X: [-1e-9 * np.tanh(X[0] / 1e-9)]  # noqa: E731
    with pytest.raises(InputError, match="too fast for differences: give its jacobian"):
        phase_volume(Flow(steep, 1), [1e-9], [0.0, 1.0])
    given = Flow(steep, 1, lambda t, X: [[-1 / np.cosh(X[0] / 1e-9) ** 2]])
    found = phase_volume(given, [1e-9], [0.0, 1.0], atol=1e-20)
    np.testing.assert_allclose(found.log_volume, found.integrated_divergence, rtol=1e-6)


def test_a_volume_beyond_the_digits_of_its_propagator() -> None:
    flow = LinearFlow([[-50.0, 1.0], [0.0, -1.0]])
    with pytest.raises(ConvergenceError, match="give more times"):
        phase_volume(flow, [1.0, 0.0], [0.0, 10.0])
    found = phase_volume(flow, [1.0, 0.0], np.linspace(0.0, 10.0, 51))
    assert found.log_volume[-1] == pytest.approx(-510, rel=1e-6)


# -- equilibria ------------------------------------------------------------------------------------------


def test_pendulum_alternates_between_stable_and_unstable():
    pendulum = Pendulum(1.3)
    found = find_equilibria(pendulum, [[-7.0, 7.0], [-2.0, 2.0]])
    assert [e.position[0] for e in found] == pytest.approx(np.pi * np.arange(-2, 3), abs=1e-10)
    for k, e in zip(range(-2, 3), found, strict=True):
        assert e.position == pytest.approx(pendulum.stationary_point(k), abs=1e-10)
        assert e.classification.kind is (Kind.CENTER if k % 2 == 0 else Kind.SADDLE)
        wanted = [1.3j, -1.3j] if k % 2 == 0 else [1.3, -1.3]
        assert sorted(e.classification.eigenvalues, key=lambda z: (-z.real, -z.imag)) == pytest.approx(wanted, abs=1e-9)
        # The linear flow does not decide about a center.
        assert e.classification.hyperbolic == (k % 2 == 1)


def test_lotka_volterra():
    model = LotkaVolterra(1.1, 0.4, 0.1, 0.4)
    found = find_equilibria(Flow(model.velocity, 2, model.jacobian), [[-1.0, 10.0], [-1.0, 10.0]])
    assert [e.position.tolist() for e in found] == [
        pytest.approx([0.0, 0.0], abs=1e-10),
        pytest.approx(model.equilibrium.tolist(), rel=1e-10),
    ]
    assert found[0].classification.kind is Kind.SADDLE
    assert sorted(found[0].classification.eigenvalues.real) == pytest.approx([-0.4, 1.1])
    assert found[1].classification.kind is Kind.CENTER
    assert sorted(found[1].classification.eigenvalues.imag) == pytest.approx([-np.sqrt(0.44), np.sqrt(0.44)])


def test_hypercycle_turns_unstable_with_five_species():
    system = Hypercycle(5).with_fixed_total()
    e = equilibrium_at(Flow(system.velocity, 5), np.full(5, 0.2))
    assert e.residual < 1e-15
    assert e.classification.stability is Stability.UNSTABLE
    wanted = [complex(*pair) for pair in case("A11_hypercycle_limit_cycle")["eigenvalues_at_fixed_point_tangent"]]
    off = [min(abs(e.classification.eigenvalues - w)) for w in wanted]
    assert max(off) < 1e-9


def test_many_roots_by_differences():
    flow = Flow(lambda t, X: [np.sin(X[0]) * np.cos(X[1]), np.sin(X[1])], 2)
    found = find_equilibria(flow, [[-4.0, 4.0], [-4.0, 4.0]], starts=200)
    assert len(found) == 9
    assert max(e.residual for e in found) < 1e-12
    assert {e.classification.kind for e in found} == {Kind.NODE, Kind.SADDLE}


def test_no_root_and_one_of_higher_order():
    assert find_equilibria(Flow(lambda t, X: [1.0 + X[0] ** 2], 1), [[-3.0, 3.0]]) == []
    found = find_equilibria(Flow(lambda t, X: [X[0] ** 2], 1), [[-1.0, 1.0]], tolerance=1e-8)
    assert found
    assert all(abs(e.position[0]) < 1e-3 for e in found)
    assert found[0].classification.kind in (Kind.DEGENERATE, Kind.NODE)
