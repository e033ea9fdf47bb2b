"""Clusters eight at a time: tables, what is undone, and the worst row."""

import numpy as np

from kcons.solvers.kernels.eight_wide import WIDTH
from kcons.solvers.kernels.groups_of_eight import SAVED, lane_tables, restore_points, worst_row


def test_the_last_group_repeats_its_last_cluster():
    atoms = np.arange(22).reshape(11, 2) + 100
    rows, points = lane_tables(atoms, 3)
    assert rows.tolist() == [3 * min(k, 10) for k in range(16)]
    table = points.reshape(2, 2, WIDTH)  # group, local atom, lane
    assert np.array_equal(table[0], 3 * atoms[:8].T)
    assert np.array_equal(table[1], 3 * atoms[[8, 9, 10, 10, 10, 10, 10, 10]].T)


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
