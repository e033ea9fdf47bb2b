"""Free energies from works whose distribution is known."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy.stats import norm

from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.profiles.pulls import pull_free_energy

F, KT = 7.0, 2.5


def normal(rng, n, spread, m=0):
    """Works of variance spread^2 whose means are what Crooks asks for: F + spread^2/2kT, and the same backward."""
    lost = spread**2 / (2 * KT)
    return rng.normal(F + lost, spread, n), rng.normal(-F + lost, spread, m or n)


def test_normal_works_give_the_free_energy_within_the_errors():
    rng = np.random.default_rng(1)
    found = [pull_free_energy(*normal(rng, 200, KT), thermal_energy=KT) for _ in range(60)]
    for name in ("jarzynski", "bar"):
        away = np.array([getattr(each, name).off(F) for each in found])
        # The mean square of 60 has a standard deviation of 0.18; bootstraps of exponentials are a little too narrow.
        assert 0.6 < (away**2).mean() < 1.6
        assert abs(away.mean()) < 0.45


def test_pulls_that_count():
    """Of normal works of variance kT^2 one in e."""
    many = pull_free_energy(F + KT / 2 + KT * norm.ppf((np.arange(4000) + 0.5) / 4000), thermal_energy=KT)
    assert many.n_effective == pytest.approx(4000 / np.e, rel=0.1)


def test_a_spring_that_is_dragged():
    """Overdamped, x' = -(x - vt) + sqrt(2) dW: the free energy stays the same, whatever work is done.

    Works are normal, with <W> = v^2 (T - 1 + e^-T) and variance 2 <W> (Mazonka and Jarzynski 1999, eq. 18).
    """
    mean = 0.6**2 * (4.0 - 1 + np.exp(-4.0))
    found = pull_free_energy(np.random.default_rng(6).normal(mean, np.sqrt(2 * mean), 4000), thermal_energy=1.0)
    assert abs(found.jarzynski.off(0.0)) < 3.5


def test_works_of_no_spread():
    """Pulls of what nothing resists: the difference is the work. Works that contradict each other have none."""
    same = pull_free_energy(np.full(6, 2.0), np.full(7, -2.0), thermal_energy=0.5)
    assert same.bar.value == pytest.approx(2.0) and same.bar.error == 0
    assert same.overlap == pytest.approx(1.0)
    with pytest.raises(InputError, match="the same each way, and 1 kT are lost"):
        pull_free_energy(np.full(6, 2.0), np.full(6, -1.0), thermal_energy=1.0)


def test_pulls_that_do_not_overlap_are_warned_of():
    one, other = normal(np.random.default_rng(8), 50, 12 * KT)
    with pytest.warns(UserWarning, match=r"overlap of 0\.\d%"):
        pull_free_energy(one, other, thermal_energy=KT)
    with pytest.warns(UserWarning, match=r"of 50 pulls count"):
        pull_free_energy(one, thermal_energy=KT)


def test_one_direction_needs_no_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymbar", None)
    works = np.random.default_rng(9).normal(F, 0.1, 50)
    assert pull_free_energy(works, thermal_energy=KT).best.value == pytest.approx(F, abs=0.1)
    with pytest.raises(UnsupportedError, match="free-energy"):
        pull_free_energy(works, -works, thermal_energy=KT)


def test_works_of_the_wrong_sign_are_warned_of():
    """By the system in place of on it: pulls there and back would gain work."""
    forward, backward = normal(np.random.default_rng(6), 50, KT)
    with pytest.warns(UserWarning, match="together gain .*give the work done on the system"):
        pull_free_energy(-forward, -backward, thermal_energy=KT)
