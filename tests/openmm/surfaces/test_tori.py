"""Tori: F and its slope from three scalar products, and Newton's method from a flight."""

import re

import numpy as np
from surface_cases import CENTER, TURN

from kcons.constraints import Torus
from kcons.openmm.surfaces.tori import _VALUE, NEWTON_STEPS, TorusRows


def evaluated(l, **numbers):
    """F and its slope at l by the expressions of the program, whose definitions stand last first."""
    names = {"sqrt": np.sqrt, "max": np.maximum, "t_l": l, "t_on": 1.0, **numbers}
    for definition in reversed(re.sub(r"\^", "**", _VALUE).split(";")):
        name, _, expression = definition.strip().partition("=")
        names[name] = eval(expression, {"__builtins__": {}}, names)
    return names["F"], names["slope"]


def test_newton_steps_land_on_the_torus():
    axis, major, minor = TURN[0], 1.2, 0.5
    rng = np.random.default_rng(4)
    around, along = rng.uniform(0, 2 * np.pi, (2, 20))
    ring = np.cos(around)[:, None] * TURN[1] + np.sin(around)[:, None] * TURN[2]
    x = CENTER + (major + minor * np.cos(along))[:, None] * ring + minor * np.sin(along)[:, None] * axis
    d = x - CENTER
    height = d @ axis
    rho = np.sqrt(np.sum(d * d, axis=1) - height**2)
    gradient = d - (major / rho)[:, None] * (d - height[:, None] * axis)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), minor, rtol=1e-13)

    du = d + 0.08 * rng.normal(size=d.shape)
    numbers = {
        "t_major": major,
        "t_minor": minor,
        "t_u": height,
        "t_d": np.sum(du * du, axis=1),
        "t_z": du @ axis,
        "t_t": np.sum(du * gradient, axis=1),
    }

    def direct(l):
        y = du + l[:, None] * gradient
        z = y @ axis
        return (np.sqrt(np.sum(y * y, axis=1) - z * z) - major) ** 2 + z * z - minor**2

    l = 0.01 * rng.normal(size=len(d))
    value, slope = evaluated(l, **numbers)
    np.testing.assert_allclose(value, direct(l), atol=1e-14)
    np.testing.assert_allclose(slope, (direct(l + 1e-6) - direct(l - 1e-6)) / 2e-6, atol=1e-8)
    l = np.zeros(len(d))
    for _ in range(NEWTON_STEPS):
        value, slope = evaluated(l, **numbers)
        l = l - value / slope
    assert np.abs(direct(l)).max() < 1e-15 * 10
    assert np.all(np.abs(l) < 1.0)


def test_parameters_of_each_torus():
    rows = TorusRows([Torus([3, 1], [CENTER, -CENTER], [TURN[0], TURN[1]], [1.2, 1.5], [0.4, 0.3])], 5)
    assert rows.atoms.tolist() == [3, 1] and rows._minor.tolist() == [0.4, 0.3]
    np.testing.assert_allclose(rows._axes, TURN[:2], atol=1e-15)
    assert [rows.row_name(k) for k in range(2)] == ["Torus(3)", "Torus(1)"]
