"""Profiles from mean forces, against free energies in closed form."""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import NamedTuple

import numpy as np
import pytest

from kcons.free_energy import integrate, plot_profile


class Case(NamedTuple):
    F: object
    low: float
    high: float
    period: float | None = None

    def f(self, x):
        """The slope of F, by a complex step."""
        return self.F(x + 1e-30j).imag / 1e-30

    def grid(self, n):
        """Windows at equal distances; around a circle, or to both ends."""
        return np.linspace(self.low, self.high, n, endpoint=self.period is None)


CASES = {
    "Lennard-Jones": Case(lambda r: 4 * (r**-12 - r**-6), 0.95, 3.0),
    "double well": Case(lambda x: 5 * (x**2 - 1) ** 2, -1.5, 1.5),
    "torsion": Case(lambda t: 7 * np.cos(t) + 3 * np.cos(2 * t) + 8 * np.cos(3 * t), -math.pi, math.pi, 2 * math.pi),
}


def made(case, n, error, seed, **options):
    x = case.grid(n)
    f = case.f(x) + error * np.random.default_rng(seed).standard_normal(n)
    return integrate(x, f, np.full(n, error), period=case.period, **options)


def off(profile, case):
    """Error in standard errors of the whole profile at 5 places, made independent of each other."""
    places = slice(20, 200, 40)
    away = profile.F[places] - (case.F(profile.x[places]) - case.F(profile.zero))
    root = np.linalg.cholesky(profile.covariance[places, places])
    return np.linalg.solve(root, away)


@pytest.mark.filterwarnings("ignore:the mean force has the integral")  # of many, one is 4 errors off
@pytest.mark.parametrize(
    ("name", "n", "error"), [("Lennard-Jones", 20, 0.3), ("double well", 9, 0.4), ("torsion", 12, 1.0)]
)
@pytest.mark.parametrize(
    ("seeds", "low", "high", "covered"),
    [(6, 0.4, 1.6, 0.85), pytest.param(300, 0.81, 1.32, 0.9, marks=pytest.mark.validation)],
    ids=["few", "many"],
)
def test_errors_of_gaussian_processes_are_as_large_as_they_say(name, n, error, seeds, low, high, covered):
    """Few windows: what lies between them counts as well. 30 differences; their mean square has a standard deviation
    of 0.26 if they are independent."""
    case = CASES[name]
    away = np.array([off(made(case, n, error, seed, zero=case.grid(n)[3]), case) for seed in range(seeds)])
    assert low < (away**2).mean() < high
    assert covered <= (np.abs(away) < 1.96).mean() <= (1.0 if seeds < 100 else 0.98)


def test_mean_forces_that_vanish_within_their_errors():
    """The band is that of the errors, as the trapezoidal rule has it: the profile may well be different from 0."""
    x = np.linspace(0.0, 3.0, 12)
    one = integrate(x, np.zeros(12), np.full(12, 0.1), zero=0.0)
    assert np.abs(one.F).max() == 0.0
    assert one.error[-1] == pytest.approx(0.1 * x[1] * math.sqrt(10 + 2 / 4), rel=0.15)
    exact = integrate(x, np.zeros(12), np.zeros(12))
    assert np.abs(exact.F).max() == 0.0 and exact.error.max() < 1e-2


def test_a_period_closes():
    case, e = CASES["torsion"], 0.5
    x = case.grid(16)
    f = case.f(x) + 0.3 + e * np.random.default_rng(5).standard_normal(16)
    profile = integrate(x, f, np.full(16, e), period=case.period)
    # An equal weight for each window: the error of the integral is 2 pi e/sqrt(16).
    assert profile.closure.error == pytest.approx(2 * math.pi * e / 4, rel=0.05)
    assert profile.closure.value == pytest.approx(2 * math.pi * np.mean(f), rel=0.15)
    assert profile.F[0] == pytest.approx(profile.F[-1], abs=1e-6)
    with pytest.warns(UserWarning, match="which should be 0"):
        integrate(x, case.f(x) + 3.0, np.full(16, 0.1), period=case.period)


def test_waves_without_a_slope_at_any_window_are_said():
    """Windows 60 degrees apart do not see cos 3t, nor does the error; seven do."""
    case = Case(lambda t: 3 * np.cos(t) - 0.35 * np.cos(2 * t) + 3.3 * np.cos(3 * t), 0.0, 2 * math.pi, 2 * math.pi)
    for n in (6, 7):
        with pytest.warns(UserWarning, match="give seven or more") if n == 6 else nullcontext():
            profile = integrate(case.grid(n), case.f(case.grid(n)), np.full(n, 3e-3), period=case.period, zero=0.0)
        away = np.abs(profile.F - (case.F(profile.x) - case.F(0.0))).max()
        assert (away > 3 * profile.error.max()) == (n == 6)


def test_windows_of_a_circle_may_be_given_in_any_turn_and_order():
    case = CASES["torsion"]
    x = case.grid(16)
    one = integrate(x, case.f(x), np.full(16, 0.1), period=case.period)
    order = np.random.default_rng(6).permutation(16)
    turned = np.where(x < -0.1, x + 2 * math.pi, x)[order]
    other = integrate(turned, case.f(turned), np.full(16, 0.1), period=case.period)
    # Lengths are learned on a grid that begins at the first window.
    assert one.difference(0.0, 1.0).value == pytest.approx(other.difference(0.0, 1.0).value, abs=1e-4)


@pytest.mark.parametrize("off", [0.0, 1e-12])
def test_windows_at_one_place_count_as_one_of_their_mean(off):
    twice = integrate([0.3, 0.3 + off, 1.0, 2.0], [1.0, 2.0, 1.0, 1.0], [1.0, 0.5, 1.0, 1.0], zero=0.3)
    once = integrate([0.3, 1.0, 2.0], [(1.0 + 4 * 2.0) / 5, 1.0, 1.0], [1 / math.sqrt(5), 1.0, 1.0], zero=0.3)
    assert pytest.approx(once.F, abs=0.005) == twice.F
    assert twice.error == pytest.approx(once.error, rel=0.01)


def test_next_windows_lie_apart_and_where_little_is_known():
    x = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 4.0])
    profile = integrate(x, np.cos(x), np.full(6, 0.01))
    first, second = profile.next_windows(2)
    assert 2.2 < first < 3.8 and abs(second - first) > 0.3
    assert profile.next_windows(1) == [first]


def test_windows_that_help_what_is_low():
    """F = x^3/3, which is 3 at x = 2.1: windows for what is below are put there, those for all of it higher up."""
    x = np.linspace(0.0, 4.0, 9)
    profile = integrate(x, x**2, np.full(9, 0.3))
    np.testing.assert_allclose(profile.x[profile.lower_than(3.0)].max(), 9 ** (1 / 3), atol=0.05)
    # Places that help as much as each other are taken as rounding has it: 0.74 or 1.26.
    low, every = np.sort(profile.next_windows(3, below=3.0)), np.sort(profile.next_windows(3))
    assert low.max() < 9 ** (1 / 3) and np.all(low < every)
    assert profile.next_windows(2, below=np.inf) == profile.next_windows(2)


@pytest.mark.parametrize("error", [0.0, 1e-14])
def test_windows_beside_exact_ones_are_not_proposed_twice(error):
    x = np.linspace(0.0, 3.0, 6)
    places = integrate(x, np.sin(x), np.full(6, error)).next_windows(10)
    assert len(set(places)) == 10 and np.diff(np.sort([*places, *x])).min() > 0.01


def test_a_profile_prints_its_windows_and_not_its_arrays():
    x = np.linspace(1.0, 2.0, 5)
    profile = integrate(x, 2.0 * x, np.full(5, 0.01))
    assert repr(profile) == "<Profile: 5 windows from 1 to 2>"
    first, *lines, last = str(profile).splitlines()
    assert first.split() == ["window", "dF/dx", "F"] and len(lines) == 5
    assert [float(word) for word in lines[-1].replace("+-", "").split()[:3]] == [2.0, 4.0, 0.01]
    shown = [float(line.split()[4]) for line in lines]
    np.testing.assert_allclose(shown, [profile.difference(profile.zero, place).value for place in x], atol=1e-4)
    assert last.startswith("from 1 to 2 F rises by 3")


def test_a_profile_with_its_band_and_windows():
    x = np.linspace(0.0, 2.0, 6)
    profile = integrate(x, np.cos(3 * x), np.full(6, 0.05))
    above, below = plot_profile(profile, coordinate="r / Å", energy="eV").axes
    assert above.get_ylabel() == "F / eV" and below.get_xlabel() == "r / Å"
    band = above.collections[0].get_paths()[0].get_extents()
    assert band.y1 == pytest.approx((profile.F + 2 * profile.error).max())
    (windows,) = (each for each in below.containers if each.get_label() == "windows")
    assert (windows.lines[0].get_xdata() == profile.windows).all()
