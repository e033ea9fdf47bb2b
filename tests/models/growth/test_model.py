"""Unconstrained growth models and what they refuse."""

import numpy as np
import pytest

from kcons.errors import InputError, NonFiniteError
from kcons.models.growth import ConstrainedGrowth, GrowthModel, Populations, solve
from kcons.models.growth.model import starting_logarithms


def test_drift_is_the_equation_of_the_notes():
    model = GrowthModel(lambda t, x: [t, x[0]], lambda t, x: [0.5, 0.0], n=2)
    p = Populations.from_values(3.0, [2.0, 4.0])
    assert model.drift(p).tolist() == [0.5 + 2.0 * 3.0, 4.0 * 2.0]
    assert model.velocity(3.0, [2.0, 4.0]).tolist() == [6.5, 8.0]


def test_field_of_a_phase_portrait_includes_negative_populations():
    model = GrowthModel(lambda t, x: [1.0 - x[1], x[0]], n=2)
    assert model.velocity(0.0, [-1.0, 3.0]).tolist() == [2.0, -3.0]


def test_functions_of_one_state_serve_many_side_by_side():
    model = GrowthModel(lambda t, x: [t, x[0]], n=2)
    p = Populations.from_values(np.array([1.0, 2.0, 3.0]), [[1.0, 2.0, 3.0], [1.0, 1.0, 1.0]])
    assert model.rates(p).tolist() == [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]]


def test_formal_solution_keeps_positive():
    # x(t) = x(0) exp(integral of phi): phi = -1e3 takes x to exp(-1e4), below the numbers of the machine.
    model = GrowthModel(lambda t, x: [-1e3], n=1)
    found = solve(ConstrainedGrowth(model), (0.0, 10.0), [1.0])
    assert found.log_y[0, -1] == pytest.approx(-1e4, rel=1e-12)
    assert found.y[0, -1] == 0.0


def test_sources_lift_tiny_populations():
    # dx/dt = s - x: x = s + (x0 - s) exp(-t).
    model = GrowthModel(lambda t, x: [-1.0], lambda t, x: [0.3], n=1)
    times = np.linspace(0.0, 5.0, 11)
    found = solve(ConstrainedGrowth(model), (0.0, 5.0), [1e-30], t_eval=times, rtol=1e-12, atol=1e-12)
    assert found.y[0] == pytest.approx(0.3 * -np.expm1(-times) + 1e-30 * np.exp(-times), rel=1e-10, abs=0)


@pytest.mark.parametrize(
    ("x0", "words"),
    [
        ([0.5, -0.1], "negative"),
        ([0.5, 0.0], "zero"),
        ([0.5, np.nan], "not finite"),
        ([[[1.0]]], "shape"),
        (["a"], "array of numbers"),
        ([0.5, 0.5 + 1e-3j], "complex"),
        (np.ma.masked_array([0.5, 0.5], mask=[0, 1]), "masked"),
    ],
)
def test_bad_populations_are_refused(x0, words):
    with pytest.raises(InputError, match=words):
        Populations.from_values(0.0, x0)


def test_functions_cannot_change_the_populations_or_return_complex_rates():
    def feeding(t, x):
        x[0] += 1.0
        return x

    for model in (GrowthModel(feeding, n=2), GrowthModel(feeding, n=2, vectorized=True)):
        x = np.array([1.0, 2.0])
        with pytest.raises(ValueError, match="read-only"):
            model.velocity(0.0, x)
        assert x.tolist() == [1.0, 2.0]
        with pytest.raises(ValueError, match="read-only"):
            model.velocity(np.zeros(3), np.ones((2, 3)))
    with pytest.raises(InputError, match="complex"):
        GrowthModel(lambda t, x: x * 1j, n=2).velocity(0.0, [1.0, 1.0])


def test_bad_models_are_refused():
    with pytest.raises(InputError, match="n is 0; give a whole number, 1 or more"):
        GrowthModel(lambda t, x: x, n=0)
    with pytest.raises(InputError, match="shape"):
        GrowthModel(lambda t, x: [1.0, 2.0, 3.0], n=2).velocity(0.0, [1.0, 1.0])
    with pytest.raises(NonFiniteError, match="source 1 is negative"):
        GrowthModel(lambda t, x: x, lambda t, x: [0.0, -1.0], n=2).velocity(0.0, [1.0, 1.0])


def test_rates_that_are_not_numbers_are_refused():
    model = GrowthModel(lambda t, x: [np.nan, 1.0], n=2)
    with pytest.raises(InputError, match=r"rate.*not finite"):
        solve(ConstrainedGrowth(model), (0.0, 1.0), [1.0, 1.0])


def test_a_start_is_given_in_one_way():
    assert starting_logarithms([1.0, np.e], None).tolist() == [0.0, 1.0]
    given = np.array([0.0, -1e6])
    found = starting_logarithms(None, given)
    assert found.tolist() == given.tolist() and found is not given
    for both in ((None, None), ([1.0], [0.0])):
        with pytest.raises(InputError, match="either as x0 or as log_x0"):
            starting_logarithms(*both)
    with pytest.raises(InputError, match="log_x0 is not finite"):
        starting_logarithms(None, [0.0, -np.inf])


def test_what_is_not_finite_is_named():
    model = GrowthModel(lambda t, x: [0.0, t], lambda t, x: [1.0 / x[0], 0.0], n=2)
    with np.errstate(all="ignore"):
        assert model.not_finite(Populations.from_values(1.0, [1.0, 1.0])) is None
        assert model.not_finite(Populations.from_values(np.inf, [1.0, 1.0])) == ("rate", 1)
        assert model.not_finite(Populations(1.0, np.zeros(2), np.full(2, -800.0))) == ("source", 0)
