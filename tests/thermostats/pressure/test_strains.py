"""The measure of cells: volumes and shapes that are known exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pressure_systems import p_value
from scipy import stats

from kcons.thermostats.pressure.barostat import Strains


def chain(kind, n, log_weight, steps, size=0.5, seed=1):
    """Metropolis' walk over cells, accepted as the barostats do."""
    strains, rng = Strains(kind), np.random.default_rng(seed)
    h, found = np.eye(3), np.empty((steps, 3, 3))
    for k in range(steps):
        e = size * (2 * rng.random(len(strains)) - 1)
        other = h @ strains.matrix(e, strains.frame(h))
        log = log_weight(other) - log_weight(h) + strains.log_measure(e, np.full(3, n))
        if math.log(rng.random()) < log:
            h = other
        found[k] = h
    return found


def test_shapes_of_a_flexible_cell():
    """V^N dV times the measure of shapes is dh for N = 2: under exp(-|h|^2/2) all nine entries are normal.

    Of the lower triangular factor of such a matrix the diagonal is chi(3), chi(2), chi(1), the rest normal.
    """
    cells = chain("flexible", 2, lambda h: -0.5 * (h**2).sum(), 30000)
    for i, expected in enumerate((stats.chi(3), stats.chi(2), stats.chi(1))):
        assert p_value(cells[:, i, i], expected) > 0.01
    for i, j in ((1, 0), (2, 0), (2, 1)):
        assert p_value(cells[:, i, j], stats.norm()) > 0.01


def test_a_turned_cell_is_strained_in_its_own_frame():
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    strains = Strains("flexible")
    h, e = np.tril(rng.standard_normal((3, 3))) + 3 * np.eye(3), 0.05 * rng.standard_normal(6)
    assert strains.frame(h) is None
    frame = strains.frame(h @ turn)
    assert frame == pytest.approx(turn, abs=1e-14)
    assert h @ turn @ strains.matrix(e, frame) == pytest.approx(h @ strains.matrix(e, None) @ turn, abs=1e-13)
    turned = np.tensordot(e, strains.generators_in(frame), 1)
    assert turned == pytest.approx(turn.T @ np.tensordot(e, strains.generators, 1) @ turn, abs=1e-15)
