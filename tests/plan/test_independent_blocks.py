"""Blocks of rows whose ranks add up."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from kcons.constraints import Angle, Distance, FixedAtoms, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan.independent_blocks import row_blocks


def blocks(rows, n_atoms, only=None):
    x = np.random.default_rng(1).normal(size=(n_atoms, 3))
    held = ConstraintSet(rows, x, np.ones(n_atoms))
    members, starts = row_blocks(held, lambda item: True, only)
    return held, x, sorted(members[a:b].tolist() for a, b in itertools.pairwise(starts))


def test_a_row_of_several_atoms_is_a_cycle_through_them():
    assert blocks([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], 4)[2] == [[0, 1, 2]]
    assert blocks([Distance([[0, 1]]), Angle([[1, 2, 3]])], 4)[2] == []


def test_fixed_atoms_and_space_are_one_vertex():
    """A chain between two fixed atoms, or between a sphere and a fixed atom, is closed."""
    chain = Distance([[0, 1], [1, 2]])
    assert blocks([chain, FixedAtoms([0])], 3)[2] == []
    assert blocks([chain, FixedAtoms([0, 2])], 3)[2] == [[0, 1]]
    ((_, *rows),) = [[0, *found] for found in blocks([chain, FixedAtoms([0]), Sphere([2], np.zeros(3), None)], 3)[2]]
    assert rows == [0, 1, 5]  # rows 2 to 4 hold the fixed atom


def test_only_some_rows():
    square = Distance([[0, 1], [1, 2], [2, 3], [0, 3], [0, 2]])
    assert blocks([square], 4)[2] == [[0, 1, 2, 3, 4]]
    assert blocks([square], 4, np.array([0, 1, 4]))[2] == [[0, 1, 4]]
    assert blocks([square], 4, np.array([0, 1, 2]))[2] == []


@pytest.mark.parametrize("seed", range(6))
def test_ranks_of_blocks_add_up_to_the_rank_of_all(seed):
    """And no block falls apart: without any one of its atoms, its rows still hang together."""
    rng = np.random.default_rng(seed)
    n = 12
    every = np.array([(i, j) for i in range(n) for j in range(i)])
    pairs = every[rng.choice(len(every), 20, replace=False)]
    held, x, found = blocks([Distance(pairs)], n)
    jacobian = held.jacobian(x).toarray()
    single = len(pairs) - sum(map(len, found))
    assert np.linalg.matrix_rank(jacobian) == single + sum(np.linalg.matrix_rank(jacobian[rows]) for rows in found)
    for rows in found:
        for atom in np.unique(pairs[rows]):
            left = [set(pair) - {atom} for pair in pairs[rows].tolist()]
            reached = set(left[0])
            for _ in left:
                reached |= set().union(*(pair for pair in left if pair & reached))
            assert reached == set(np.unique(pairs[rows]).tolist()) - {atom}
