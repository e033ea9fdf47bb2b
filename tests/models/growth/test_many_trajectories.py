"""Ensembles: the same trajectories as one by one, whatever the batches."""

import numpy as np
import pytest
from exact_mixture import exact_energies

from kcons.errors import BudgetError, ConstraintError, InputError
from kcons.models.growth import (
    ConstrainedGrowth,
    GrowthModel,
    HolonomicRow,
    Hypercycle,
    Populations,
    TotalPopulation,
    VelocityRow,
    solve,
    solve_ensemble,
)

TIMES = [0.0, 1.0, 6.0]


def starts(N, n=5, seed=3):
    return np.random.default_rng(seed).dirichlet(np.ones(n), N).T


@pytest.mark.parametrize("kind", ["a", "b", "c"])
def test_agrees_with_solve(kind):
    model = Hypercycle()
    system = {
        "a": model.with_fixed_total(),
        "b": model.with_entropy_production(10.0),
        "c": model.without_entropy_production(),
    }[kind]
    x0 = starts(4)
    found = solve_ensemble(system, TIMES, x0, rtol=1e-9, atol=1e-10)
    assert not found.failed.any()
    for k in range(4):
        one = solve(system, (0.0, 6.0), x0[:, k], t_eval=TIMES, rtol=1e-10, atol=1e-11)
        assert pytest.approx(one.log_y, rel=1e-7) == found.log_x[:, :, k].T


def test_neither_batches_nor_threads_change_anything():
    system, x0 = Hypercycle().with_entropy_production(10.0), starts(7)
    first = solve_ensemble(system, TIMES, x0)
    again = solve_ensemble(system, TIMES, x0, batch=3, threads=2)
    # To round-off alone: sums over stages may be taken in another order.
    assert first.log_x == pytest.approx(again.log_x, rel=1e-9)


def test_parameters_of_their_own():
    rng = np.random.default_rng(8)
    k_h, tau, kT = rng.uniform(0.5, 3.0, 3), rng.uniform(2.0, 9.0, 3), rng.uniform(0.5, 2.0, 3)
    mu0, x0 = rng.normal(size=(4, 3)), starts(3, 4)
    found = solve_ensemble(Hypercycle(4, k_h, mu0, kT).with_entropy_production(tau), TIMES, x0, batch=2, rtol=1e-10)
    for k in range(3):
        system = Hypercycle(4, k_h[k], mu0[:, k], kT[k]).with_entropy_production(tau[k])
        one = solve(system, (0.0, 6.0), x0[:, k], t_eval=TIMES, rtol=1e-11)
        assert pytest.approx(one.y, rel=1e-7, abs=1e-12) == found.x[:, :, k].T


def test_rows_hold_to_round_off():
    system, x0 = Hypercycle().with_entropy_production(10.0), starts(40)
    found = solve_ensemble(system, TIMES, x0, rtol=1e-4, atol=1e-5)
    bound = system.bind(Populations.from_values(np.zeros(40), x0))
    for t, log_x in zip(found.t, found.log_x, strict=True):
        assert abs(bound.residuals(Populations.from_logarithms(np.full(40, t), log_x))).max() < 1e-15


def test_entropy_row_where_the_excess_is_much_larger_than_the_gibbs_energy():
    # One of the million of docs/growth.md: g_0 is -1.08, a sum of terms of 70, and lies 165 above equilibrium.
    mu0, kT = [-56.5140392407906, 41.8127322553325, 13.366563603233304], 8.60383824140328
    start = np.array([[0.06724395465832678], [0.6105286479569814], [-3.357717120539264]])
    model = Hypercycle(3, 1.383051805375621, mu0, kT)
    times = np.linspace(0.1, 1.0, 10) * 10.0 / float(model.k_h)
    found = solve_ensemble(model.without_entropy_production(), times, log_x0=start, rtol=1e-6, atol=1e-8)
    total0, energy0, least = exact_energies(mu0, kT, start[:, 0])
    size = max(1.0, abs(float(energy0)))
    for log_x in found.log_x[:, :, 0]:
        total, energy, _ = exact_energies(mu0, kT, log_x)
        assert abs(float(total - total0)) < 2e-15 * size
        assert abs(float(energy - energy0)) < 1e-13 * size
        assert abs(float(energy - total * least - energy0 + total0 * least)) < 1e-13 * size


def test_those_that_settle_are_finished_at_once():
    system, x0 = Hypercycle().with_entropy_production(1.0), starts(6)
    found = solve_ensemble(system, [0.0, 5.0, 100.0, 1000.0], x0)
    assert np.all(found.settled_time < 40.0)
    excess = system.model.mixture.excess(Populations.from_logarithms(0.0, found.log_x[1]), 1.0)
    start = system.model.mixture.excess(Populations.from_values(0.0, x0), 1.0)
    assert excess == pytest.approx(start * np.exp(-5.0), rel=1e-12)
    assert found.x[3] == pytest.approx(np.repeat(np.exp(system.model.mixture.equilibrium())[:, None], 6, 1), rel=1e-15)


def test_two_species_come_to_rest():
    # Nothing turns with two species: they are finished where no excess is left that numbers could tell.
    rng = np.random.default_rng(5)
    system = Hypercycle(2, 1.0, rng.normal(size=(2, 8))).with_entropy_production(0.1)
    found = solve_ensemble(system, [1.0, 8.0, 1e4], rng.dirichlet([1.0, 1.0], 8).T, rtol=1e-6)
    assert np.all((found.settled_time > 4.5) & (found.settled_time < 100.0))
    # Thousands of steps, each no longer than round-off lets it, were it integrated on.
    assert found.steps.max() < 400
    assert found.log_x[2] == pytest.approx(system.model.mixture.equilibrium(), abs=1e-11)
    excess = system.model.mixture.excess(Populations.from_logarithms(0.0, found.log_x[0]), 1.0)
    assert np.all(excess < 2.0 * np.exp(-10.0)) and np.all(excess > 0)


def test_extinction_beyond_all_numbers_ends_at_the_least_logarithm():
    # Species 3 to 5 die for good under (c): ln x falls like -e^(lambda t) and would overflow before t = 100.
    x0 = np.array([[0.18899264, 0.01101811, 0.01901061, 0.74291806, 0.03806058]]).T
    found = solve_ensemble(Hypercycle().without_entropy_production(), [50.0, 100.0], x0 / x0.sum())
    assert not found.failed.any()
    assert np.all(np.isfinite(found.log_x))
    assert found.log_x.min() == pytest.approx(-1e300, rel=1e-3)


def test_own_model():
    model = GrowthModel(lambda t, x: np.stack([x[1] - 1.0, np.sin(t) * x[0]]), n=2, vectorized=True)
    x0 = np.array([[0.2, 0.5], [0.8, 0.1]])
    found = solve_ensemble(ConstrainedGrowth(model, TotalPopulation(2)), [2.0], x0)
    for k in range(2):
        one = solve(ConstrainedGrowth(model, TotalPopulation(2)), (0.0, 2.0), x0[:, k])
        assert found.x[0, :, k] == pytest.approx(one.y[:, -1], rel=1e-6)


def test_rates_that_turn_nan_are_marked():
    # One system of two fails; the other goes on.
    model = GrowthModel(lambda t, x: np.where((t > 0.5) & (x[0] > 0.5), np.nan, 0 * x), n=2, vectorized=True)
    found = solve_ensemble(ConstrainedGrowth(model, TotalPopulation(2)), [0.4, 1.0], [[0.6, 0.4], [0.4, 0.6]])
    assert found.failed.tolist() == [True, False]
    assert np.all(np.isnan(found.log_x[1, :, 0])) and np.all(np.isfinite(found.log_x[1, :, 1]))


def test_bad_input_is_refused():
    model, x0 = Hypercycle(), starts(3)
    with pytest.raises(InputError, match="vectorized"):
        solve_ensemble(ConstrainedGrowth(GrowthModel(lambda t, x: x, n=5)), [1.0], x0)
    with pytest.raises(InputError, match="increase"):
        solve_ensemble(model.with_fixed_total(), [1.0, 0.5], x0)
    with pytest.raises(InputError, match="before t0"):
        solve_ensemble(model.with_fixed_total(), [1.0], x0, t0=2.0)
    with pytest.raises(InputError, match="shape"):
        solve_ensemble(model.with_fixed_total(), [1.0], x0[:, 0])
    bad = x0.copy()
    bad[2, 1] = -0.1
    with pytest.raises(InputError, match="population 2 of system 1 is negative"):
        solve_ensemble(model.with_fixed_total(), [1.0], bad)
    with pytest.raises(InputError, match="either"):
        solve_ensemble(model.with_fixed_total(), [1.0])
    for option in ({"rtol": 0.0}, {"atol": np.nan}, {"t0": np.nan}, {"batch": 0}, {"threads": 0}):
        with pytest.raises(InputError, match=f"{next(iter(option))} is "):
            solve_ensemble(model.with_fixed_total(), [1.0], x0, **option)
    with pytest.raises(BudgetError):
        solve_ensemble(model.with_entropy_production(1.0, 5.0), [1.0], x0)
    fixed = ConstrainedGrowth(model, TotalPopulation(5, 1.0))
    with pytest.raises(ConstraintError, match="off row 0"):
        solve_ensemble(fixed, [1.0], 2.0 * x0)


STARTS = np.array([[0.5, 0.3], [0.2, 0.4]])


@pytest.mark.parametrize(
    ("rates", "rows"),
    [
        (lambda t, x: 1.0 - x.sum() + 0 * x, []),
        (lambda t, x: np.array([1.0, 2.0]), []),  # as many species as systems
        (lambda t, x: 0 * x, [HolonomicRow(lambda t, x: np.sum(x), vectorized=True)]),
        (lambda t, x: 0 * x, [VelocityRow([1.0, 1.0], lambda t, x: 0.1 * np.sum(x), vectorized=True)]),
    ],
    ids=["sum over all", "no axis of systems", "row", "rate of a row"],
)
def test_vectorized_functions_that_mix_systems_are_refused(rates, rows) -> None:
    system = ConstrainedGrowth(GrowthModel(rates, n=2, vectorized=True), rows)
    with pytest.raises(InputError, match=r"than alone|returned shape \(2,\)"):
        solve_ensemble(system, [1.0], STARTS)


@pytest.mark.parametrize("many", [1, 3])
def test_parameters_of_another_number_of_systems_are_refused(many: int) -> None:
    """Those that were left over were dropped; as many as species were taken for one a species."""
    starts = np.array([[0.4, 0.3], [0.3, 0.4], [0.3, 0.3]])
    values = np.linspace(1.0, 2.0, many)
    for system in (
        Hypercycle(3, k_h=values).with_fixed_total(),
        Hypercycle(3, kT=values).with_entropy_production(3.0),
        Hypercycle(3).with_entropy_production(values),
    ):
        with pytest.raises(InputError, match=f"for {many} systems side by side, the start is of 2"):
            solve_ensemble(system, [1.0], starts)
        with pytest.raises(InputError, match=f"for {many} systems side by side, the start is a single one"):
            solve(system, (0.0, 1.0), starts[:, 0])
    with pytest.raises(InputError, match="different numbers of systems"):
        Hypercycle(3, k_h=[1.0, 2.0], kT=[1.0, 2.0, 3.0])


def test_a_start_at_one() -> None:
    """All logarithms are 0, and the first step took its length from them."""
    system = ConstrainedGrowth(GrowthModel(lambda t, x: -x, n=2, vectorized=True))
    found = solve_ensemble(system, [1.0], np.ones((2, 3)))
    assert not found.failed.any()
    np.testing.assert_allclose(found.x, 0.5, rtol=1e-6)


def test_rows_that_contradict_on_the_way_end_a_trajectory() -> None:
    """From t = 1 on, two rows ask for different changes of the sum."""
    rates = lambda t, x: 0 * x + np.array([[0.1], [0.2], [0.3]])  # noqa: E731
    row = VelocityRow([1.0, 1.0, 1.0], lambda t, x: np.where(t > 1.0, 0.3, 0.0), vectorized=True)
    system = ConstrainedGrowth(GrowthModel(rates, n=3, vectorized=True), [TotalPopulation(3), row])
    found = solve_ensemble(system, [0.5, 2.0], np.ones((3, 2)))
    assert found.failed.all() and np.isfinite(found.x[0]).all() and np.isnan(found.x[1]).all()


def test_no_times() -> None:
    with pytest.raises(InputError, match="t_eval"):
        solve_ensemble(Hypercycle(3).with_fixed_total(), [], np.full((3, 1), 1 / 3))
