"""Logistic growth and Lotka-Volterra against closed form, invariant and reference."""

import numpy as np
import pytest
from growth_reference import case

from kcons.errors import InputError
from kcons.models.growth import ConstrainedGrowth, HolonomicRow, Logistic, LotkaVolterra, solve


def test_logistic_reference():
    given = case("A12_logistic")
    p = given["parameters"]
    model = Logistic(p["r"], p["r"] / p["K"])
    wanted = np.array(given["reference"]["x"])[:, 0]
    times = np.array(given["times"])
    assert model.exact(times, 0.01) == pytest.approx(wanted, rel=1e-14)
    found = solve(ConstrainedGrowth(model), (0.0, 20.0), [0.01], t_eval=times, rtol=1e-12, atol=1e-12)
    assert found.y[0] == pytest.approx(wanted, rel=1e-10)


def test_logistic_plateau_whatever_the_start():
    model = Logistic(1.0, 0.1)
    for x0 in (0.01, 5.0, 30.0):
        assert model.exact(800.0, x0) == pytest.approx(model.plateau, rel=1e-15)
    assert model.plateau == 10.0
    assert model.jacobian(0.0, [model.plateau]).tolist() == [[-1.0]]


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


def test_row_that_is_conserved_anyway_does_nothing():
    model, x0 = lotka_volterra(), np.array([10.0, 5.0])
    row = HolonomicRow(lambda t, x: model.invariant(x), lambda t, x: model.invariant_gradient(x), name="G")
    held = ConstrainedGrowth(model, row)
    assert abs(held.constraint_rates(0.0, x0)).max() < 1e-12
    found = solve(held, (0.0, 50.0), x0, rtol=1e-6, atol=1e-6)
    assert abs(found.residuals()).max() < 1e-13
    free = solve(ConstrainedGrowth(model), (0.0, 50.0), x0, rtol=1e-6, atol=1e-6)
    assert np.ptp(model.invariant(free.y)) > 1e-6  # what the row is good for


def test_lotka_volterra_derivatives():
    model, x = lotka_volterra(), np.array([2.0, 3.0])
    h = 1e-6
    differences = np.stack(
        [(model.velocity(0.0, x + h * e) - model.velocity(0.0, x - h * e)) / (2 * h) for e in np.eye(2)], axis=1
    )
    assert model.jacobian(0.0, x) == pytest.approx(differences, abs=1e-9)
    assert model.divergence(x) == pytest.approx(np.trace(model.jacobian(0.0, x)))
    slopes = [(model.invariant(x + h * e) - model.invariant(x - h * e)) / (2 * h) for e in np.eye(2)]
    assert model.invariant_gradient(x) == pytest.approx(np.array(slopes), abs=1e-9)
    assert model.velocity(0.0, model.equilibrium) == pytest.approx([0.0, 0.0], abs=1e-15)


def test_lotka_volterra_with_four_different_parameters():
    # Each parameter at its own place in (69)-(77), none equal to another.
    model = LotkaVolterra(alpha1=1.1, beta1=0.4, alpha2=0.25, beta2=0.7)
    assert model.equilibrium == pytest.approx([0.7 / 0.25, 1.1 / 0.4], rel=1e-15)
    x = np.array([2.0, 3.0])
    assert model.velocity(0.0, x) == pytest.approx([2.0 * (1.1 - 0.4 * 3.0), -3.0 * (0.7 - 0.25 * 2.0)], rel=1e-14)
    assert model.velocity(0.0, model.equilibrium) == pytest.approx([0.0, 0.0], abs=1e-15)
    h = 1e-6
    columns = [(model.velocity(0.0, x + h * e) - model.velocity(0.0, x - h * e)) / (2 * h) for e in np.eye(2)]
    assert model.jacobian(0.0, x) == pytest.approx(np.stack(columns, axis=1), abs=1e-9)
    assert model.divergence(x) == pytest.approx(np.trace(model.jacobian(0.0, x)), rel=1e-14)
    # (77): the corners of the Jacobian there, and what their product is.
    centre = model.jacobian(0.0, model.equilibrium)
    assert centre == pytest.approx(np.array([[0.0, -0.4 * 0.7 / 0.25], [1.1 * 0.25 / 0.4, 0.0]]), abs=1e-15)
    assert centre[0, 1] * centre[1, 0] == pytest.approx(-1.1 * 0.7, rel=1e-14)
    # (73): G is stationary there, and constant along the flow.
    assert model.invariant_gradient(model.equilibrium) == pytest.approx([0.0, 0.0], abs=1e-15)
    assert model.invariant_gradient(x) @ model.velocity(0.0, x) == pytest.approx(0.0, abs=1e-14)
    slopes = [(model.invariant(x + h * e) - model.invariant(x - h * e)) / (2 * h) for e in np.eye(2)]
    assert model.invariant_gradient(x) == pytest.approx(slopes, abs=1e-9)


@pytest.mark.parametrize(
    "make", [lambda: Logistic(0.0), lambda: Logistic(1.0, -1.0), lambda: LotkaVolterra(beta2=np.nan)]
)
def test_bad_parameters_are_refused(make):
    with pytest.raises(InputError):
        make()


def test_logistic_growth_did_not_begin_before_its_population_was_infinite():
    model = Logistic(1.0, 0.1)
    assert np.all(model.exact([-0.6, 5.0], 20.0) > model.plateau)
    with pytest.raises(InputError, match=r"x = 20 at t = 0 came from infinity at t = -0\.693147; give later times"):
        model.exact([0.0, -1.0], 20.0)


def test_long_before_and_after() -> None:
    np.testing.assert_array_equal(Logistic(1.0, 0.1).exact([-1e4, 1e6], 1.0), [0.0, 10.0])
    assert Logistic(1.0, 0.1).exact(-2.0, 1.0) == pytest.approx(10.0 / (1 + 9 * np.exp(2.0)), rel=1e-15)


@pytest.mark.parametrize(
    ("make", "item"),
    [
        (lambda: Logistic("1"), "alpha"),
        (lambda: LotkaVolterra([1.0, 2.0]), "alpha1"),
        (lambda: Logistic().exact(1.0, [1.0, 2.0]), "x0"),
        (lambda: Logistic().exact(1.0, -1.0), "x0"),
    ],
)
def test_parameters_of_other_kinds(make, item: str) -> None:
    with pytest.raises(InputError, match=item):
        make()
