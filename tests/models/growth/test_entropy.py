"""Laws of entropy production: budgets that fit the start, and those that are refused."""

import numpy as np
import pytest
from scipy.integrate import simpson

from kcons.errors import BudgetError, InputError
from kcons.models.growth import (
    EntropyRow,
    Hypercycle,
    Mixture,
    NoProduction,
    Populations,
    PrescribedProduction,
    Relaxation,
    entropy_balance,
    solve,
)

X0 = np.array([0.6, 0.1, 0.1, 0.1, 0.1])
BUDGET = 0.3344071481541323
START = Populations.from_values(0.0, X0)


def test_budget_is_computed_from_the_start():
    row = Hypercycle().with_entropy_production(30.0).bind(START).entropy_row
    assert row.excess0 == pytest.approx(BUDGET, rel=1e-14)
    assert row.law_excess(60.0) == pytest.approx(BUDGET * np.exp(-2.0), rel=1e-14)
    # One that agrees with the start is taken as such.
    same = Hypercycle().with_entropy_production(30.0, BUDGET * (1 + 1e-12)).bind(START).entropy_row
    assert same.law_excess(1e4) == pytest.approx(BUDGET * np.exp(-1e4 / 30), rel=1e-9)


@pytest.mark.parametrize(("factor", "time"), [(1.1, 71.94), (1.5, 32.96)])
def test_too_large_a_budget_is_refused_with_its_time(factor, time):
    with pytest.raises(BudgetError, match=r"more than the start can produce") as caught:
        solve(Hypercycle().with_entropy_production(30.0, factor * BUDGET), (0.0, 1.0), X0)
    assert caught.value.time == pytest.approx(time, abs=0.005)
    assert f"t = {caught.value.time:.6g}" in str(caught.value)
    assert caught.value.consistent == pytest.approx(BUDGET)


def test_too_small_a_budget_must_be_meant():
    with pytest.raises(BudgetError, match="partial=True") as caught:
        Hypercycle().with_entropy_production(30.0, 0.5 * BUDGET).bind(START)
    assert caught.value.time == np.inf
    system = Hypercycle().with_entropy_production(2.0, 0.5 * BUDGET, partial=True)
    found = solve(system, (0.0, 60.0), X0, t_eval=[0.0, 4.0, 60.0])
    excess = system.model.mixture.excess(Populations.from_logarithms(found.t, found.log_y), 1.0)
    assert excess == pytest.approx(BUDGET * (0.5 + 0.5 * np.exp(-found.t / 2.0)), abs=1e-14)


@pytest.mark.parametrize("law", ["relaxation", "none", "own"])
def test_entropy_produced_is_the_integral_of_its_rate(law):
    model = Hypercycle()
    own = PrescribedProduction(lambda t: 0.1 * np.sin(t) ** 2, lambda t: 0.1 * np.sin(2 * t), until=4.0)
    system = {
        "relaxation": model.with_entropy_production(3.0),
        "none": model.without_entropy_production(),
        "own": model.with_law(own),
    }[law]
    found = solve(system, (0.0, 4.0), X0, dense_output=True)
    balance = entropy_balance(found, nodes=5)
    wanted = {"relaxation": BUDGET * -np.expm1(-4.0 / 3.0), "none": 0.0, "own": 0.1 * np.sin(4.0) ** 2}[law]
    assert balance.prescribed == pytest.approx(wanted, abs=1e-14)
    assert balance.lost == pytest.approx(wanted, abs=1e-13)
    assert balance.integrated == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("law", ["relaxation", "none"])
def test_entropy_produced_inside_and_exchanged(law):
    # (145): dS = dS_int + dS_ext, along the trajectory, with the rates of (142) and z of (153) written out.
    model = Hypercycle()
    system = model.with_entropy_production(3.0) if law == "relaxation" else model.without_entropy_production()
    found = solve(system, (0.0, 4.0), X0, dense_output=True)
    balance = entropy_balance(found, nodes=5)
    t = np.linspace(0.0, 4.0, 4001)
    x = found.sol(t)
    mu = (0.1 + 0.05 * np.arange(1, 6))[:, None] + np.log(x / x.sum(axis=0))
    inside = -np.sum(mu * 3.0 * x * np.roll(x, -1, axis=0), axis=0)
    outside = -np.sum(mu * x * np.stack([system.constraint_rates(s, v) for s, v in zip(t, x.T, strict=True)]).T, axis=0)
    assert balance.reactions == pytest.approx(simpson(inside, x=t), abs=1e-7)
    assert balance.exchanged == pytest.approx(simpson(outside, x=t), abs=1e-7)
    assert abs(balance.exchanged) > 0.1
    # What an open system produces it gives away; what a closed one produces is the sum.
    total = 0.0 if law == "none" else BUDGET * -np.expm1(-4.0 / 3.0)
    assert balance.reactions + balance.exchanged == pytest.approx(total, abs=1e-9)


def test_balance_needs_a_row_and_an_interpolant():
    with pytest.raises(InputError, match="no row"):
        entropy_balance(solve(Hypercycle().with_fixed_total(), (0.0, 0.1), X0, dense_output=True))
    with pytest.raises(InputError, match="dense_output"):
        entropy_balance(solve(Hypercycle().without_entropy_production(), (0.0, 0.1), X0))


def test_prescriptions_are_checked_before_the_run():
    with pytest.raises(InputError, match="integral of the rate"):
        PrescribedProduction(lambda t: t, lambda t: 2.0, until=1.0)
    with pytest.raises(InputError, match="t = 0"):
        PrescribedProduction(lambda t: 1.0 + t, lambda t: 1.0, until=1.0)
    with pytest.raises(InputError, match="until"):
        PrescribedProduction(lambda t: t, lambda t: 1.0, until=0.0)
    model = Hypercycle()
    steady = PrescribedProduction(lambda t: 0.1 * t, lambda t: 0.1, until=10.0)
    with pytest.raises(BudgetError, match="equilibrium") as caught:
        solve(model.with_law(steady), (0.0, 1.0), X0)
    assert caught.value.time == pytest.approx(BUDGET / 0.1, abs=0.01)
    fed = PrescribedProduction(lambda t: -0.1 * t, lambda t: -0.1, until=100.0)
    with pytest.raises(BudgetError, match="give up") as caught:
        solve(model.with_law(fed), (0.0, 1.0), X0)
    # g is largest with the last species alone: 0.35.
    assert caught.value.time == pytest.approx((0.35 + 1.0275294114572127) / 0.1, abs=0.1)


@pytest.mark.parametrize(
    "make",
    [lambda: Relaxation(0.0), lambda: Relaxation(-1.0), lambda: Relaxation(np.nan), lambda: Relaxation(1.0, -0.1)],
)
def test_bad_relaxations_are_refused(make):
    with pytest.raises(InputError):
        make()


def test_production_law_of_the_notes():
    law = Relaxation(30.0)
    t = np.array([0.0, 15.0, 300.0])
    assert law.produced(t, np.float64(0.5)) == pytest.approx(0.5 * (1 - np.exp(-t / 30.0)), rel=1e-14)
    assert law.excess_rate(0.0, np.float64(0.5), np.float64(0.5)) == pytest.approx(-0.5 / 30.0)
    assert NoProduction().produced(t, np.float64(0.5)).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("span", [(0.0, 3.0), (1.0, 0.0)], ids=["beyond", "before"])
def test_a_prescribed_production_is_held_where_it_was_checked(span) -> None:
    law = PrescribedProduction(lambda t: 0.01 * t, lambda t: 0.01, until=1.0)
    with pytest.raises(InputError, match="known from the start until 1 after it"):
        solve(Hypercycle(3).with_law(law), span, [0.2, 0.3, 0.5])
    assert solve(Hypercycle(3).with_law(law), (1e6, 1e6 + 1), [0.2, 0.3, 0.5]).success


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Relaxation(3.0, "all"), "budget is 'all'"),
        (lambda: PrescribedProduction(1.0, lambda t: 1.0, until=1.0), "produced is 1.0"),
        (lambda: PrescribedProduction(lambda t: t, lambda: 1.0, until=1.0), "rate takes"),
        (lambda: PrescribedProduction(lambda t: t, lambda t: 1.0, until="end"), "until is 'end'"),
        (lambda: EntropyRow(3, Relaxation(1.0)), "mixture is 3"),
        (lambda: EntropyRow(Mixture([0.1, 0.2]), 3.0), "law is 3.0"),
        (lambda: EntropyRow(Mixture([0.1, 0.2]), Relaxation(1.0)).bind(START), "the mixture has 2 species"),
        (lambda: Mixture([]), "mu0 has shape"),
        (lambda: Mixture(np.ones((3, 4)), [1.0, 2.0]), "different numbers of systems"),
        (lambda: Mixture([0.1, 0.2], np.ones((2, 2))), "kT is positive"),
        (lambda: Hypercycle("5"), "n is '5'"),
        (lambda: Hypercycle(np.nan), "n is nan"),
        (lambda: Hypercycle(3, np.ones((2, 2))), "k_h"),
    ],
)
def test_arguments_of_other_kinds(make, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
