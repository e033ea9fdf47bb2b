"""The constrained equation of motion against the dense formulas of the notes (eqs. 131-141)."""

import numpy as np
import pytest

from kcons.constraints import projection
from kcons.errors import ConstraintError, ContradictionError, ConvergenceError, InputError
from kcons.models.growth import (
    ConstrainedGrowth,
    GrowthModel,
    HolonomicRow,
    LinearRow,
    Populations,
    TotalPopulation,
    VelocityRow,
    solve,
)

X = np.array([0.6, 0.9, 0.2, 1.3])


def rates(t, x):
    return np.array([1.0 - x[1], x[0] - 0.3 * t, x[3], -x[2] + 0.1])


def make(*, sources=False):
    model = GrowthModel(rates, (lambda t, x: 0.1 * x**2) if sources else None, n=4)
    rows = [
        TotalPopulation(4),
        HolonomicRow(lambda t, x: x[0] * x[1] - 0.2 * t, None, lambda t, x: -0.2, name="product"),
        VelocityRow(lambda t, x: [x[1], 0.0, 1.0, t], lambda t, x: 0.05 * np.cos(t), name="velocity row"),
    ]
    return ConstrainedGrowth(model, rows)


@pytest.mark.parametrize("sources", [False, True])
def test_rows_hold_along_the_velocity(sources):
    system = make(sources=sources)
    A, b = system.rows_and_rates(0.4, X)
    assert A @ system.velocity(0.4, X) == pytest.approx(b, rel=1e-11, abs=1e-13)


@pytest.mark.parametrize("sources", [False, True])
def test_z_is_the_generalized_inverse_times_h(sources):
    system = make(sources=sources)
    z = system.constraint_rates(0.4, X)
    assert system.constrained_inverse(0.4, X) @ system.least_rate(0.4, X) == pytest.approx(z, rel=1e-10)
    A, _ = system.rows_and_rates(0.4, X)
    assert A.T @ system.multipliers(0.4, X) == pytest.approx(z, rel=1e-11)


def test_generalized_inverse_is_the_one_of_the_projected_matrix():
    system = make()
    A, _ = system.rows_and_rates(0.4, X)
    P = projection.perpendicular_projector(A)
    G = P @ np.diag(X) @ P
    assert max(projection.penrose_residuals(G, system.constrained_inverse(0.4, X))) < 1e-11


def test_bott_duffin_condition():
    system = make(sources=True)
    velocity, across = system.velocity(0.4, X), system.perpendicular_velocity(0.4, X)
    z = system.constraint_rates(0.4, X)
    A, _ = system.rows_and_rates(0.4, X)
    along = velocity - across
    assert A @ along == pytest.approx(np.zeros(3), abs=1e-12)
    assert abs(z @ along) < 1e-11 * np.linalg.norm(z) * np.linalg.norm(along)
    # G z - dx_par = h
    assert X * z - along == pytest.approx(system.least_rate(0.4, X), rel=1e-10)


def test_logarithmic_velocity_is_the_velocity_over_x():
    system = make(sources=True)
    assert X * system.logarithmic_velocity(Populations.from_values(0.4, X)) == pytest.approx(
        system.velocity(0.4, X), rel=1e-13
    )


def test_dependent_rows_change_nothing_but_the_multipliers():
    model = GrowthModel(rates, n=4)
    once = ConstrainedGrowth(model, TotalPopulation(4))
    twice = ConstrainedGrowth(model, [TotalPopulation(4), LinearRow(2 * np.ones(4))])
    assert twice.velocity(0.0, X) == pytest.approx(once.velocity(0.0, X), rel=1e-14)
    (one,) = once.multipliers(0.0, X)
    assert twice.multipliers(0.0, X) == pytest.approx([one / 5, 2 * one / 5], rel=1e-12)
    found = solve(twice, (0.0, 1.0), X)
    assert abs(found.y.sum(axis=0) - X.sum()).max() < 1e-15 * 8


def test_contradicting_rows_are_refused():
    model = GrowthModel(rates, n=4)
    system = ConstrainedGrowth(model, [TotalPopulation(4), VelocityRow(2 * np.ones(4), 0.1)])
    with pytest.raises(ContradictionError, match="row 1") as caught:
        solve(system, (0.0, 1.0), X)
    assert caught.value.rows == (1,)


def test_too_many_rows_are_refused():
    with pytest.raises(ConstraintError, match="5 rows for 4"):
        ConstrainedGrowth(GrowthModel(rates, n=4), [LinearRow(np.eye(4)[k % 4]) for k in range(5)])


def test_projection_restores_the_rows():
    system = make().bind(Populations.from_values(0.0, X))
    moved = np.log(X) + 1e-2 * np.array([1.0, -2.0, 0.5, 0.3])
    y = system.project(0.0, moved)
    assert abs(system.residuals(Populations.from_logarithms(0.0, y))).max() < 1e-15
    # The correction is A^T mu: what the rows do not see stays.
    A = np.array([r.gradient(Populations.from_values(0.0, X)) for r in system.rows if r.holonomic])
    assert (y - moved) @ projection.parallel_projector(A) == pytest.approx(np.zeros(4), abs=2e-4)
    # Many at once, at times of their own.
    times = np.array([0.0, 0.1])
    both = system.project(times, np.stack([moved, moved], axis=1))
    assert both[:, 0] == pytest.approx(y, rel=1e-14)
    assert abs(system.residuals(Populations.from_logarithms(times, both))).max() < 1e-15


def test_projection_that_cannot_succeed_says_so():
    model = GrowthModel(rates, n=4)
    row = HolonomicRow(lambda t, x: np.sum(x) ** 2 + 1.0 - t, target=1.0, name="sum squared")
    with pytest.raises(ConvergenceError, match="sum squared"):
        ConstrainedGrowth(model, row).project(-1.0, np.log(X))


def test_time_dependent_rows_are_followed():
    found = solve(make(), (0.0, 2.0), X, rtol=1e-10, atol=1e-12, dense_output=True)
    assert abs(found.residuals()).max() < 2e-15
    assert found.y[0] * found.y[1] - 0.2 * found.t == pytest.approx(np.full(len(found.t), X[0] * X[1]), abs=3e-15)
    # The velocity row is kept along the path: its integral against the trajectory.
    t = np.linspace(0.0, 2.0, 2001)
    x = found.sol(t)
    dx = np.gradient(x, t, axis=1, edge_order=2)
    held = x[1] * dx[0] + dx[2] + t * dx[3]
    assert held[5:-5] == pytest.approx(0.05 * np.cos(t[5:-5]), abs=2e-5)


def test_values_stay_along_the_velocity_of_the_rows():
    # d sigma/dt = A v - b = 0 (129, 130), by differences in time and along v: b has the sign that goes with A.
    moving = LinearRow([1.0, 0.0, 2.0, 0.0], lambda t: (1.0 + 0.3 * t**2, 0.6 * t), name="moving target")
    system = ConstrainedGrowth(make().model, [moving, make().rows[1]])
    t, h = 0.4, 1e-4
    v = system.velocity(t, X)
    bound = [row.bind(Populations.from_values(t, X)) for row in system.rows]
    for row in bound:
        ends = [float(row.value(Populations.from_values(t + s * h, X + s * h * v))) for s in (1, -1)]
        assert abs(row.rate(Populations.from_values(t, X))) > 0.1
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(0.0, abs=1e-8)


def test_literal_formulas_are_for_one_system():
    with pytest.raises(InputError, match="one system"):
        make().constrained_inverse(0.0, np.ones((4, 2)))
    with pytest.raises(InputError, match="populations"):
        make().bind(Populations.from_values(0.0, np.ones(3)))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda m: GrowthModel(lambda x: x, n=2), r"rates takes \(x\), but is called with \(t, x\)"),
        (lambda m: GrowthModel(lambda t, x: x, n=2.7), "n is 2.7; give a whole number"),
        (lambda m: HolonomicRow(3.0), r"function is 3.0; give a function of t, x"),
        (lambda m: ConstrainedGrowth(None, []), "model is None; give a"),
        (lambda m: ConstrainedGrowth(m, None), "rows is None; give rows"),
        (lambda m: ConstrainedGrowth(m, [3.0]), "rows is 3.0; give rows"),
    ],
)
def test_what_is_no_model_and_no_row_is_refused_at_once(make, said):
    with pytest.raises(InputError, match=said):
        make(GrowthModel(lambda t, x: x, n=2))


def test_coefficients_are_kept_as_they_were_given():
    given = np.ones(2)
    row = VelocityRow(given)
    given[:] = 7.0
    assert row.gradient(Populations.from_values(0.0, [0.4, 0.6])).tolist() == [1.0, 1.0]
