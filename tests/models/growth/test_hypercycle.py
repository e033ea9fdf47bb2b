"""The hypercycle against reference and closed form; laws of entropy production; arrival, extinction and return."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from model_references import case, exact_energies, system
from scipy.integrate import simpson

from kcons.errors import BudgetError
from kcons.models.growth import EntropyRow, Hypercycle, Mixture, Populations, entropy_balance, solve

STARTS = ("IC1", "IC2", "IC3sum2")
CASES = [f"A11_hypercycle_{start}_{letter}" for start in STARTS for letter in "abc"]
X0 = np.array([0.6, 0.1, 0.1, 0.1, 0.1])
BUDGET = 0.3344071481541323
START = Populations.from_values(0.0, X0)
MU0 = 0.1 + 0.05 * np.arange(1, 6)


@pytest.mark.parametrize(
    "name", [*CASES[:3], *(pytest.param(name, marks=pytest.mark.validation) for name in CASES[3:])]
)
def test_trajectories_of_the_reference(name):
    given = case(name)
    x0, times = given["initial"]["x"], given["times"]
    found = solve(system(name), (0.0, times[-1]), x0, t_eval=times, rtol=1e-12, atol=1e-12)
    assert pytest.approx(np.array(given["reference"]["x"]), abs=1e-10) == found.y.T
    assert abs(found.y.sum(axis=0) - sum(x0)).max() < 1e-15 * 3


@pytest.mark.parametrize("name", CASES)
def test_states_of_the_reference(name):
    bound = system(name).bind(Populations.from_values(0.0, case(name)["initial"]["x"]))
    reference = case(name)["reference"]
    for k, t in enumerate(case(name)["times"]):
        x = reference["x"][k]
        assert bound.constraint_rates(t, x) == pytest.approx(reference["z"][k], rel=1e-10)
        assert bound.velocity(t, x) == pytest.approx(reference["xdot"][k], rel=1e-10, abs=1e-12)
        assert bound.multipliers(t, x) == pytest.approx(reference["lambda"][k], rel=1e-10)
        mu = np.array(reference["mu"][k])
        assert -mu @ bound.velocity(t, x) == pytest.approx(reference["T_sigma"][k], abs=1e-12)


@pytest.mark.parametrize("n", [3, 5, 8])
@pytest.mark.parametrize("total", [1.0, 2.0])
def test_closed_form_is_the_general_code(n, total):
    model = Hypercycle(n, 1.7, np.linspace(0.1, 0.9, n), 0.6)
    x = total * np.random.default_rng(n).dirichlet(np.ones(n))
    excess = float(model.mixture.excess(Populations.from_values(0.0, x), total))
    for constrained, b2 in (
        (model.without_entropy_production(), 0.0),
        (model.with_entropy_production(4.0), -excess / 4.0),
    ):
        assert constrained.constraint_rates(0.0, x) == pytest.approx(model.closed_form_rates(x, b2), rel=1e-10)
        assert constrained.constrained_inverse(0.0, x) == pytest.approx(model.closed_form_inverse(x), rel=1e-8)


def test_equation_of_motion():
    model, x = Hypercycle(4, 2.0), np.array([0.1, 0.2, 0.3, 0.4])
    assert model.velocity(0.0, x) == pytest.approx(2.0 * x * x[[1, 2, 3, 0]])
    assert model.mixture.mu0 == pytest.approx([0.15, 0.2, 0.25, 0.3])


# -- arrival at equilibrium ---------------------------------------------------------------------------


def excesses(model, found, total=1.0):
    return np.array([model.mixture.excess(Populations.from_logarithms(0.0, y), total) for y in found.log_y.T])


def test_arrives_at_equilibrium():
    # 30 times the relaxation time and far beyond, from a start where direct integration dies at t = 400 to 800.
    model, times = Hypercycle(), np.array([0.0, 300.0, 900.0, 3000.0, 1e5])
    found = solve(model.with_entropy_production(30.0), (0.0, 1e5), X0, t_eval=times, rtol=1e-8, atol=1e-8)
    assert found.success
    assert 250.0 < found.system.settled_time < 500.0
    assert excesses(model, found)[:3] == pytest.approx(BUDGET * np.exp(-times[:3] / 30.0), rel=2e-9)
    assert found.y[:, -1] == pytest.approx(np.exp(model.mixture.equilibrium(1.0)), rel=1e-15)


def test_settled_motion_continues_the_integrated_one():
    system, x0 = Hypercycle(5, 3.0, [0.1, 0.5, 0.2, 0.9, 0.3]).with_entropy_production(1.0), [0.3, 0.2, 0.1, 0.15, 0.25]
    coarse = solve(system, (0.0, 16.0), x0, t_eval=[15.0, 16.0], rtol=1e-6, atol=1e-6)
    fine = solve(system, (0.0, 16.0), x0, t_eval=[15.0, 16.0], rtol=1e-9, atol=1e-10)
    assert coarse.system.settled_time < 13.0
    assert fine.system.settled_time > coarse.system.settled_time
    again = solve(coarse.system, (0.0, 16.0), x0, t_eval=[15.0, 16.0], rtol=1e-9, atol=1e-10)  # nothing stays of a run
    assert again.system.settled_time == fine.system.settled_time
    assert coarse.y == pytest.approx(fine.y, rel=1e-6)


def test_start_at_equilibrium():
    """H36 with no production asked for: it stays."""
    model = Hypercycle()
    x_eq = np.exp(model.mixture.equilibrium(1.0))
    found = solve(model.without_entropy_production(), (0.0, 50.0), x_eq)
    assert found.success
    assert found.y == pytest.approx(np.repeat(x_eq[:, None], len(found.t), axis=1), rel=1e-12)
    # A run that has all but arrived can be gone on with.
    near = solve(model.with_entropy_production(30.0), (0.0, 900.0), X0, rtol=1e-6, atol=1e-7).y[:, -1]
    assert solve(model.with_entropy_production(30.0), (0.0, 50.0), near).success


# -- extinction and return ----------------------------------------------------------------------------


def test_near_extinction_and_return():
    name = "A11_hypercycle_extinction_b"
    given = case(name)
    found = solve(system(name), (0.0, 10.0), given["initial"]["x"], t_eval=given["times"], rtol=1e-12, atol=1e-12)
    # ln x goes down to -2.6e4 on the way.
    assert pytest.approx(np.array(given["reference"]["ln_x"]), rel=1e-10) == found.log_y.T
    assert pytest.approx(np.array(given["reference"]["x"]), abs=1e-12) == found.y.T
    assert found.y[2, 4] == 0.0


def test_extinction_beyond_all_numbers_ends_at_the_least_logarithm():
    # Under (c) species 3 to 5 die for good: ln x falls like -e^(lambda t) and would overflow before t = 100.
    x0 = np.array([0.18899264, 0.01101811, 0.01901061, 0.74291806, 0.03806058])
    found = solve(Hypercycle().without_entropy_production(), (0.0, 100.0), x0 / x0.sum(), rtol=1e-7, atol=1e-9)
    assert found.success and np.all(np.isfinite(found.log_y))
    assert found.log_y.min() == pytest.approx(-1e300, rel=1e-3)


#: Parameters over decades, starts down to ln x = -700.
random_system = runpy.run_path(str(Path(__file__).parents[3] / "examples/notes/growth_results.py"))["random_system"]


@pytest.mark.parametrize(("n", "kind"), [(2, "b"), (2, "c"), (3, "b"), (3, "c"), (5, "b"), (5, "c"), (8, "b")])
def test_random_systems_run_to_their_end_and_hold_their_rows(n, kind):
    rng = np.random.default_rng([7, n, ord(kind)])
    for _ in range(2):
        held, log_x = random_system(rng, n, kind)
        k_h, mixture = held.model.k_h, held.model.mixture
        found = solve(held, (0.0, 10 / k_h), np.exp(log_x), rtol=1e-6, atol=1e-8)
        assert found.success and np.all(np.isfinite(found.log_y))
        total0, energy0, least = exact_energies(mixture.mu0, mixture.kT, log_x)
        total, energy, _ = exact_energies(mixture.mu0, mixture.kT, found.log_y[:, -1])
        size = max(1.0, abs(float(energy0)))
        assert abs(float(total - total0)) < 1e-14 * size
        left = 1.0 if kind == "c" else np.exp(-10 / k_h / found.system.entropy_row.tau)
        excess0, excess = (float(g - X * least) for g, X in ((energy0, total0), (energy, total)))
        assert abs(excess - left * excess0) < 1e-13 * max(size, excess0)


# -- laws of entropy production -----------------------------------------------------------------------


def test_production_law_of_the_notes():
    relaxing, still = (EntropyRow(Mixture(MU0), tau).bind(START._replace(time=2.0)) for tau in (30.0, np.inf))
    for t in (0.0, 15.0, 300.0):
        assert relaxing.produced(2.0 + t) == pytest.approx(BUDGET * (1 - np.exp(-t / 30.0)), rel=1e-14)
        assert still.produced(2.0 + t) == 0.0
    assert relaxing.rate(START) == pytest.approx(-BUDGET / 30.0)
    assert still.rate(START) == 0.0


def test_budget_that_agrees_with_the_start_is_taken_as_such():
    row = Hypercycle().with_entropy_production(30.0, BUDGET * (1 + 1e-12)).bind(START).entropy_row
    assert row.excess0 == pytest.approx(BUDGET, rel=1e-14)
    assert row.law_excess(1e4) == pytest.approx(BUDGET * np.exp(-1e4 / 30), rel=1e-9)


@pytest.mark.parametrize(("factor", "time"), [(1.1, 71.9369), (1.5, 32.9584), (0.5, np.inf)])
def test_another_budget_is_refused_with_its_time(factor, time):
    with pytest.raises(BudgetError, match=rf"start can produce, 0\.3344\d*; .* t = {str(time)[:4]}") as caught:
        solve(Hypercycle().with_entropy_production(30.0, factor * BUDGET), (0.0, 1.0), X0)
    assert caught.value.time == pytest.approx(time, abs=1e-4)
    assert caught.value.consistent == pytest.approx(BUDGET)


PRODUCED = {"closed": BUDGET * -np.expm1(-4.0 / 3.0), "open": 0.0}
SYSTEMS = {
    "closed": Hypercycle().with_entropy_production(3.0),
    "open": Hypercycle().without_entropy_production(),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_entropy_produced_inside_and_exchanged(name):
    system = SYSTEMS[name]
    found = solve(system, (0.0, 4.0), X0, dense_output=True)
    reactions, exchanged = entropy_balance(found)
    t = np.linspace(0.0, 4.0, 1001)
    x = found.sol(t)
    mu = MU0[:, None] + np.log(x / x.sum(axis=0))
    inside = -np.sum(mu * 3.0 * x * np.roll(x, -1, axis=0), axis=0)
    z = np.stack([system.constraint_rates(s, v) for s, v in zip(t, x.T, strict=True)]).T
    assert reactions == pytest.approx(simpson(inside, x=t), abs=1e-7)
    assert exchanged == pytest.approx(simpson(-np.sum(mu * x * z, axis=0), x=t), abs=1e-7)
    assert abs(exchanged) > 0.1
    # What an open system produces it gives away; what a closed one produces is the sum: the integral of its rate.
    assert reactions + exchanged == pytest.approx(PRODUCED[name], abs=1e-9)
    assert found.system.entropy_row.produced(4.0) == pytest.approx(PRODUCED[name], abs=1e-14)
    assert excesses(Hypercycle(), found)[-1] == pytest.approx(BUDGET - PRODUCED[name], abs=1e-13)
