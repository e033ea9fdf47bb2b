"""Free energies from works whose distribution is known."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.profiles.pulls import pull_free_energy

F, KT = 7.0, 2.5


def normal(rng, n, spread, m=0):
    """Works of variance spread^2 whose means are what Crooks asks for: F + spread^2/2kT, and the same backward."""
    lost = spread**2 / (2 * KT)
    return rng.normal(F + lost, spread, n), rng.normal(-F + lost, spread, m or n)


def test_normal_works_give_the_free_energy_within_the_errors():
    rng = np.random.default_rng(1)
    found = [pull_free_energy(*normal(rng, 200, KT, 100), thermal_energy=KT) for _ in range(60)]
    away = np.array([each.bar.off(F) for each in found])
    assert 0.6 < (away**2).mean() < 1.6  # the mean square of 60 has a standard deviation of 0.18
    assert abs(away.mean()) < 0.45


def test_works_of_no_spread():
    """Pulls of what nothing resists: the difference is the work. Pulls of one start are no sample."""
    same = pull_free_energy(np.full(6, 2.0), np.full(7, -2.0), thermal_energy=0.5)
    assert same.bar.value == pytest.approx(2.0) and same.bar.error == 0
    assert same.overlap == pytest.approx(1.0)
    with pytest.raises(InputError, match="all works are the same each way, and 4 kT are lost"):
        pull_free_energy(np.full(6, 2.0), np.full(7, 0.0), thermal_energy=0.5)


def test_pulls_that_do_not_overlap_are_warned_of():
    with pytest.warns(UserWarning, match=r"overlap of 0\.\d%"):
        pull_free_energy(*normal(np.random.default_rng(8), 50, 12 * KT), thermal_energy=KT)
    with pytest.warns(UserWarning, match="overlap of 0.0%"):
        found = pull_free_energy(*normal(np.random.default_rng(8), 50, 90 * KT), thermal_energy=KT)
    assert np.isnan(found.bar.error)


def test_bar_is_left_to_pymbar(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymbar", None)
    with pytest.raises(UnsupportedError, match="free-energy"):
        pull_free_energy(np.arange(5.0), np.arange(5.0), thermal_energy=KT)


def test_works_of_the_wrong_sign_are_warned_of():
    """By the system in place of on it: pulls there and back would gain work."""
    forward, backward = normal(np.random.default_rng(6), 50, KT)
    with pytest.warns(UserWarning, match="together gain .*give the work done on the system"):
        pull_free_energy(-forward, -backward, thermal_energy=KT)
