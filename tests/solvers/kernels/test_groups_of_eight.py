"""Clusters eight at a time: tables, lattices, what is undone, and the worst row."""

import numpy as np
import pytest
from numba import njit

from kcons.constraints.periodic.one_piece import lattice_of
from kcons.solvers.kernels.eight_wide import FASTMATH, WIDTH, load_triple, store_triple
from kcons.solvers.kernels.groups_of_eight import (
    OPEN,
    ORTHORHOMBIC,
    SAVED,
    TRICLINIC,
    lane_tables,
    lattice_kind,
    lattice_numbers,
    minimum_image,
    restore_points,
    worst_row,
)

SKEW = [[4.0, 0, 0], [1.0, 4.5, 0], [-0.8, 0.6, 5.0]]


def test_the_last_group_repeats_its_last_cluster():
    atoms = np.arange(22).reshape(11, 2) + 100
    rows, points = lane_tables(atoms, 3)
    assert rows.tolist() == [3 * min(k, 10) for k in range(16)]
    table = points.reshape(2, 2, WIDTH)  # group, local atom, lane
    assert np.array_equal(table[0], 3 * atoms[:8].T)
    assert np.array_equal(table[1], 3 * atoms[[8, 9, 10, 10, 10, 10, 10, 10]].T)


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


def test_what_was_kept_is_put_back():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(16, 3))
    table = lane_tables(rng.permutation(16).reshape(8, 2), 1)[1]
    atoms = (table // 3).reshape(2, WIDTH)
    undo = rng.normal(size=3 * SAVED)
    restore_points(points, table, undo, 1, 2, 3, 1)
    for k in range(2):
        assert np.array_equal(points[atoms[k]], undo[(1 + k) * SAVED : (2 + k) * SAVED].reshape(3, WIDTH).T)


def test_the_worst_row_of_a_group():
    errors, sizes = np.zeros(2 * WIDTH), np.ones(2 * WIDTH)
    errors[1 * WIDTH + 5], errors[3] = -4.0, 3.0
    sizes[3] = 0.5
    assert worst_row(errors, sizes, 2) == (6.0, 2 * 3 + 0)
    sizes[3] = 2.0
    assert worst_row(errors, sizes, 2) == (4.0, 2 * 5 + 1)
    errors[WIDTH] = np.nan
    worst, row = worst_row(errors, sizes, 2)
    assert np.isnan(worst) and row == 1
    assert worst_row(np.zeros(2 * WIDTH), np.zeros(2 * WIDTH), 2) == (0.0, 0)
