"""Minimal coordinates: quaternions turn as they should, and the integration states an honest error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from kcons.comparison.test_systems.minimal import integrated, single, spin, turned
from kcons.errors import InputError


def test_quaternions_turn_vectors():
    rng = np.random.default_rng(0)
    q, r = rng.standard_normal(4), rng.standard_normal((5, 3))
    np.testing.assert_allclose(turned(q, r), Rotation.from_quat(q).apply(r), atol=1e-14)
    np.testing.assert_allclose(turned(3.0 * q, r), turned(q, r), atol=1e-14)


def test_spin_is_a_turn_about_the_body_axis():
    rng = np.random.default_rng(1)
    q, omega = rng.standard_normal(4), rng.standard_normal(3)
    q /= np.linalg.norm(q)
    r = rng.standard_normal((2, 3))
    h = 1e-5
    change = (turned(q + h * spin(q, omega), r) - turned(q - h * spin(q, omega), r)) / (2 * h)
    np.testing.assert_allclose(change, turned(q, np.cross(omega, r)), atol=1e-9)


def test_integration_meets_the_exponential():
    matrix = np.array([[0.0, 1.0], [-4.0, -0.1]])
    start = np.array([1.0, 0.5])
    found = integrated(lambda t, y: matrix @ y, start, 7.0, lambda y: np.append(y, 0.0)[None], "a linear system")
    wanted = expm(7.0 * matrix) @ start
    off = np.linalg.norm(found.positions[0, :2] - wanted)
    assert off < 1e-13
    assert off < found.error + 1e-15 < 1e-11
    assert found.how == "a linear system, DOP853 at rtol 2.3e-14"


def test_single():
    single(1, "one thing")
    with pytest.raises(InputError, match="one thing; it cannot be built at size 4"):
        single(4, "one thing")
