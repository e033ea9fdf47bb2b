"""The isokinetic flow: closed form, reference, and the compression of phase space."""

import numpy as np
import pytest
from flow_reference import case

from kcons.errors import InputError
from kcons.models.flows import Thermostat


def quartic(x):
    return -np.array([1.0, 2.0, 0.5, 1.5, 1.0, 0.7]) * x**3 - 0.3 * np.roll(x, 1) * x[::-1]


def springs(x):
    r = x.reshape(3, 2)
    d = r[:, None] - r[None, :]
    return -0.3 * (d * (1 + np.sum(d * d, axis=2, keepdims=True))).sum(axis=1).ravel()


def start(masses, *, removed=0, seed=6):
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=len(masses)), rng.normal(size=len(masses))
    if removed:
        p = (masses * v).reshape(-1, removed).sum(axis=0)
        v = v - np.tile(p, len(v) // removed) / masses.reshape(-1, removed).sum(axis=0)[0]
    return x, v


MASSES = np.repeat([1.0, 3.0, 0.4], 2)


@pytest.mark.parametrize(("force", "removed"), [pytest.param(quartic, 0, marks=pytest.mark.validation), (springs, 2)])
def test_compression_is_minus_g_minus_one_times_alpha(force, removed):
    flow = Thermostat(MASSES, force, momentum_removed=removed)
    x, v = start(MASSES, removed=removed)
    X = flow.state(x, v)
    g = flow.degrees_of_freedom
    assert g == 6 - removed
    assert abs(flow.friction(X)) > 0.1
    assert flow.surface_divergence(X) == pytest.approx(-(g - 1) * flow.friction(X), rel=1e-8)
    found = flow.compression(X, [0.0, 0.2, 0.5])
    assert abs(found.predicted[-1]) > 0.1
    assert found.log_volume == pytest.approx(found.predicted, abs=1e-8)
    # With g, or g - 2, in place of g - 1 it would not be.
    assert abs(found.log_volume[-1] * g / (g - 1) - found.predicted[-1]) > 1e-3


def test_kinetic_energy_and_momentum_are_kept():
    flow = Thermostat(MASSES, springs, momentum_removed=2)
    x, v = start(MASSES, removed=2)
    end = flow.solve((0.0, 3.0), flow.state(x, v)).y[:, -1]
    assert end[6:] @ end[6:] == pytest.approx(v @ (MASSES * v), rel=1e-9)
    assert (flow.root * end[6:]).reshape(3, 2).sum(axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)


def test_reference_of_constant_force():
    given = case("A10_isokinetic_constant_force")
    masses = np.repeat(given["masses"], 3)
    f = np.array([np.zeros(3)] * len(given["masses"]))
    for spec in given["forces"]:
        f[spec["atom"]] += spec["F"]
    flow = Thermostat(masses, lambda x: f.ravel())
    x, v = (np.array(given["initial"][key]).ravel() for key in ("positions", "velocities"))
    for k, t in enumerate(given["times"]):
        position, velocity = flow.exact_constant_force(t, x, v)
        assert abs(position - np.ravel(given["reference"]["positions"][k])).max() < 1e-10
        assert abs(velocity - np.ravel(given["reference"]["velocities"][k])).max() < 1e-10


def test_closed_form_at_its_limits():
    f = np.array([0.0, 2.0])
    flow = Thermostat([1.0, 1.0], lambda x: f)
    # Along the force and against it; very long times; no force.
    for v, t in (([0.0, 1.0], 3.0), ([0.0, -1.0], 3.0), ([1.0, 0.0], 1e4), ([1.0, -0.5], 2.0)):
        position, velocity = flow.exact_constant_force(t, [0.0, 0.0], v)
        assert velocity @ velocity == pytest.approx(np.dot(v, v), rel=1e-13)
        assert np.all(np.isfinite(position))
    assert flow.exact_constant_force(3.0, [0.0, 0.0], [0.0, 1.0])[0] == pytest.approx([0.0, 3.0])
    found = flow.solve((0.0, 2.0), flow.state([0.0, 0.0], [1.0, -0.5]), rtol=1e-12, atol=1e-13).y[:, -1]
    position, velocity = flow.exact_constant_force(2.0, [0.0, 0.0], [1.0, -0.5])
    assert found == pytest.approx(np.concatenate([position, velocity]), abs=1e-10)
    free = Thermostat([1.0, 1.0], lambda x: np.zeros(2))
    assert free.exact_constant_force(2.0, [0.0, 0.0], [1.0, -0.5])[0].tolist() == [2.0, -1.0]


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="masses"):
        Thermostat([1.0, 0.0], quartic)
    with pytest.raises(InputError, match="divide"):
        Thermostat([1.0, 1.0, 1.0], quartic, momentum_removed=2)
    with pytest.raises(InputError, match="non-zero kinetic energy"):
        Thermostat(MASSES, quartic).state(np.zeros(6), np.zeros(6))
    with pytest.raises(InputError, match="momentum is not zero"):
        Thermostat(MASSES, springs, momentum_removed=2).state(np.zeros(6), np.ones(6))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Thermostat(np.ones(4), lambda x: -x, momentum_removed=-2), "momentum_removed is -2"),
        (lambda: Thermostat(np.ones(5), lambda x: -x, momentum_removed=2.5), "momentum_removed is 2.5"),
        (lambda: Thermostat(np.ones(2), lambda x: -x).state([1.0, 2.0, 0.3], [0.4]), "2 components each"),
        (lambda: Thermostat(np.ones(2), lambda x: [1.0, 2.0, 3.0]).friction(np.ones(4)), "force returned shape"),
        (
            lambda: Thermostat(np.ones(2), lambda x: -x).compression([1.0, 0.2, 0.3, 0.4], [0.0, 1.0], pieces=0),
            "pieces is 0",
        ),
        (
            lambda: Thermostat(np.ones(4), lambda x: [1.0, 0.0, 0.0, 0.0], momentum_removed=2).state(
                [0.0, 0.0, 1.0, 1.0], [0.3, 0.1, -0.3, -0.1]
            ),
            "forces do not sum to zero",
        ),
    ],
)
def test_thermostats_that_cannot_be(make, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
