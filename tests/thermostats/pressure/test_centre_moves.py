"""Compiled moves of pieces, against the same written with arrays."""

from __future__ import annotations

import numpy as np
import pytest
from pressure_systems import METHANE, gas

from kcons.thermostats.pressure.pieces import displacements, work_of_shapes
from kcons.thermostats.pressure.pieces import find_pieces, lattice_of

CHANGE = 0.1 * np.random.default_rng(4).standard_normal((3, 3))


@pytest.fixture
def cut():
    """Six molecules, some of them cut by faces of the cell, one that stays along y."""
    system, x = gas(METHANE, 6)
    rng = np.random.default_rng(2)
    x = x + 12.0 * rng.integers(-2, 3, (len(x), 3))
    pieces = find_pieces(system, x, np.ones(3, bool))
    pieces.open[4, 1] = False
    own = pieces.label, pieces.weight, pieces.open, *pieces.tree
    return x, pieces, own, lattice_of(system)


def whole(x, lattice):
    """Each molecule next to its first atom."""
    y = x.reshape(6, 5, 3)
    d = y - y[:, :1]
    return (y[:, :1] + d - np.round(d @ lattice[1]) @ lattice[0]).reshape(-1, 3)


def test_displacements(cut):
    x, pieces, own, lattice = cut
    y, d = whole(x, lattice), np.empty_like(x)
    torn = displacements(x, *own, lattice, CHANGE, d)
    moved = (pieces.centres(y) @ CHANGE * pieces.open)[pieces.label]
    images = np.round((y - x) @ lattice[1]) @ (lattice[0] @ CHANGE)
    assert d == pytest.approx(moved - images, abs=1e-12)
    assert torn == 20 + np.flatnonzero(images[20:25, 1])[0]
    assert displacements(y, *own, lattice, CHANGE, d) == -1
    assert d == pytest.approx(moved, abs=1e-12)


def test_work_of_shapes(cut):
    x, pieces, own, lattice = cut
    y, f = whole(x, lattice), np.random.default_rng(3).standard_normal(x.shape)
    expected = y.T @ f - pieces.centres(y).T @ (pieces.sums(f) * pieces.open)
    assert work_of_shapes(x, f, *own, lattice) == pytest.approx(expected, abs=1e-11)
