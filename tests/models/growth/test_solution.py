"""`solve` has the interface of SciPy's solve_ivp, and keeps what it is told to keep."""

import numpy as np
import pytest

from kcons.errors import ContradictionError, InputError, NonFiniteError
from kcons.models.growth import (
    ConstrainedGrowth,
    GrowthModel,
    Hypercycle,
    Logistic,
    Populations,
    TotalPopulation,
    VelocityRow,
    solve,
)

X0 = np.array([0.6, 0.1, 0.1, 0.1, 0.1])


def test_a_run_goes_back_and_has_what_solve_ivp_returns():
    system, options = Hypercycle().with_fixed_total(), {"rtol": 1e-11, "atol": 1e-12}
    found = solve(system, (0.0, 10.0), X0, t_eval=[0.0, 3.0, 10.0], **options)
    back = solve(system, (3.0, 0.0), found.y[:, 1], t_eval=[2.0, 0.0], **options)
    assert back.y[:, -1] == pytest.approx(X0, rel=1e-9)
    for name in ("t", "y", "sol", "t_events", "y_events", "nfev", "njev", "nlu", "status", "message", "success"):
        assert hasattr(found, name)


@pytest.mark.parametrize("method", ["RK23", "RK45", "DOP853", "Radau", "BDF"])
def test_rows_hold_to_round_off_with_every_method(method):
    system = Hypercycle().with_entropy_production(5.0)
    found = solve(system, (0.0, 2.0), X0, method, rtol=1e-5, atol=1e-6, dense_output=True)
    assert found.success
    assert abs(found.residuals()).max() < 1e-15
    # Between the steps as well.
    times = np.linspace(0.0, 2.0, 57)
    between = found.log_sol(times)
    states = [Populations.from_logarithms(t, y) for t, y in zip(times, between.T, strict=True)]
    assert max(abs(found.system.residuals(p)).max() for p in states) < 1e-15
    fine = solve(system, (0.0, 2.0), X0, t_eval=times, rtol=1e-10, atol=1e-11)
    assert np.exp(between) == pytest.approx(fine.y, abs=2e-4)


def test_dense_output_at_one_time_and_at_many():
    found = solve(Hypercycle().with_fixed_total(), (0.0, 3.0), X0, dense_output=True)
    assert found.sol(1.5).shape == (5,)
    assert found.sol([1.5, 2.0]).shape == (5, 2)
    assert found.sol(found.t) == pytest.approx(found.y, rel=1e-12)
    assert solve(Hypercycle().with_fixed_total(), (0.0, 1.0), X0).sol is None
    # As long as no time wanted was reached, there are none.
    stop = lambda t, x: t - 0.5  # noqa: E731
    stop.terminal = True
    assert solve(Hypercycle().with_fixed_total(), (0.0, 1.0), X0, t_eval=[0.9], events=stop).y.shape == (5, 0)


def test_events():
    def half(t, x):
        return x[0] - 5.0

    def falling(t, x):
        return half(t, x)

    half.terminal, falling.direction = True, -1
    model = Logistic(1.0, 0.1)
    found = solve(ConstrainedGrowth(model), (0.0, 50.0), [1.0], events=[half, falling])
    assert found.status == 1
    assert found.t_events[0] == pytest.approx([np.log(9.0)], abs=1e-8)
    assert found.y_events[0] == pytest.approx(np.array([[5.0]]), rel=1e-8)
    assert found.t[-1] == found.t_events[0][-1] and not len(found.t_events[1])


def test_rank_that_is_lost_on_the_way_is_named():
    # The row (1, x2) becomes a multiple of (1, 1) at x2 = 1 and asks for the impossible there.
    model = GrowthModel(lambda t, x: [0.0, 0.0], n=2)
    rows = [TotalPopulation(2), VelocityRow(lambda t, x: [1.0, x[1]], 0.5)]
    with pytest.raises(ContradictionError, match=r"row 1 .* at t = 0") as caught:
        solve(ConstrainedGrowth(model, rows), (0.0, 1.0), [1.0, 1.0 + 1e-14])
    assert caught.value.rows == (1,)


def nan_from_half(t, x):
    return [np.sqrt(0.5 - t), 1.0] if t < 0.5 else [np.nan, 1.0]


@pytest.mark.parametrize("rows", [[], [TotalPopulation(2)]])
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_rates_that_turn_nan_on_the_way_are_named(rows, method):
    system = ConstrainedGrowth(GrowthModel(nan_from_half, n=2), rows)
    with pytest.raises(NonFiniteError, match=r"rate of species 0 is not finite at t = 0\.5"):
        solve(system, (0.0, 1.0), [0.5, 0.5], method, rtol=1e-5)


MODEL = GrowthModel(lambda t, x: [1.0, 2.0], n=2)


def test_rows_that_are_not_finite_are_refused_at_the_start():
    for row in (
        VelocityRow([np.nan, 1.0]),
        VelocityRow([1.0, 1.0], lambda t, x: np.nan),
        VelocityRow(lambda t, x: [1.0, np.inf]),
    ):
        with pytest.raises(NonFiniteError, match=r"row 0 \(velocity row\) has a .* that is not finite at t = 0;"):
            solve(ConstrainedGrowth(MODEL, row), (0.0, 1.0), [0.5, 0.5])


def test_tolerances_of_each_species_and_none() -> None:
    system = ConstrainedGrowth(MODEL, [TotalPopulation(2)])
    usual = solve(system, (0.0, 1.0), [0.5, 0.5]).y[:, -1]
    for options in ({"rtol": None}, {"rtol": [1e-9, 1e-9]}, {"atol": np.full(2, 1e-11)}):
        np.testing.assert_allclose(solve(system, (0.0, 1.0), [0.5, 0.5], **options).y[:, -1], usual, rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"events": 3}, "event is 3"),
        ({"events": lambda t: t}, "is called with"),
        ({"events": lambda t, x: x}, r"event returned shape \(2,\)"),
        ({"events": lambda t, x: None}, "event is no array of numbers"),
        ({"method": ["RK45"]}, "there is no method"),
        ({"t_eval": [0.5, 2.0]}, "t_eval is one-dimensional and within t_span"),
        ({"x0": None}, "either as x0 or as log_x0"),
        ({"log_x0": np.zeros(2)}, "either as x0 or as log_x0"),
        ({"x0": [0.5, 0.3, 0.2]}, "the start has populations of shape"),
        ({"x0": [1.0, -1.0]}, "population 1 is -1"),
        ({"x0": None, "log_x0": [0.0, np.nan]}, "log_x0 is not finite"),
    ],
)
def test_bad_input_is_refused(options, words):
    system = ConstrainedGrowth(MODEL, [TotalPopulation(2)])
    with pytest.raises(InputError, match=words):
        solve(system, **({"t_span": (0.0, 1.0), "x0": [0.5, 0.5]} | options))
