"""The hypercycle against its reference solutions, its closed form, and its arrival at equilibrium."""

import numpy as np
import pytest
from growth_reference import case, system

from kcons.errors import BudgetError, InputError
from kcons.models.growth import Hypercycle, Populations, solve, solve_ensemble

STARTS = ("IC1", "IC2", "IC3sum2")
CASES = [f"A11_hypercycle_{start}_{letter}" for start in STARTS for letter in "abc"]
X0 = np.array([0.6, 0.1, 0.1, 0.1, 0.1])


@pytest.mark.parametrize("letter", ["a", *(pytest.param(other, marks=pytest.mark.validation) for other in "bc")])
def test_trajectories_of_the_reference(letter):
    names = [f"A11_hypercycle_{start}_{letter}" for start in STARTS]
    x0 = np.array([case(name)["initial"]["x"] for name in names]).T
    found = solve_ensemble(system(names[0]), case(names[0])["times"], x0, rtol=1e-12, atol=1e-12)
    for k, name in enumerate(names):
        assert found.x[:, :, k] == pytest.approx(np.array(case(name)["reference"]["x"]), abs=1e-10)
    assert abs(found.x.sum(axis=1) - x0.sum(axis=0)).max() < 1e-15 * 3


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


def test_near_extinction_and_return():
    name = "A11_hypercycle_extinction_b"
    given = case(name)
    found = solve(system(name), (0.0, 10.0), given["initial"]["x"], t_eval=given["times"], rtol=1e-12, atol=1e-12)
    # ln x goes down to -2.6e4 on the way.
    assert pytest.approx(np.array(given["reference"]["ln_x"]), rel=1e-10) == found.log_y.T
    assert pytest.approx(np.array(given["reference"]["x"]), abs=1e-12) == found.y.T
    assert found.y[2, 4] == 0.0


def test_limit_cycle():
    given = case("A11_hypercycle_limit_cycle")
    start = np.array(given["state_at_section_x1_eq_0.2_upward"])

    def section(t, x):
        return x[0] - 0.2

    section.direction = 1
    model = Hypercycle()
    found = solve(
        model.with_fixed_total(), (0.0, 20.0), start, events=section, rtol=1e-11, atol=1e-12, dense_output=True
    )
    late = found.t_events[0][found.t_events[0] > 1.0]
    assert late[-1] == pytest.approx(given["period"], abs=1e-8)
    assert found.y_events[0][-1] == pytest.approx(start, abs=1e-8)
    dense = found.sol(np.linspace(0.0, 20.0, 8001))
    assert dense.max() == pytest.approx(given["x_max"], abs=2e-6)
    assert dense.min() == pytest.approx(given["x_min"], abs=2e-6)
    wanted = [complex(*pair) for pair in given["eigenvalues_at_fixed_point_tangent"]]

    def order(c):
        return round(c.real, 6), c.imag

    assert sorted(model.interior_eigenvalues(), key=order) == pytest.approx(sorted(wanted, key=order), abs=1e-14)


@pytest.mark.parametrize("n", [3, 5, 8])
@pytest.mark.parametrize("total", [1.0, 2.0])
def test_closed_form_is_the_general_code(n, total):
    model = Hypercycle(n, 1.7, np.linspace(0.1, 0.9, n), 0.6)
    x = total * np.random.default_rng(n).dirichlet(np.ones(n))
    p = Populations.from_values(0.0, x)
    for constrained, b2 in (
        (model.without_entropy_production(), 0.0),
        (model.with_entropy_production(4.0), -float(model.mixture.excess(p, total)) / 4.0),
    ):
        assert constrained.constraint_rates(0.0, x) == pytest.approx(model.closed_form_rates(x, b2), rel=1e-10)
        assert constrained.constrained_inverse(0.0, x) == pytest.approx(model.closed_form_inverse(x), rel=1e-8)


def test_equation_of_motion():
    model = Hypercycle(4, 2.0)
    x = np.array([0.1, 0.2, 0.3, 0.4])
    assert model.velocity(0.0, x) == pytest.approx(2.0 * x * x[[1, 2, 3, 0]])
    assert model.mixture.mu0 == pytest.approx([0.15, 0.2, 0.25, 0.3])


def test_arrives_at_equilibrium():
    # 30 times the relaxation time and far beyond, from a start where direct integration dies at t = 400 to 800.
    model = Hypercycle()
    times = np.array([0.0, 300.0, 900.0, 3000.0, 1e5])
    found = solve(model.with_entropy_production(30.0), (0.0, 1e5), X0, t_eval=times, rtol=1e-8, atol=1e-8)
    assert found.success
    assert 250.0 < found.settled_time < 500.0
    excess = model.mixture.excess(Populations.from_logarithms(times, found.log_y), 1.0)
    assert excess[:3] == pytest.approx(0.3344071481541323 * np.exp(-times[:3] / 30.0), rel=2e-9)
    assert found.y[:, -1] == pytest.approx(np.exp(model.mixture.equilibrium(1.0)), rel=1e-15)


def test_settled_motion_continues_the_integrated_one():
    model = Hypercycle(5, 3.0, [0.1, 0.5, 0.2, 0.9, 0.3])
    system = model.with_entropy_production(1.0)
    x0 = [0.3, 0.2, 0.1, 0.15, 0.25]
    coarse = solve(system, (0.0, 16.0), x0, t_eval=[15.0, 16.0], rtol=1e-6, atol=1e-6)
    fine = solve(system, (0.0, 16.0), x0, t_eval=[15.0, 16.0], rtol=1e-11, atol=1e-12)
    assert coarse.settled_time < 13.0
    assert fine.settled_time is None or fine.settled_time > coarse.settled_time
    assert coarse.y == pytest.approx(fine.y, rel=1e-6)


def test_start_at_equilibrium():
    """H36: with nothing to produce it is refused; with no production asked for, or the total alone, it stays."""
    model = Hypercycle()
    x_eq = np.exp(model.mixture.equilibrium(1.0))
    for budget in (None, 0.0):
        with pytest.raises(BudgetError, match="already at equilibrium"):
            solve(model.with_entropy_production(30.0, budget=budget), (0.0, 50.0), x_eq)
    found = solve(model.without_entropy_production(), (0.0, 50.0), x_eq)
    assert found.success
    assert found.y == pytest.approx(np.repeat(x_eq[:, None], len(found.t), axis=1), rel=1e-12)
    # A run that has all but arrived can be gone on with.
    near = solve(model.with_entropy_production(30.0), (0.0, 900.0), [0.6, 0.1, 0.1, 0.1, 0.1]).y[:, -1]
    assert solve(model.with_entropy_production(30.0), (0.0, 50.0), near).success


@pytest.mark.parametrize("n", [2, 3])
def test_few_species(n):
    # With n = 2 both rows together leave no freedom; the motion follows from them alone.
    model = Hypercycle(n, 1.0, np.zeros(n))
    x0 = np.array([0.7, 0.3]) if n == 2 else np.array([0.5, 0.3, 0.2])
    found = solve(model.with_entropy_production(2.0), (0.0, 200.0), x0, t_eval=[0.0, 10.0, 200.0])
    assert found.success
    excess = model.mixture.excess(Populations.from_logarithms(found.t, found.log_y), 1.0)
    assert excess[:2] == pytest.approx(excess[0] * np.exp(-found.t[:2] / 2.0), rel=1e-12)
    assert found.y[:, -1] == pytest.approx(np.full(n, 1 / n), rel=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [(1,), (2.5,), (0,), (5, 0.0), (5, -1.0), (5, np.nan), (5, 1.0, [0.1, 0.2]), (5, 1.0, [0.1, 0.2, np.nan, 0, 0])],
)
def test_bad_hypercycles_are_refused(arguments):
    with pytest.raises(InputError):
        Hypercycle(*arguments)
