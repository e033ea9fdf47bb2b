"""Rows, the constrained equation of motion against the dense formulas of the notes (eqs. 126-141), and its runs."""

import numpy as np
import pytest

from kcons.constraints import projection
from kcons.errors import ConstraintError, ContradictionError, ConvergenceError, InputError, NonFiniteError
from kcons.models import growth
from kcons.models.growth.constrained import constraint_rates

P = growth.Populations.from_values(0.3, [0.5, 1.5, 2.5])
X = np.array([0.6, 0.9, 0.2, 1.3])


def product(t, x):
    return x[0] * x[1] ** 2 * np.exp(-t) + np.sin(x[2])


def product_gradient(t, x):
    return np.array([x[1] ** 2 * np.exp(-t), 2 * x[0] * x[1] * np.exp(-t), np.cos(x[2])])


def product_rate(t, x):
    return -x[0] * x[1] ** 2 * np.exp(-t)


# -- rows ---------------------------------------------------------------------------------------------


def test_holonomic_row():
    row = growth.HolonomicRow(product, product_gradient, product_rate)
    assert growth.HolonomicRow(product).gradient(P) == pytest.approx(product_gradient(0.3, P.x), rel=1e-12)
    assert row.rate(P) == pytest.approx(0.5 * 1.5**2 * np.exp(-0.3))
    assert growth.HolonomicRow(product).rate(P) == 0.0
    assert row.bind(P).value(P) == 0.0
    with pytest.raises(ConstraintError, match="no target"):
        growth.HolonomicRow(product).value(P)


def test_velocity_row():
    row = growth.VelocityRow(lambda t, x: [t, x[0], 1.0], lambda t, x: x[1])
    assert row.gradient(P).tolist() == [0.3, 0.5, 1.0]
    assert row.rate(P) == 1.5


def hill(power, *, given=False):
    gradient = lambda t, x: [power * x[0] ** (power - 1) / (1 + x[0] ** power) ** 2, 1.0]  # noqa: E731
    return growth.HolonomicRow(lambda t, x: x[0] ** power / (1 + x[0] ** power) + x[1], gradient if given else None)


def test_differences_that_cannot_serve_are_refused():
    """And derivatives that are right are not, only since differences are too coarse for them."""
    p = growth.Populations.from_values(0.0, [1.02, 0.3])
    for power in (20, 60, 100):
        found, exact = (hill(power, given=given).gradient(p) for given in (False, True))
        np.testing.assert_allclose(found, exact, rtol=2e-7)
    with pytest.raises(InputError, match="changes too fast for differences: give its gradient"):
        hill(400).bind(p)
    hill(400, given=True).bind(p)
    growth.TotalPopulation(2, lambda t: (1.32 + 1e-3 * np.sin(1e5 * t), 1e2 * np.cos(1e5 * t))).bind(p)
    with pytest.raises(InputError, match="total population changes with time by"):
        growth.TotalPopulation(2, lambda t: (1.32 + 1e-3 * np.sin(1e5 * t), 2e2 * np.cos(1e5 * t))).bind(p)


# -- z of rows ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [1, 2, 3, 4])
def test_agrees_with_the_dense_formula(m):
    rng = np.random.default_rng(m)
    x, A, b, drift = rng.random(6) + 0.1, rng.normal(size=(m, 6)), rng.normal(size=m), rng.normal(size=6)
    z, _ = constraint_rates(x, list(A), list(b), drift)
    assert z == pytest.approx(A.T @ np.linalg.solve(A * x @ A.T, b - A @ drift), rel=1e-11)
    assert pytest.approx(b, rel=1e-11) == A @ (drift + x * z)


@pytest.mark.parametrize("apart", [1e-3, 1e-6, 1e-9])
def test_nearly_parallel_rows_stay_orthogonal(apart):
    # Once orthogonalized, a row that is parallel to another but for `apart` keeps 1e-16/apart of it: the velocity would
    # be off the first row by that much.
    rng = np.random.default_rng(3)
    x, drift = rng.random(6) + 0.1, rng.normal(size=6)
    rows, right = [np.ones(6), np.ones(6) + apart * rng.normal(size=6)], [0.3, 0.3 + apart * 0.7]
    found, _ = constraint_rates(x, rows, right, drift)
    velocity = drift + x * found
    # Sums of six terms, each rounded: six half units in the last place of what is summed, and one for the terms.
    rounding = 4 * np.finfo(float).eps * (np.abs(drift) + np.abs(x * found)).sum()
    assert abs(velocity.sum() - right[0]) < rounding
    assert abs(rows[1] @ velocity - right[1]) < rounding
    # The same two conditions on combinations of the same rows, in which nothing is nearly parallel.
    apart_rows, difference = [rows[0], (rows[1] - rows[0]) / apart], (right[1] - right[0]) / apart
    z, _ = constraint_rates(x, apart_rows, [right[0], difference], drift)
    assert found == pytest.approx(z, abs=1e-15 / apart * abs(z).max())


@pytest.mark.parametrize(("apart", "dependent"), [(4e-12, False), (2.5e-13, True)])
def test_rows_count_as_dependent_below_a_part_in_a_million_million(apart, dependent):
    # The length of the second row across the first is `apart` of its own.
    rows = [np.ones(4), np.ones(4) + apart * np.array([1.0, -1.0, 1.0, -1.0])]
    _, missing = constraint_rates(np.full(4, 0.25), rows, [0.4, 0.4], np.array([0.1, 0.2, -0.3, 0.4]))
    assert np.isfinite(missing).tolist() == [False, dependent]


@pytest.mark.parametrize(("off", "refused"), [(4e-10, False), (2.5e-9, True)])
def test_dependent_rows_may_disagree_by_a_part_in_a_thousand_million(off, refused):
    rows = [
        growth.TotalPopulation(2, lambda t: (1.0, 1.0)),
        growth.VelocityRow(lambda t, x: [1.0, 1.0], lambda t, x: 1.0 + off),
    ]
    system = growth.ConstrainedGrowth(growth.GrowthModel(lambda t, x: 0.0 * x, n=2), rows)
    if refused:
        with pytest.raises(ContradictionError, match="row 1") as caught:
            system.velocity(0.0, [0.5, 0.5])
        assert caught.value.rows == (1,)
    else:
        assert system.velocity(0.0, [0.5, 0.5]) == pytest.approx([0.5, 0.5], rel=1e-14)


# -- the system ---------------------------------------------------------------------------------------


def rates(t, x):
    return np.array([1.0 - x[1], x[0] - 0.3 * t, x[3], -x[2] + 0.1])


def make(*, sources=False):
    model = growth.GrowthModel(rates, (lambda t, x: 0.1 * x**2) if sources else None, n=4)
    rows = [
        growth.TotalPopulation(4),
        growth.HolonomicRow(lambda t, x: x[0] * x[1] - 0.2 * t, None, lambda t, x: -0.2, name="product"),
        growth.VelocityRow(lambda t, x: [x[1], 0.0, 1.0, t], lambda t, x: 0.05 * np.cos(t), name="velocity row"),
    ]
    return growth.ConstrainedGrowth(model, rows)


@pytest.mark.parametrize("sources", [False, True])
def test_rows_hold_along_the_velocity(sources):
    system = make(sources=sources)
    A, b = system.rows_and_rates(0.4, X)
    assert A @ system.velocity(0.4, X) == pytest.approx(b, rel=1e-11, abs=1e-13)
    slope = system.logarithmic_velocity(growth.Populations.from_values(0.4, X))
    assert X * slope == pytest.approx(system.velocity(0.4, X), rel=1e-13)


@pytest.mark.parametrize("sources", [False, True])
def test_z_is_the_generalized_inverse_times_h(sources):
    system = make(sources=sources)
    z = system.constraint_rates(0.4, X)
    assert system.constrained_inverse(0.4, X) @ system.least_rate(0.4, X) == pytest.approx(z, rel=1e-10)
    assert system.rows_and_rates(0.4, X)[0].T @ system.multipliers(0.4, X) == pytest.approx(z, rel=1e-11)


def test_generalized_inverse_is_the_one_of_the_projected_matrix():
    P_perp = projection.perpendicular_projector(make().rows_and_rates(0.4, X)[0])
    G_perp = P_perp @ np.diag(X) @ P_perp
    assert max(projection.penrose_residuals(G_perp, make().constrained_inverse(0.4, X))) < 1e-11


def test_bott_duffin_condition():
    system = make(sources=True)
    along = system.velocity(0.4, X) - system.perpendicular_velocity(0.4, X)
    z = system.constraint_rates(0.4, X)
    assert system.rows_and_rates(0.4, X)[0] @ along == pytest.approx(np.zeros(3), abs=1e-12)
    assert abs(z @ along) < 1e-11 * np.linalg.norm(z) * np.linalg.norm(along)
    # G z - dx_par = h
    assert X * z - along == pytest.approx(system.least_rate(0.4, X), rel=1e-10)


def test_dependent_rows_change_nothing_but_the_multipliers():
    model = growth.GrowthModel(rates, n=4)
    once = growth.ConstrainedGrowth(model, growth.TotalPopulation(4))
    twice = growth.ConstrainedGrowth(model, [growth.TotalPopulation(4), growth.LinearRow(2 * np.ones(4))])
    assert twice.velocity(0.0, X) == pytest.approx(once.velocity(0.0, X), rel=1e-14)
    (one,) = once.multipliers(0.0, X)
    assert twice.multipliers(0.0, X) == pytest.approx([one / 5, 2 * one / 5], rel=1e-12)
    assert abs(growth.solve(twice, (0.0, 1.0), X).y.sum(axis=0) - X.sum()).max() < 1e-15 * 8


def test_systems_that_cannot_be_held_are_refused():
    model = growth.GrowthModel(rates, n=4)
    with pytest.raises(ContradictionError, match="row 1") as caught:
        growth.solve(
            growth.ConstrainedGrowth(
                model, [growth.TotalPopulation(4), growth.VelocityRow(lambda t, x: 2 * np.ones(4), lambda t, x: 0.1)]
            ),
            (0.0, 1.0),
            X,
        )
    assert caught.value.rows == (1,)
    with pytest.raises(ConstraintError, match="5 rows for 4"):
        growth.ConstrainedGrowth(model, [growth.LinearRow(np.eye(4)[k % 4]) for k in range(5)])
    system = growth.ConstrainedGrowth(model, [growth.TotalPopulation(4), growth.LinearRow([1.0, 0.0, 0.0, 0.0], 0.7)])
    with pytest.raises(ConstraintError, match=r"off row 1 \(linear row\)") as caught:
        growth.solve(system, (0.0, 1.0), X)
    assert caught.value.rows == (1,)


def test_projection_restores_the_rows():
    system = make().bind(growth.Populations.from_values(0.0, X))
    moved = np.log(X) + 1e-2 * np.array([1.0, -2.0, 0.5, 0.3])
    y = system.project(0.0, moved)
    assert abs(system.residuals(growth.Populations.from_logarithms(0.0, y))).max() < 1e-15
    # The correction is A^T mu: what the rows do not see stays.
    A = np.array([r.gradient(growth.Populations.from_values(0.0, X)) for r in system.rows if r.holonomic])
    assert (y - moved) @ projection.parallel_projector(A) == pytest.approx(np.zeros(4), abs=2e-4)
    row = growth.HolonomicRow(lambda t, x: np.sum(x) ** 2 + 1.0 - t, target=1.0, name="sum squared")
    with pytest.raises(ConvergenceError, match="sum squared"):
        growth.ConstrainedGrowth(growth.GrowthModel(rates, n=4), row).project(-1.0, np.log(X))


def test_time_dependent_rows_are_followed():
    found = growth.solve(make(), (0.0, 2.0), X, rtol=1e-10, atol=1e-12, dense_output=True)
    states = [growth.Populations.from_logarithms(t, y) for t, y in zip(found.t, found.log_y.T, strict=True)]
    assert max(abs(found.system.residuals(p)).max() for p in states) < 2e-15
    assert found.y[0] * found.y[1] - 0.2 * found.t == pytest.approx(np.full(len(found.t), X[0] * X[1]), abs=3e-15)
    # The velocity row is kept along the path: its integral against the trajectory.
    t = np.linspace(0.0, 0.5, 501)
    x = found.sol(t)
    dx = np.gradient(x, t, axis=1, edge_order=2)
    held = x[1] * dx[0] + dx[2] + t * dx[3]
    assert held[5:-5] == pytest.approx(0.05 * np.cos(t[5:-5]), abs=2e-5)


def test_values_stay_along_the_velocity_of_the_rows():
    # d sigma/dt = A v - b = 0 (129, 130), by differences in time and along v: b has the sign that goes with A.
    moving = growth.LinearRow([1.0, 0.0, 2.0, 0.0], lambda t: (1.0 + 0.3 * t**2, 0.6 * t), name="moving target")
    system = growth.ConstrainedGrowth(make().model, [moving, make().rows[1]])
    t, h = 0.4, 1e-4
    v, p = system.velocity(t, X), growth.Populations.from_values(t, X)
    for row in [row.bind(p) for row in system.rows]:
        ends = [row.value(growth.Populations.from_values(t + s * h, X + s * h * v)) for s in (1, -1)]
        assert abs(row.rate(p)) > 0.1
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(0.0, abs=1e-8)


# -- runs ------------------------------------------------------------------------------------------------


START = np.array([0.6, 0.1, 0.1, 0.1, 0.1])


def test_a_run_goes_back_and_has_what_solve_ivp_returns():
    system, options = growth.Hypercycle().with_fixed_total(), {"rtol": 1e-11, "atol": 1e-12}
    found = growth.solve(system, (0.0, 10.0), START, t_eval=[0.0, 3.0, 10.0], **options)
    back = growth.solve(system, (3.0, 0.0), found.y[:, 1], t_eval=[2.0, 0.0], **options)
    assert back.y[:, -1] == pytest.approx(START, rel=1e-9)
    for name in ("t", "y", "sol", "t_events", "y_events", "nfev", "njev", "nlu", "status", "message", "success"):
        assert hasattr(found, name)


def test_dense_output_at_one_time_and_at_many():
    found = growth.solve(growth.Hypercycle().with_fixed_total(), (0.0, 3.0), START, dense_output=True)
    assert found.sol(1.5).shape == (5,)
    assert found.sol([1.5, 2.0]).shape == (5, 2)
    assert found.sol(found.t) == pytest.approx(found.y, rel=1e-12)
    assert growth.solve(growth.Hypercycle().with_fixed_total(), (0.0, 1.0), START).sol is None
    # As long as no time wanted was reached, there are none.
    stop = lambda t, x: t - 0.5  # noqa: E731
    stop.terminal = True
    assert growth.solve(
        growth.Hypercycle().with_fixed_total(), (0.0, 1.0), START, t_eval=[0.9], events=stop
    ).y.shape == (5, 0)


def test_events():
    half = lambda t, x: x[0] - 5.0  # noqa: E731
    half.terminal = True
    found = growth.solve(growth.ConstrainedGrowth(growth.Logistic(1.0, 0.1)), (0.0, 50.0), [1.0], events=half)
    assert found.status == 1 and found.t[-1] == found.t_events[0][-1]
    assert found.t_events[0] == pytest.approx([np.log(9.0)], abs=1e-8)
    assert found.y_events[0] == pytest.approx(np.array([[5.0]]), rel=1e-8)


def nan_from_half(t, x):
    return [np.sqrt(0.5 - t), 1.0] if t < 0.5 else [np.nan, 1.0]


@pytest.mark.parametrize("rows", [[], [growth.TotalPopulation(2)]])
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_rates_that_turn_nan_on_the_way_are_named(rows, method):
    system = growth.ConstrainedGrowth(growth.GrowthModel(nan_from_half, n=2), rows)
    with pytest.raises(NonFiniteError, match=r"rate of species 0 is not finite at t = 0\.5"):
        growth.solve(system, (0.0, 1.0), [0.5, 0.5], method, rtol=1e-5)


TWO = growth.GrowthModel(lambda t, x: [1.0, 2.0], n=2)


def test_tolerances_of_each_species_and_none() -> None:
    system = growth.ConstrainedGrowth(TWO, [growth.TotalPopulation(2)])
    usual = growth.solve(system, (0.0, 1.0), [0.5, 0.5]).y[:, -1]
    with pytest.raises(InputError, match="population 1 is 0; populations are positive"):
        growth.solve(system, (0.0, 1.0), [0.5, 0.0])
    for options in ({"rtol": None}, {"rtol": [1e-9, 1e-9]}, {"atol": np.full(2, 1e-11)}):
        np.testing.assert_allclose(growth.solve(system, (0.0, 1.0), [0.5, 0.5], **options).y[:, -1], usual, rtol=1e-12)
