"""Thermodynamics of ideal mixtures."""

from decimal import Decimal

import numpy as np
import pytest
from exact_mixture import exact_energies
from growth_reference import case
from scipy.special import rel_entr

from kcons.errors import InputError
from kcons.models.growth import Mixture, Populations
from kcons.models.growth.mixture import entropy_function

MU0 = np.array([0.15, 0.2, 0.25, 0.3, 0.35])
CASES = ["A11_hypercycle_IC1_b", "A11_hypercycle_IC2_b", "A11_hypercycle_IC3sum2_b"]


@pytest.mark.parametrize("name", CASES)
def test_reference_states(name):
    given, mixture = case(name), Mixture(MU0)
    reference = {key: np.array(value) for key, value in given["reference"].items()}
    p = Populations.from_values(0.0, reference["x"].T)
    total = sum(given["initial"]["x"])
    assert pytest.approx(reference["mu"], rel=1e-12) == mixture.potentials(p).T
    assert pytest.approx(reference["M0_M1_M2"], rel=1e-12) == np.array(mixture.moments(p)).T
    assert mixture.gibbs_energy(p) == pytest.approx(reference["gibbs_g"], rel=1e-12)
    assert mixture.excess(p, total) == pytest.approx(reference["g_minus_geq"], rel=1e-12)
    assert np.exp(mixture.equilibrium(total)) == pytest.approx(np.array(given["x_eq"]), rel=1e-12)
    assert mixture.least_gibbs_energy(total) == pytest.approx(given["g_eq"], rel=1e-14)
    assert mixture.excess(p, total)[0] == pytest.approx(given["T_times_seq_minus_s0"], rel=1e-14)


def test_excess_is_accurate_next_to_equilibrium():
    mixture = Mixture(MU0)
    u = 1e-9 * np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    log_x = mixture.equilibrium(1.0) + u
    x_eq = np.exp(mixture.equilibrium(1.0))
    found = mixture.excess(Populations.from_logarithms(0.0, log_x), 1.0)
    # Second order in u; a difference of Gibbs energies would be round-off alone.
    v = x_eq @ u
    assert found == pytest.approx(0.5 * (x_eq @ u**2 - v**2), rel=1e-6)


def test_excess_off_the_total_is_that_of_the_actual_sum():
    mixture = Mixture(MU0, 0.7)
    x = np.array([0.3, 0.2, 0.4, 0.1, 0.05])
    p = Populations.from_values(0.0, x)
    plain = mixture.gibbs_energy(p) - mixture.least_gibbs_energy(x.sum())
    assert mixture.excess(p, 1.0) == pytest.approx(plain, rel=1e-12)
    x_eq = np.exp(mixture.equilibrium(x.sum()))
    assert plain == pytest.approx(0.7 * rel_entr(x, x_eq).sum(), rel=1e-12)


def test_potentials_are_the_gradient_of_the_excess():
    mixture = Mixture(MU0, 0.7)
    x = np.array([0.3, 0.2, 0.4, 0.1, 0.05])
    gradient = mixture.potentials(Populations.from_values(0.0, x)) - mixture.least_gibbs_energy(1.0)
    h = 1e-6
    for i in range(5):
        e = np.eye(5)[i] * h
        ends = [mixture.excess(Populations.from_values(0.0, x + s * e), 1.0) for s in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(gradient[i], abs=1e-9)
    relative = mixture.relative_potentials(Populations.from_values(0.0, x))
    assert relative == pytest.approx(gradient - gradient[2], abs=1e-14)
    assert relative[2] == 0.0


def test_systems_with_parameters_of_their_own():
    mu0, kT = np.stack([MU0, 2 * MU0], axis=1), np.array([1.0, 0.5])
    many = Mixture(mu0, kT)
    p = Populations.from_values(0.0, np.random.default_rng(0).dirichlet(np.ones(5), 2).T)
    for k in range(2):
        one, q = Mixture(mu0[:, k], kT[k]), Populations(0.0, p.x[:, k], p.log_x[:, k])
        assert many.excess(p, 1.0)[k] == pytest.approx(one.excess(q, 1.0), rel=1e-14)
        assert many.potentials(p)[:, k] == pytest.approx(one.potentials(q), rel=1e-14)
        alone = many.take(np.array([k]))
        assert alone.excess(Populations(0.0, p.x[:, [k]], p.log_x[:, [k]]), 1.0)[0] == pytest.approx(one.excess(q, 1.0))


def test_potentials_of_extinct_species_are_finite():
    p = Populations.from_logarithms(0.0, np.array([0.0, -1e4]))
    mixture = Mixture([0.0, 0.0])
    assert mixture.potentials(p).tolist() == [0.0, -1e4]
    assert np.isfinite(mixture.gibbs_energy(p))


def test_entropy_function_is_accurate_for_all_arguments():
    for u in (1e-12, -1e-5, 0.1, 0.1999, 0.2001, -0.3, 2.0):
        terms = [(k - 1) * u**k / np.prod(np.arange(1.0, k + 1)) for k in range(2, 40)]
        assert entropy_function(u) == pytest.approx(sum(terms), rel=2e-14)
    assert entropy_function(-1e5) == 1.0
    assert entropy_function(0.0) == 0.0


@pytest.mark.parametrize("arguments", [([np.nan, 0.0],), ([0.0, 0.0], 0.0), ([0.0, 0.0], np.inf), (0.0,)])
def test_bad_mixtures_are_refused(arguments):
    with pytest.raises(InputError):
        Mixture(*arguments)


def test_excess_over_a_level_has_the_round_off_of_its_terms():
    rng = np.random.default_rng(5)
    sharp, plain = [], []
    for _ in range(200):
        # The third would be nearly alone at equilibrium, and is rare: the excess is hundreds of the terms of g.
        mixture = Mixture(rng.normal(size=3) * 30.0 - [0.0, 0.0, 200.0])
        p = Populations.from_logarithms(0.0, np.log(rng.dirichlet([1.0, 1.0, 1.0])) - [0.0, 0.0, 40.0])
        total = float(np.sum(p.x))
        level = float(mixture.excess(p, total))
        X, g, least = exact_energies(mixture.mu0, 1.0, p.log_x)
        exact = float(g - X * least - Decimal(level))
        sharp.append(abs(float(mixture.excess_over(p, total, np.array(level))) - exact) / level)
        plain.append(abs(float(mixture.excess(p, total)) - level - exact) / level)
    assert max(sharp) < 1e-15
    # What it is for.
    assert max(plain) > 1e-14


@pytest.mark.parametrize("size", [1e-9, 0.05, 0.3])
def test_excess_over_a_level_near_equilibrium(size):
    mixture = Mixture(MU0)
    log_x = mixture.equilibrium(1.0) + size * np.array([1.0, -2.0, 0.5, 3.0, -1.0])
    log_x -= np.log(np.sum(np.exp(log_x)))
    p = Populations.from_logarithms(0.0, log_x)
    excess = mixture.excess(p, 1.0)
    level = 0.75 * excess
    assert mixture.excess_over(p, 1.0, level) == pytest.approx(0.25 * excess, rel=1e-13)
    assert mixture.excess_over(p, 1.0, np.zeros(())) == pytest.approx(excess, rel=1e-14)
