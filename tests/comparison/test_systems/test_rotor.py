"""A rigid body in free flight: the reference against tops with a closed form, and what it has to keep."""

import numpy as np
import pytest

from kcons.comparison.test_systems.rotor import MASSES, PAIRS, POSITIONS, VELOCITIES, build, flight


def test_a_symmetric_top_precesses_evenly():
    """Four equal masses in a square: about its axis and about L, the body turns at two constant rates."""
    x = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    masses = np.ones(4)
    omega = np.array([0.5, 0.0, 0.8])
    v = np.cross(omega, x) + np.array([0.1, 0.2, 0.3])
    spin = np.array([2.0, 2.0, 4.0]) * omega
    about = spin / 2.0  # rate of precession L/I1, and what is left of the spin along the axis
    own = np.array([0.0, 0.0, omega[2] - about[2]])

    def turned(vectors, rate, time):
        size = np.linalg.norm(rate)
        n, angle = rate / size, size * time
        along = np.outer(vectors @ n, n)
        return along + np.cos(angle) * (vectors - along) + np.sin(angle) * np.cross(n, vectors)

    for time in (0.7, 5.0):
        expected = turned(turned(x, own, time), about, time) + time * np.array([0.1, 0.2, 0.3])
        found = flight(x, v, masses, time)
        np.testing.assert_allclose(found.positions, expected, atol=1e-12)
        assert found.error < 1e-11


@pytest.mark.parametrize("start", VELOCITIES)
def test_distances_stay_and_the_start_is_the_start(start):
    v, h = VELOCITIES[start], 1e-4
    lengths = np.linalg.norm(POSITIONS[PAIRS[:, 0]] - POSITIONS[PAIRS[:, 1]], axis=1)
    before, after = (flight(POSITIONS, v, MASSES, s * h).positions for s in (-1, 1))
    np.testing.assert_allclose((after - before) / (2 * h), v, atol=1e-7)
    x = flight(POSITIONS, v, MASSES, build(start=start).horizon).positions
    np.testing.assert_allclose(np.linalg.norm(x[PAIRS[:, 0]] - x[PAIRS[:, 1]], axis=1), lengths, atol=1e-12)
