"""Oscillators, pendulum, particle on a sphere and thermostat against closed forms and reference cases."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from model_references import case

from kcons.constraints import projection
from kcons.models.flows import (
    DampedOscillator,
    HarmonicOscillator,
    ParticleOnSphere,
    Pendulum,
    Thermostat,
)

REGIMES = case("A12_damped_oscillator")["regimes"]


@pytest.mark.parametrize("number", range(len(REGIMES)))
def test_damped_oscillator_reference(number):
    given, regime = case("A12_damped_oscillator"), REGIMES[number]
    w = given["parameters"]["w"]
    flow = DampedOscillator(w, 2 * regime["zeta"] * w)
    # x_1 = Omega x, x_2 = dx/dt
    X0 = np.array([w * given["parameters"]["x0"], given["parameters"]["v0"]])
    for k, t in enumerate(given["times"]):
        wanted = np.array([w * regime["x"][k], regime["v"][k]])
        for found in (flow.closed_form(t) @ X0, flow.exact(t, X0)):
            assert abs(found - wanted).max() < 1e-12 * max(abs(wanted).max(), 1e-3)
    assert np.all(np.isfinite(flow.closed_form(1e5)))
    eigenvalues = sorted((complex(*pair) for pair in regime["eigenvalues"]), key=lambda z: (z.real, z.imag))
    # The first of (23) is the faster one, or the one below the real axis. Near critical damping a rounding of eta, by
    # eps, moves them by eps/a.
    a = np.sqrt(abs(regime["zeta"] ** 2 - 1))
    rounding = 4 * np.finfo(float).eps * w * max(1.0, regime["zeta"]) * (1 + (1 / a if a else 0.0))
    assert flow.eigenvalues() == pytest.approx(eigenvalues, abs=rounding)


@pytest.mark.parametrize(
    ("omega", "eta"),
    [(1.0, 0.2), (1.3, 0.0), (0.7, 1.4), (1.0, 2.0 + 1e-9), (1.0, 2.0 - 1e-9), (3.0, 7.0), (1.0, 1e9), (1e150, 1e170)],
)
def test_oscillator_eigenvalues_to_the_last_digits(omega, eta):
    # (23) with 100 digits from the same two numbers.
    with localcontext(prec=100):
        W, E = Decimal(omega), Decimal(eta)
        square = (E - 2 * W) * (E + 2 * W)
        root = abs(square).sqrt()
        wanted = [-(E + root) / 2, -(E - root) / 2] if square > 0 else [complex(-E / 2, s * root / 2) for s in (-1, 1)]
    for own, true in zip(DampedOscillator(omega, eta).eigenvalues(), map(complex, wanted), strict=True):
        assert own.real == pytest.approx(true.real, rel=1e-15, abs=0.0)
        assert own.imag == pytest.approx(true.imag, rel=1e-15, abs=0.0)


@pytest.mark.parametrize("eta", [0.0, 0.2, 1.9, 2.0, 2.1, 5.0])
def test_jordan_form_of_the_oscillator(eta):
    omega, t = 1.7, 0.6
    flow = DampedOscillator(omega, omega * eta)
    form = flow.jordan_form()
    assert form.T @ form.J @ np.linalg.inv(form.T) == pytest.approx(flow.matrix, abs=1e-13)
    assert form.propagator(t) == pytest.approx(flow.closed_form(t), abs=1e-13)
    if eta == 2.0:
        assert form.J.tolist() == [[-omega, 1.0], [0.0, -omega]]
        return
    # As (24) is printed.
    a = np.sqrt(complex(flow.eta**2 - 4 * omega**2))
    printed = np.array([[(a - flow.eta) / (2 * omega), -(a + flow.eta) / (2 * omega)], [1.0, 1.0]])
    assert pytest.approx(printed, abs=1e-14) == form.T
    assert pytest.approx(np.diag([-(a + flow.eta) / 2, (a - flow.eta) / 2]), abs=1e-14) == form.J


def test_harmonic_oscillator_runs_on_a_circle():
    flow, (x1, x2) = HarmonicOscillator(1.7), (0.6, -0.8)
    t = np.linspace(0.0, 9.0, 7)
    c, s = np.cos(1.7 * t), np.sin(1.7 * t)  # (18), (19)
    circle = pytest.approx(np.stack([c * x1 + s * x2, c * x2 - s * x1], axis=1), abs=1e-12)
    assert flow.exact(t, [x1, x2]) == circle and np.array([flow.closed_form(u) @ [x1, x2] for u in t]) == circle
    assert flow.velocity(0.0, [x1, x2]) == pytest.approx([1.7 * x2, -1.7 * x1])
    assert flow.divergence(0.0, [x1, x2]) == 0.0


@pytest.mark.parametrize("name", ["10deg", "90deg", "150deg", "rotating"])
def test_pendulum_reference(name):
    given = case(f"A03_planar_pendulum_{name}")
    x, v = (np.array(given["initial"][key])[0] for key in ("positions", "velocities"))
    pivot = np.array(given["constraints"][0].get("point", [0.0, 0.0, 0.0]))
    angle = np.arctan2((x - pivot)[0], -(x - pivot)[2])
    start = [angle, v[0] * np.cos(angle) + v[2] * np.sin(angle)]
    times, order = np.unique(given["times"], return_inverse=True)
    theta, rate = Pendulum().solve((0, times[-1]), start, t_eval=times, rtol=1e-13, atol=1e-15).y[:, order]
    along, out = (
        np.stack(part, axis=1)
        for part in ([np.cos(theta), 0 * rate, np.sin(theta)], [np.sin(theta), 0 * rate, -np.cos(theta)])
    )
    reference = {key: np.array(given["reference"][key])[:, 0] for key in ("positions", "velocities")}
    assert out + pivot == pytest.approx(reference["positions"], abs=1e-10)
    assert rate[:, None] * along == pytest.approx(reference["velocities"], abs=1e-10)


def test_acceleration_on_the_sphere_is_the_projected_one():
    rng = np.random.default_rng(4)
    x = rng.normal(size=3)
    x *= 1.5 / np.linalg.norm(x)
    v = np.cross(x, rng.normal(size=3))
    f = rng.normal(size=3)
    flow = ParticleOnSphere(1.5, 2.0, lambda x: f)
    wanted = projection.acceleration(2 * x[None, :], [2.0], f, [-2 * v @ v])
    assert flow.acceleration(x, v) == pytest.approx(wanted, rel=1e-12)


# -- the thermostat --------------------------------------------------------------------------------------


def quartic(x):
    return -np.array([1.0, 2.0, 0.5, 1.5, 1.0, 0.7]) * x**3 - 0.3 * np.roll(x, 1) * x[::-1]


MASSES = np.repeat([1.0, 3.0, 0.4], 2)


def start():
    return np.random.default_rng(6).normal(size=(2, 6))


def test_compression_is_minus_g_minus_one_times_alpha():
    flow, g = Thermostat(MASSES, quartic), 6
    X = flow.state(*start())
    assert abs(flow.friction(X)) > 0.1
    log_volume, predicted = flow.compression(X, [0.0, 0.3])
    assert abs(predicted[-1]) > 0.1
    assert log_volume == pytest.approx(predicted, abs=1e-8)
    # With g, or g - 2, in place of g - 1 it would not be.
    assert abs(log_volume[-1] * g / (g - 1) - predicted[-1]) > 1e-3


def test_kinetic_energy_is_kept():
    flow, (x, v) = Thermostat(MASSES, quartic), start()
    alpha = v @ quartic(x) / (v @ (MASSES * v))
    slope = flow.velocity(0.0, flow.state(x, v)) / np.tile(np.sqrt(MASSES), 2)
    assert slope == pytest.approx(np.append(v, quartic(x) / MASSES - alpha * v), rel=1e-12)  # (113)
    end = flow.solve((0.0, 3.0), flow.state(x, v)).y[:, -1]
    assert end[6:] @ end[6:] == pytest.approx(v @ (MASSES * v), rel=1e-9)
