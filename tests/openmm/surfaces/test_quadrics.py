"""Quadrics: the coefficients are those of the constraint, and the root is the landing."""

import numpy as np
import pytest
from surface_cases import KINDS, POSITIONS, QUADRICS

from kcons.openmm.surfaces.quadrics import QuadricRows

ATOMS = np.arange(3)


def rows_of(kind):
    item = KINDS[kind](ATOMS, POSITIONS)
    item = item if item.target is not None else item.with_target(item.measure(POSITIONS[item.atoms], 0.0))
    return item, QuadricRows([item], 3)


def value(rows, x):
    d = x - rows.centers
    bent = np.einsum("kij,kj->ki", rows.matrices, d)
    return np.einsum("ki,ki->k", d, bent + 2 * rows.flats) - rows.levels, bent + rows.flats


@pytest.mark.parametrize("kind", QUADRICS)
def test_the_quadric_is_the_surface_of_the_constraint(kind):
    """Zero where it holds, with gradients along those of the constraint, wherever x is."""
    item, rows = rows_of(kind)
    assert np.abs(value(rows, POSITIONS)[0]).max() < 1e-14
    normal = item.gradient(POSITIONS[item.atoms], 0.0)[:, 0]
    slope = value(rows, POSITIONS)[1]
    across = np.linalg.norm(np.cross(normal, slope), axis=1)
    assert np.all(across < 1e-13 * np.linalg.norm(normal, axis=1) * np.linalg.norm(slope, axis=1))
    off = item.measure(1.1 * POSITIONS[item.atoms], 0.0) - item.target_at(0.0)
    assert np.all(off * value(rows, 1.1 * POSITIONS)[0] > 0)


@pytest.mark.parametrize("kind", QUADRICS)
def test_the_root_lands(kind):
    """l = -S/(B + sqrt(B^2 - A S)) along the gradient of the start, for flights of a tenth."""
    _, rows = rows_of(kind)
    gradient = value(rows, POSITIONS)[1]
    flown = POSITIONS + 0.1 * np.random.default_rng(1).normal(size=(3, 3))
    s, slope = value(rows, flown)
    a = np.einsum("ki,kij,kj->k", gradient, rows.matrices, gradient)
    b = np.einsum("ki,ki->k", gradient, slope)
    l = -s / (b + np.sqrt(b * b - a * s))
    assert np.abs(value(rows, flown + l[:, None] * gradient)[0]).max() < 1e-14


def test_spheres_are_known_for_great_circles():
    assert rows_of("sphere")[1].spheres and not rows_of("cylinder")[1].spheres
