"""Growth models without constraints: equations, closed forms; invariants; ideal mixtures."""

import numpy as np
import pytest
from model_references import case, exact_energies
from scipy.special import rel_entr

from kcons.errors import InputError
from kcons.models.flows import Flow, jacobian_by_differences
from kcons.models.growth import ConstrainedGrowth, GrowthModel, Logistic, LotkaVolterra, Mixture, Populations, solve

MU0 = np.array([0.15, 0.2, 0.25, 0.3, 0.35])


def test_drift_is_the_equation_of_the_notes():
    model = GrowthModel(lambda t, x: [t, x[0]], lambda t, x: [0.5, 0.0], n=2)
    assert model.drift(Populations.from_values(3.0, [2.0, 4.0])).tolist() == [0.5 + 2.0 * 3.0, 4.0 * 2.0]
    assert model.velocity(3.0, [2.0, 4.0]).tolist() == [6.5, 8.0]


def test_field_of_a_phase_portrait_includes_negative_populations():
    model = GrowthModel(lambda t, x: [1.0 - x[1], np.sum(x)], n=2)
    assert model.velocity(0.0, [-1.0, 3.0]).tolist() == [2.0, 6.0]
    # State by state, whatever the functions would make of an array of them.
    assert model.velocity(0.0, [[-1.0, 1.0], [3.0, 1.0]]).tolist() == [[2.0, 0.0], [6.0, 2.0]]


def test_formal_solution_keeps_positive():
    # x(t) = x(0) exp(integral of phi): phi = -1e3 takes x to exp(-1e4), below the numbers of the machine.
    found = solve(ConstrainedGrowth(GrowthModel(lambda t, x: [-1e3], n=1)), (0.0, 10.0), [1.0])
    assert found.log_y[0, -1] == pytest.approx(-1e4, rel=1e-12)
    assert found.y[0, -1] == 0.0


def test_sources_lift_tiny_populations():
    # dx/dt = s - x: x = s + (x0 - s) exp(-t).
    model = GrowthModel(lambda t, x: [-1.0], lambda t, x: [0.3], n=1)
    times = np.linspace(0.0, 5.0, 11)
    found = solve(ConstrainedGrowth(model), (0.0, 5.0), [1e-30], t_eval=times, rtol=1e-12, atol=1e-12)
    assert found.y[0] == pytest.approx(0.3 * -np.expm1(-times) + 1e-30 * np.exp(-times), rel=1e-10, abs=0)


# -- logistic growth, Lotka-Volterra -------------------------------------------------------------------


def test_logistic_reference():
    given = case("A12_logistic")
    p, times = given["parameters"], np.array(given["times"])
    model, wanted = Logistic(p["r"], p["r"] / p["K"]), np.array(given["reference"]["x"])[:, 0]
    assert model.exact(times, 0.01) == pytest.approx(wanted, rel=1e-14)
    found = solve(ConstrainedGrowth(model), (0.0, 20.0), [0.01], t_eval=times, rtol=1e-12, atol=1e-12)
    assert found.y[0] == pytest.approx(wanted, rel=1e-10)


def test_logistic_plateau_whatever_the_start():
    model = Logistic(1.0, 0.1)
    assert [float(model.exact(800.0, x0)) for x0 in (0.01, 5.0, 30.0)] == pytest.approx([10.0] * 3, rel=1e-15)
    assert model.plateau == 10.0
    # Long before and after; before a population above the plateau was infinite there is nothing.
    np.testing.assert_array_equal(model.exact([-1e3, 1e6], 1.0), [0.0, 10.0])
    assert model.exact(-2.0, 1.0) == pytest.approx(10.0 / (1 + 9 * np.exp(2.0)), rel=1e-15)
    assert np.all(model.exact([-0.6, 5.0], 20.0) > model.plateau)
    with pytest.raises(InputError, match=r"came from infinity"):
        model.exact([0.0, -1.0], 20.0)


def lotka_volterra():
    p = case("A12_lotka_volterra")["parameters"]
    return LotkaVolterra(p["a"], p["b"], p["d"], p["c"])


def test_lotka_volterra_reference():
    given = case("A12_lotka_volterra")
    model, x0 = lotka_volterra(), given["initial"]["x"]
    found = solve(ConstrainedGrowth(model), (0.0, 100.0), x0, t_eval=given["times"], rtol=1e-13, atol=1e-13)
    assert pytest.approx(np.array(given["reference"]["x"]), rel=1e-10) == found.y.T
    assert model.invariant(found.y) == pytest.approx(np.full(6, model.invariant(x0)), rel=1e-11)
    # The reference writes G without the constants of (73).
    a, c = model.alpha1, model.beta2
    constant = a * np.log(model.equilibrium[1]) + c * np.log(model.equilibrium[0])
    assert model.invariant(x0) - constant == pytest.approx(given["conserved_G"]["value"], rel=1e-12)


def test_lotka_volterra_with_four_different_parameters():
    # No parameter equals another, so that each is seen at its own place in (69)-(77).
    model, x = LotkaVolterra(alpha1=1.1, beta1=0.4, alpha2=0.25, beta2=0.7), np.array([2.0, 3.0])
    assert model.equilibrium == pytest.approx([0.7 / 0.25, 1.1 / 0.4], rel=1e-15)
    assert model.velocity(0.0, x) == pytest.approx([2.0 * (1.1 - 0.4 * 3.0), -3.0 * (0.7 - 0.25 * 2.0)], rel=1e-14)
    assert model.velocity(0.0, model.equilibrium) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert model.jacobian(0.0, x) == pytest.approx(jacobian_by_differences(model.velocity, 0.0, x), abs=1e-11)
    divergence = Flow(model.velocity, 2, model.jacobian).divergence(0.0, x)
    assert divergence == pytest.approx((1.1 - 0.4 * 3.0) - (0.7 - 0.25 * 2.0), rel=1e-13)  # (72)
    # (77): the corners of the Jacobian there, and what their product is.
    center = model.jacobian(0.0, model.equilibrium)
    assert center == pytest.approx(np.array([[0.0, -0.4 * 0.7 / 0.25], [1.1 * 0.25 / 0.4, 0.0]]), abs=1e-15)
    assert center[0, 1] * center[1, 0] == pytest.approx(-1.1 * 0.7, rel=1e-14)
    # (73): G is stationary there, and constant along the flow.
    slopes = [jacobian_by_differences(lambda t, x: model.invariant(x), 0.0, at) for at in (model.equilibrium, x)]
    assert slopes[0] == pytest.approx([0.0, 0.0], abs=1e-11)
    assert slopes[1] @ model.velocity(0.0, x) == pytest.approx(0.0, abs=1e-11)


# -- mixtures -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", ["IC1", "IC2", "IC3sum2"])
def test_reference_states(start):
    given, mixture = case(f"A11_hypercycle_{start}_b"), Mixture(MU0)
    reference = {key: np.array(value) for key, value in given["reference"].items()}
    p, total = Populations.from_values(0.0, reference["x"].T), sum(given["initial"]["x"])
    assert pytest.approx(reference["mu"], rel=1e-12) == mixture.potentials(p).T
    assert pytest.approx(reference["M0_M1_M2"], rel=1e-12) == np.array(mixture.moments(p)).T
    assert mixture.gibbs_energy(p) == pytest.approx(reference["gibbs_g"], rel=1e-12)
    excess = [mixture.excess(Populations.from_values(0.0, x), total) for x in reference["x"]]
    assert excess == pytest.approx(reference["g_minus_geq"], rel=1e-12)
    assert np.exp(mixture.equilibrium(total)) == pytest.approx(np.array(given["x_eq"]), rel=1e-12)
    assert mixture.least_gibbs_energy(total) == pytest.approx(given["g_eq"], rel=1e-14)
    assert excess[0] == pytest.approx(given["T_times_seq_minus_s0"], rel=1e-14)


def test_excess_off_the_total_is_that_of_the_actual_sum_and_its_gradient_the_potentials():
    mixture, x = Mixture(MU0, 0.7), np.array([0.3, 0.2, 0.4, 0.1, 0.05])
    p = Populations.from_values(0.0, x)
    plain = mixture.gibbs_energy(p) - mixture.least_gibbs_energy(x.sum())
    assert mixture.excess(p, 1.0) == pytest.approx(plain, rel=1e-12)
    assert plain == pytest.approx(0.7 * rel_entr(x, np.exp(mixture.equilibrium(x.sum()))).sum(), rel=1e-12)
    gradient = mixture.potentials(p) - mixture.least_gibbs_energy(1.0)
    slopes = jacobian_by_differences(
        lambda t, x: mixture.excess(Populations.from_values(t, x), 1.0), 0.0, x, np.full(5, 1e-3)
    )
    assert gradient == pytest.approx(slopes, abs=1e-9)
    relative = mixture.relative_potentials(p)
    assert relative == pytest.approx(gradient - gradient[2], abs=1e-14)
    assert relative[2] == 0.0
    extinct = Populations.from_logarithms(0.0, np.full(5, -800.0))
    assert np.isnan(mixture.excess(extinct, 1.0))  # as trial steps find it, which are then rejected


@pytest.mark.parametrize("size", [1e-9, 0.05, 0.3, 40.0])
def test_excess_near_equilibrium_and_far_from_it(size):
    mixture = Mixture(MU0)
    log_x = mixture.equilibrium(1.0) + size * np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    p = Populations.from_logarithms(0.0, log_x - np.log(np.sum(np.exp(log_x))))
    X, g, least = exact_energies(MU0, 1.0, p.log_x)
    excess = float(g - X * least)
    rounding = 4e-16 / size  # of ln x, in which the excess is quadratic
    assert mixture.excess(p, 1.0) == pytest.approx(excess, rel=1e-14 + rounding)
