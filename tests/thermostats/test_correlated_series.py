"""Stated errors are those that repeated runs have, for every public estimator."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from kcons.free_energy import weighted_mean
from kcons.thermostats import mean
from kcons.thermostats.configurational_temperature import temperature
from kcons.thermostats.correlated_series import FEW_INDEPENDENT, slope, spread


def fading(rng, n, memory, d=1):
    """Correlations exp(-t/memory), variance 1, shape (n, d)."""
    keep = math.exp(-1 / memory)
    noise = math.sqrt(1 - keep**2) * rng.standard_normal((n, d))
    noise[0] = rng.standard_normal(d)
    return lfilter([1.0], [1.0, -keep], noise, axis=0)


def two_state(rng, n, memory):
    """-1 and 1, with the same correlations."""
    turns = rng.random(n) < 0.5 * (1 - math.exp(-1 / memory))
    return np.cumprod(np.where(turns, -1, 1)) * rng.choice([-1, 1])


def oscillator(rng, n, memory, turn):
    """Amplitudes fade as exp(-t/memory), with `turn` radians in one memory; 0 is critical damping."""
    keep, before = math.exp(-1 / memory), 12 * int(memory) + 50
    noise = rng.standard_normal(n + before)
    return lfilter([1.0], [1.0, -2 * keep * math.cos(turn / memory), keep**2], noise)[before:]


#: Each spans 20 of its slowest times or more.
SERIES = {
    "independent": lambda rng: rng.standard_normal(64),
    "many independent": lambda rng: rng.standard_normal(1000),
    "memory 3": lambda rng: fading(rng, 64, 3.0)[:, 0],
    "memory 10": lambda rng: fading(rng, 400, 10.0)[:, 0],
    "memory of a twentieth": lambda rng: fading(rng, 400, 20.0)[:, 0],
    "hidden states": lambda rng: rng.standard_normal(2000) + math.sqrt(0.1) * two_state(rng, 2000, 100.0),
    "rarely seen states": lambda rng: rng.standard_normal(4000) + 0.1 * two_state(rng, 4000, 100.0),
    "fast and slow": lambda rng: fading(rng, 4000, 3.0)[:, 0] + math.sqrt(0.2) * two_state(rng, 4000, 100.0),
    "states alone": lambda rng: rng.standard_normal(400) + two_state(rng, 400, 20.0),
    "sum of memories": lambda rng: sum(
        f * fading(rng, 4000, m)[:, 0] for f, m in ((1.0, 3.0), (1.0, 20.0), (0.5, 120.0))
    ),
    "many swings": lambda rng: oscillator(rng, 2000, 20.0, 4 * math.pi),
    "underdamped": lambda rng: oscillator(rng, 2000, 50.0, 2.0),
    "underdamped for a twentieth": lambda rng: oscillator(rng, 2000, 100.0, 3.0),
    "critically damped": lambda rng: oscillator(rng, 2000, 50.0, 0.0),
    "critically damped, long": lambda rng: oscillator(rng, 2000, 20.0, 0.0),
    "swings of three values": lambda rng: oscillator(rng, 400, 4.0, 10.0),
    "up and down": lambda rng: lfilter([1.0], [1.0, 0.7], rng.standard_normal(164))[100:],
    "smooth": lambda rng: gaussian_filter1d(rng.standard_normal(300), 5.0)[50:-50],
}


def scatter(found, expected=0.0):
    """Root mean square of what estimates are off by, over that of their errors."""
    value, error = np.array(found).T
    return math.sqrt(((value - expected) ** 2).mean() / (error**2).mean())


@pytest.mark.filterwarnings("ignore:.*independent ones")
@pytest.mark.parametrize("name", SERIES, ids=lambda name: name.replace(" ", "-"))
def test_errors_are_as_large_as_they_say(name):
    rng = np.random.default_rng(1)
    series = [SERIES[name](rng) for _ in range(500)]
    assert 0.9 <= scatter([mean(values) for values in series]) <= 1.15
    for values in series[:3]:
        assert weighted_mean(values).error[0] == pytest.approx(mean(values).error, rel=1e-9)


@pytest.mark.validation
@pytest.mark.filterwarnings("ignore:.*independent ones")
@pytest.mark.parametrize("span", [20, 40, 100])
@pytest.mark.parametrize("n", [400, 800, 3000])
@pytest.mark.parametrize("turn", [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 10.0])
def test_errors_of_oscillators(turn, n, span):
    """`span` memories in a run, or of the integral of its correlations, which is twice as long at critical damping."""
    rng = np.random.default_rng(10)
    series = [oscillator(rng, n, n / span / (1 if turn else 2), turn) for _ in range(1500)]
    assert 0.9 <= scatter([mean(values) for values in series]) <= 1.15


@pytest.mark.filterwarnings("ignore:.*independent ones")
def test_errors_of_ratios():
    """Above and below the line depend on each other, and both on something slow."""
    rng, found = np.random.default_rng(3), []
    for _ in range(400):
        slow = fading(rng, 800, 20.0, 2)
        below = 2.0 + slow[:, 0] + rng.standard_normal(800)
        found.append(temperature(0.7 * below + slow[:, 1] + 0.5 * slow[:, 0] ** 2 - 0.5, below)[0])
    assert 0.9 <= scatter(found, 0.7) <= 1.15


@pytest.mark.parametrize("name", ["independent", "memory 10", "fast and slow", "smooth"])
def test_errors_of_slopes(name):
    rng, found = np.random.default_rng(5), []
    for _ in range(500):
        values = SERIES[name](rng)
        times = 3.0 + 0.1 * np.arange(len(values))
        found.append(slope(times, values + 2.0 * times))
    assert 0.9 <= scatter(found, 2.0) <= 1.15
    assert slope(np.arange(5.0), 2.0 - np.arange(5.0)) == pytest.approx((-1.0, 0.0), abs=1e-12)


def test_few_independent_values_are_said():
    rng = np.random.default_rng(6)
    with pytest.warns(UserWarning, match="400 values are worth .* independent ones"):
        mean(fading(rng, 400, 100.0)[:, 0])
    assert np.mean([spread(rng.standard_normal(64)).independent < FEW_INDEPENDENT for _ in range(200)]) == 0
    # Runs of 5 independent values seem worth more, and errors of those that seem worth 10 are half of what they are.
    for worth, least, most in ((5, 0.9, 1.0), (30, 0.0, 0.05)):
        runs = [spread(fading(rng, 600, 300 / worth)[:, 0]).independent < FEW_INDEPENDENT for _ in range(400)]
        assert least <= np.mean(runs) <= most


def test_heavy_tails_are_said():
    """One of 2,000 values makes up most of the spread: nobody knows the error of that."""
    rng = np.random.default_rng(7)
    told = [spread(rng.standard_t(1.0, 2000)).independent < 10 for _ in range(200)]
    assert np.mean(told) > 0.5
    values = rng.standard_normal(2000)
    values[700] = 1e4
    with pytest.warns(UserWarning, match="a few of them make up the spread"):
        mean(values)


def test_ratios_without_a_denominator_have_no_error():
    rng = np.random.default_rng(8)
    below = rng.standard_normal(200)
    found, said = temperature(1.0 + rng.standard_normal(200), below - below.mean() + 0.02)
    assert said is not None and "mean curvature of 200 samples is 0 within 3 standard errors" in said
    assert found.error == math.inf and found.off(0.5) == 0.0


def test_units_and_offsets_do_not_matter():
    values = fading(np.random.default_rng(9), 500, 5.0)[:, 0]
    one, other = spread(values), spread(1e-9 * values + 3.0)
    assert other.error == pytest.approx(1e-9 * one.error, rel=1e-6)
    assert other.independent == pytest.approx(one.independent, rel=1e-6)


@pytest.mark.parametrize("count", [3, 5, 16, 31, 64, 127, 128, 1001])
def test_series_of_any_length_have_an_error(count):
    values = np.random.default_rng(count).standard_normal(count)
    assert 0.3 < spread(values).error * math.sqrt(count) < 3.0
