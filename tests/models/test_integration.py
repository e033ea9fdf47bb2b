"""SciPy's integrators with a projection after each step, and differences."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.models.integration import METHODS, integrate


def turn(t, y):
    return np.array([-y[1], y[0]])


@pytest.mark.parametrize("method", METHODS)
def test_the_next_step_starts_from_the_projection(method):
    seen = []

    def project(t, y):
        seen.append(y / np.linalg.norm(y))
        return seen[-1]

    options = {"method": METHODS[method], "rtol": 1e-5, "atol": 1e-6}
    found = integrate(turn, (0, 2), [1.0, 0.0], project=project, **options)
    np.testing.assert_array_equal(found.y[:, 1:].T, seen)
    np.testing.assert_allclose(found.y[:, -1], [np.cos(2), np.sin(2)], rtol=0, atol=1e-3)
    # Values between the steps are projected as well.
    dense = integrate(turn, (0, 2), [1.0, 0.0], project=project, dense_output=True, **options).sol
    np.testing.assert_allclose(np.linalg.norm(dense(np.linspace(0, 2, 33)), axis=0), 1.0, rtol=1e-15)
    # What projects to another place moves the rest of the run: here it counts the steps.
    counted = integrate(lambda t, y: 0 * y, (0, 2), [0.0], METHODS[method], lambda t, y: y + 1, max_step=0.1)
    np.testing.assert_allclose(counted.y[0], np.arange(len(counted.t)), rtol=0, atol=1e-12)
