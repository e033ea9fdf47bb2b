"""Minimum images in kernels: those that a search over neighboring cells finds, one at a time and eight."""

import itertools

import numpy as np
import pytest
from numba import njit

from kcons.constraints.periodic.one_piece import lattice_of
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH, load_triple, store_triple
from kcons.solvers.kernels.lattices import (
    OPEN,
    ORTHORHOMBIC,
    TRICLINIC,
    lattice_kind,
    lattice_numbers,
    minimum_image,
    nearest_image,
)

SKEW = [[4.0, 0, 0], [1.0, 4.5, 0], [-0.8, 0.6, 5.0]]


def test_which_minimum_image_a_lattice_needs():
    assert lattice_kind(None)[1] == OPEN
    assert lattice_kind(lattice_of(np.diag([3.0, 4.0, 5.0]), True))[1] == ORTHORHOMBIC
    assert lattice_kind(lattice_of(np.diag([3.0, 4.0, 5.0]), [True, False, True]))[1] == ORTHORHOMBIC
    assert lattice_kind(lattice_of(np.array(SKEW), True))[1] == TRICLINIC


@njit(fastmath=FASTMATH)
def wrap(lines, lattice, kind):
    cell = lattice_numbers(lattice)
    x, y, z = load_triple(lines, 0)
    x, y, z = minimum_image(x, y, z, cell, kind)
    store_triple(lines, 0, x, y, z)


@pytest.mark.parametrize(("cell", "periodic"), [(np.diag([3.0, 4.0, 5.0]), [True, True, False]), (SKEW, [True] * 3)])
def test_eight_bonds_come_back_from_other_cells(cell, periodic):
    rng = np.random.default_rng(1)
    short = 0.4 * rng.normal(size=(WIDTH, 3)).clip(-2.5, 2.5)
    far = short + (rng.integers(-2, 3, (WIDTH, 3)) * np.array(periodic)) @ np.array(cell)
    lines = far.T.ravel().copy()
    wrap(lines, *lattice_kind(lattice_of(np.array(cell, float), periodic)))
    np.testing.assert_allclose(lines.reshape(3, WIDTH).T, short, atol=1e-13)


@pytest.mark.parametrize("cell", [np.diag([3.0, 4.0, 5.0]), SKEW])
def test_the_nearest_of_all_images(cell):
    cell = np.array(cell)
    rng = np.random.default_rng(1)
    for _ in range(50):
        short = 0.3 * rng.normal(size=3)  # less than half the cell
        far = short + rng.integers(-3, 4, 3) @ cell
        found = np.array(nearest_image.py_func(*far, lattice_of(cell, True)))
        around = [far + np.array(n) @ cell for n in itertools.product(range(-4, 5), repeat=3)]
        nearest = min(around, key=np.linalg.norm)
        np.testing.assert_allclose(found, nearest, atol=1e-12)
        np.testing.assert_allclose(found, short, atol=1e-12)
