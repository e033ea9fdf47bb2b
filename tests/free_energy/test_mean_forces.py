"""The estimator against closed forms, on configurations and velocities drawn from the exact distribution."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import Distance, FixedAtoms, Plane
from kcons.free_energy import HeldCoordinates, Sample, Series, mean_force, weighted_mean
from kcons.free_energy.series import _quietest, local_mean_force

KT = 0.8
SAMPLES = 1000


def series_of(coordinates, others, masses, configurations, force, *, kT=KT, seed=0, sphere=False, known=False):
    """Samples at the configurations, with velocities of kT (or, on a `sphere`, of one kinetic energy)."""
    rng = np.random.default_rng(seed)
    constraint_set = ConstraintSet([*others, *coordinates.values()], configurations[0], masses)
    motion = Motion(constraint_set, configurations[0])
    held = HeldCoordinates(motion, coordinates, configurations[0])
    series = Series(held.names, held.periods)
    for x in configurations:
        v = motion.project_velocities(x, rng.normal(size=x.shape) * np.sqrt(kT / masses)[:, None])
        if sphere:
            g = motion.degrees_of_freedom
            v *= np.sqrt((g - 1) * kT / np.sum(masses[:, None] * v * v))
        sample = held.sample(x, v, force(x))
        # Means over velocities would leave nothing to average in most of these tests.
        series.append(sample if known else sample._replace(mean_kinetic=np.full(len(held), np.nan)))
    return series


def ring(r: float, n: int = SAMPLES):
    """Two atoms, the first fixed at the origin, the second on a circle about it in the plane z = 0."""
    angle = np.random.default_rng(1).uniform(0, 2 * np.pi, n)
    x = np.zeros((n, 2, 3))
    x[:, 1, 0], x[:, 1, 1] = r * np.cos(angle), r * np.sin(angle)
    return x


def spring(x):
    """-grad of U = (r - 1)^4/4 + r."""
    r = np.linalg.norm(x[1])
    f = np.zeros_like(x)
    f[1] = -((r - 1) ** 3 + 1) * x[1] / r
    return f


@pytest.mark.parametrize("mass", [1.0, 7.0])
def test_a_length_in_a_plane(mass):
    """F' = U' - kT/r, where Z does not change and the raw multipliers are right."""
    r = 1.7
    beside = [FixedAtoms([0]), Plane([1], (0, 0, 1))]
    series = series_of({"r": Distance([[0, 1]])}, beside, np.array([1.0, mass]), ring(r), spring)
    result = mean_force(series, KT)
    assert abs(result.force[0] - (0.7**3 + 1 - KT / r)) < 3 * result.error[0] < 0.08
    np.testing.assert_allclose(series.gradient, 0, atol=1e-12)
    assert result.raw == pytest.approx(result.force, rel=1e-12)
    assert "r = 1.7: dF/dq = " in str(result)


def trimer(n: int = SAMPLES):
    """Three atoms with two bonds of length 1, drawn as bonds held give them: uniform turns, weight sqrt(det H)."""
    rng = np.random.default_rng(2)
    found = []
    while len(found) < n:
        u, w = rng.normal(size=(2, 3))
        u, w = u / np.linalg.norm(u), w / np.linalg.norm(w)
        # det H of equal masses is 4 - cos^2.
        if rng.uniform() * 2 < np.sqrt(4 - (u @ w) ** 2):
            found.append(np.array([u, np.zeros(3), w]))
    return np.array(found)


def test_weights_take_the_metric_away():
    """<cos^2> of three equal masses with two bonds held: raw 0.321021053874, weighted 1/3."""
    x = trimer(20000)
    cosine = np.einsum("ni,ni->n", x[:, 0], x[:, 2])
    bonds = {"first": Distance([[0, 1]]), "second": Distance([[1, 2]])}
    series = series_of(bonds, [], np.ones(3), x[:200], np.zeros_like)
    np.testing.assert_allclose(np.exp(series.log_det_z), (4 - cosine**2)[:200], rtol=1e-12)
    log_weights = -0.5 * np.log(4 - cosine**2)
    np.testing.assert_allclose(series.weights, np.exp(log_weights[:200] + 0.5 * series.log_det_z.min()), rtol=1e-12)
    raw, weighted = weighted_mean(cosine**2), weighted_mean(cosine**2, np.exp(log_weights))
    assert abs(raw.value[0] - 0.321021053874) < 3 * raw.error[0]
    assert abs(weighted.value[0] - 1 / 3) < 3 * weighted.error[0] < 0.008
    assert abs(raw.value[0] - 1 / 3) > 4 * raw.error[0]


@pytest.mark.parametrize("sphere", [False, True], ids=["canonical", "isokinetic"])
def test_one_end_to_end_length_beside_two_bonds(sphere):
    """Z varies with the coordinate; P(r) of two bonds held is r sqrt(det H(r)), a closed form."""
    masses = np.array([1.0, 2.0, 3.0])
    a, b, r = 1.0, 1.3, 1.6

    def log_p(r):
        """The measure sqrt(det H) on the bonds, over the angle: sin(theta) dtheta ~ r dr."""
        cosine = (a * a + b * b - r * r) / (2 * a * b)
        h = np.array([[1 / masses[0] + 1 / masses[1], cosine / masses[1]], [0, 1 / masses[1] + 1 / masses[2]]])
        h[1, 0] = h[0, 1]
        return np.log(r) + 0.5 * np.linalg.slogdet(h)[1]

    step = 1e-5
    exact = -KT * (log_p(r + step) - log_p(r - step)) / (2 * step) + 0.4 * r
    cosine = (a * a + b * b - r * r) / (2 * a * b)
    shape = np.array([[a, 0, 0], [0, 0, 0], [b * cosine, b * np.sqrt(1 - cosine**2), 0]])

    def pull(x):
        """-grad of U = 0.2 r^2."""
        d = x[0] - x[2]
        return np.array([-0.4 * d, np.zeros(3), 0.4 * d])

    held = {"end to end": Distance([[0, 2]])}, [Distance([[0, 1], [1, 2]])], masses
    series = series_of(*held, np.repeat(shape[None], 3 * SAMPLES, 0), pull, sphere=sphere)
    plain = mean_force(series, KT)
    series.isokinetic_degrees_of_freedom = 6 * sphere
    result = mean_force(series, KT)
    assert not sphere or abs(plain.force[0] - exact) > 4 * plain.error[0]
    assert abs(result.force[0] - exact) < 3 * result.error[0] < 0.06
    assert abs(series.gradient[0, 0]) * KT > 3 * result.error[0]
    # The mean over velocities is known here, and then no velocities matter, of whatever thermostat.
    for given in (KT, 5 * KT):
        known = series_of(*held, shape[None], pull, kT=given, known=True)
        known.isokinetic_degrees_of_freedom = 6 * sphere
        np.testing.assert_allclose(local_mean_force(known, KT), [[exact]], rtol=0, atol=1e-8)


def test_of_two_estimates_the_mixture_that_fluctuates_least():
    """lambda has noise of its own, turned another one; both have the mean 5."""
    rng = np.random.default_rng(3)
    common, fast, other = rng.normal(size=(3, 4000))
    zero, still = np.zeros(1), np.ones(1)

    def found(turned):
        series = Series(["phi"], 2 * np.pi)
        for k, (force, turn) in enumerate(zip(5 + common + 10 * fast, turned, strict=True)):
            sample = Sample(float(k), still, np.array([force]), zero, 0.0, zero, 0.0, np.array([turn]), zero + np.nan)
            series.append(sample)
        return mean_force(series, KT), _quietest(series, local_mean_force(series, KT)).var()

    assert found(np.full(4000, np.nan))[1] == pytest.approx(101, rel=0.05)
    for size in (0.0, 1.0, 10.0, 100.0):
        both, variance = found(5 + common + size * other)
        # Of independent noises a and b is left ab/sqrt(a^2 + b^2).
        left = 1 + (10 * size) ** 2 / (100 + size**2)
        assert variance == pytest.approx(left, rel=0.1)
        assert both.error[0] == pytest.approx(np.sqrt(left / 4000), rel=0.5)  # of one series, an error is known to 20 %
        assert abs(both.force[0] - 5) < 4 * both.error[0]
