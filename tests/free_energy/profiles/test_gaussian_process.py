"""A Gaussian process learned from gradients: its kernel is what it says, and its posterior what any solver gives."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.free_energy.profiles.gaussian_process import Axis, GradientProcess, Learned, Points, learn

AXES = {
    "line": Axis(-1.0, 3.0, False),
    "warped line": Axis(-1.0, 3.0, False, 6),
    "circle": Axis(-1.0, 3.0, True),
    "warped circle": Axis(-1.0, 3.0, True, 5),
}


def process(axes, seed=0, n=4, trends=None, rough=True):
    rng = np.random.default_rng(seed)
    d = len(axes)
    x = rng.uniform(-1.0, 2.0, (n, d))
    noise = rng.standard_normal((n, d, d))
    covariances = 0.01 * noise @ noise.transpose(0, 2, 1)
    logs = 1.0 + 0.7 * rough * rng.standard_normal(1 + sum(axis.coefficients for axis in axes))
    return GradientProcess(Points(x, axes), rng.standard_normal((n, d)), covariances, axes, logs, trends or [False] * d)


@pytest.mark.parametrize("names", [[name] for name in AXES] + [["warped line", "circle"], ["line", "warped circle"]])
def test_covariances_of_gradients_are_derivatives_of_those_of_the_free_energy(names):
    axes = [AXES[name] for name in names]
    d, h = len(axes), 1e-4
    known = process(axes, trends=[True] * d)
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.9, 1.9, (2, 3, d))

    def prior(one, p, other, q):
        return known._covariance((Points(one, axes), [p]), (Points(other, axes), [q]))

    for p in range(d):
        step = h * np.eye(d)[p]
        for q in (-1, *range(d)):
            slope = (prior(x + step, -1, y, q) - prior(x - step, -1, y, q)) / (2 * h)
            scale = np.abs(prior(x, p, y, q)).max()
            assert prior(x, p, y, q) == pytest.approx(slope, abs=1e-5 * max(scale, 1.0))
            assert prior(y, q, x, p) == pytest.approx(prior(x, p, y, q).T, rel=1e-12)


def test_lengths_are_learned():
    """A function that is quick on one side: u' is larger there, and the likelihood higher than with one length."""
    x = np.linspace(0.0, 4.0, 25)[:, None]
    slopes = 8 * np.cos(8 * x) * np.exp(-((x / 1.0) ** 4)) + 0.1 * np.cos(x)
    errors = np.full((25, 1, 1), 1e-4)
    one, many = (learn(x, slopes, errors, [Axis(0.0, 4.0, False, k)], [True]).best for k in (1, 8))
    assert many.log_likelihood() > one.log_likelihood() + 10
    u = many.axes[0].design(np.array([0.5, 3.5]))[1] @ np.exp(many.parameters[1:])
    assert u[0] > 4 * u[1]
    again = learn(x * 10, slopes / 10, errors / 100, [Axis(0.0, 40.0, False, 1)], [True]).best
    assert again.parameters == pytest.approx(one.parameters, abs=0.02)  # no unit is preferred


def test_an_average_over_processes_has_the_moments_of_a_mixture():
    """Against samples that are drawn from one process or the other."""
    axes = [AXES["line"]]
    one, other = (process(axes, seed=5, n=4, rough=rough) for rough in (True, False))
    mixed = Learned(one, [one, other], np.array([0.3, 0.7]))
    x = np.array([[-0.5], [0.7], [1.9]])
    mean, covariance = mixed.posterior((x, [-1]), (x[:1], [0]))
    rng, asked = np.random.default_rng(6), ((x, [-1]), (x[:1], [0]))
    counts = {one: 60000, other: 140000}
    drawn = [rng.multivariate_normal(*each.posterior(*asked), n, method="eigh") for each, n in counts.items()]
    samples = np.concatenate(drawn)
    spread = np.sqrt(np.diag(covariance))
    assert np.abs((samples.mean(axis=0) - mean) / spread).max() < 0.015  # 6/sqrt(200,000)
    assert np.abs((np.cov(samples.T) - covariance) / np.outer(spread, spread)).max() < 0.02
    assert mixed.mean(x, [-1])[0] == pytest.approx(mean[:3], rel=1e-12)
    assert mixed.closed().weights is mixed.weights
