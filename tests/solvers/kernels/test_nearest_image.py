"""Minimum images in kernels: those that a search over neighbouring cells finds."""

import itertools

import numpy as np
import pytest

from kcons.constraints.periodic.one_piece import lattice_of
from kcons.solvers.kernels.nearest_image import NO_LATTICE, nearest_image


@pytest.mark.parametrize("cell", [np.diag([3.0, 4.0, 5.0]), [[4.0, 0, 0], [1.0, 4.5, 0], [-0.8, 0.6, 5.0]]])
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


def test_directions_without_periodicity():
    lattice = lattice_of(np.diag([3.0, 4.0, 5.0]), [True, False, True])
    assert nearest_image.py_func(2.0, 3.0, 4.0, lattice) == pytest.approx((-1.0, 3.0, -1.0))
    assert nearest_image.py_func(2.0, 3.0, 4.0, NO_LATTICE) == (2.0, 3.0, 4.0)
