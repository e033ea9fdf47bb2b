"""Which rows belong together, what shape their clusters have, and blocks whose ranks add up."""

from __future__ import annotations

import itertools
from itertools import combinations, pairwise

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints import Angle, Distance, FixedAtoms, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan import make_plan
from kcons.plan.clusters import LANES_CLUSTERS, Shape, classify
from kcons.plan.independent_blocks import row_blocks
from kcons.solvers.small_clusters import LARGEST

NONE = np.zeros(0, np.int64)
TRIANGLE = list(combinations(range(3), 2))


def places(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * 3


def shapes_of(rows, x, masses=None) -> list[Shape]:
    constraint_set = ConstraintSet(rows, x, np.ones(len(x)) if masses is None else masses)
    plan = make_plan(constraint_set, x, 0.0)
    return list(classify(constraint_set, plan.labels, plan.inverse_masses))


def copies(pairs, atoms: int, times: int) -> held.Distance:
    return held.Distance(np.concatenate([np.array(pairs) + atoms * k for k in range(times)]))


# -- labels -----------------------------------------------------------------------------------------


# -- shapes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", list(np.ndindex(2, 2, 2)))
def test_triangles_of_any_orientation_are_water(order: tuple[int, ...]) -> None:
    pairs = [pair[::-1] if turned else pair for pair, turned in zip(TRIANGLE, order, strict=True)]
    (shape,) = shapes_of(copies(pairs[::-1], 3, 9), places(27), np.tile([16.0, 1, 1], 9))
    assert shape.kind == "RigidTriangles" and shape.clusters == 9
    assert shape.atoms.shape == (9, 3) and shape.rows.shape == (9, 3)
    assert (shape.atoms % 3 == 0).any(axis=0).tolist().count(True) == 1  # oxygen in one place throughout


def test_lanes_hold_one_entry_a_kind_of_cluster() -> None:
    """Rows and atoms stand where the kernels look for them: row k of a cluster is between its own atoms."""
    bonds = [(0, 1), (2, 0), (0, 3)]
    rows = copies(bonds, 4, 10)
    (shape,) = shapes_of(rows, places(40), np.tile([12.0, 1, 1, 1], 10))
    assert shape.kind == "SmallClusters" and shape.independent
    for cluster_rows, atoms in zip(shape.rows, shape.atoms, strict=True):
        for row, pair in zip(cluster_rows, shape.pairs, strict=True):
            assert set(atoms[pair]) == set(rows.atoms[row])


def test_equal_graphs_with_other_masses_are_other_lanes() -> None:
    masses = np.concatenate([np.tile([16.0, 1, 1], 10), np.tile([16.0, 2, 2], 12)])
    shapes = shapes_of(copies(TRIANGLE, 3, 22), places(66), masses)
    assert sorted((s.kind, s.clusters) for s in shapes) == [("RigidTriangles", 10), ("RigidTriangles", 12)]


@pytest.mark.parametrize("few", [LANES_CLUSTERS - 1, LANES_CLUSTERS])
def test_many_kinds_of_few_clusters_go_to_the_sparse_solver(few: int) -> None:
    pairs, masses, first = [], [], 0
    for kind in range(4):
        for _ in range(few):
            pairs += [(first, first + 1), (first, first + 2)]
            masses += [10.0 + kind, 1.0, 1.0]
            first += 3
    shapes = shapes_of(held.Distance(pairs), places(first), np.array(masses))
    kinds = [s.kind for s in shapes]
    assert kinds == (["SparseDistances"] if few < LANES_CLUSTERS else ["SmallClusters"] * 4)
    assert sum(s.clusters for s in shapes) == 4 * few


@pytest.mark.parametrize("rows", [LARGEST, LARGEST + 1])
def test_open_chains_beyond_the_lanes(rows: int) -> None:
    rng = np.random.default_rng(1)
    label = rng.permutation(2 * (rows + 1))
    pairs = [(label[k], label[k + 1]) for k in range(2 * rows + 1) if k != rows]
    pairs = np.array(pairs)[rng.permutation(len(pairs))]
    shapes = shapes_of(held.Distance(pairs), places(len(label)))
    assert {s.kind for s in shapes} == ({"SmallClusters"} if rows <= LARGEST else {"Chains"})
    if rows > LARGEST:
        (shape,) = shapes
        assert shape.clusters == 2 and shape.independent
        assert shape.starts.tolist() == [0, rows + 1, 2 * rows + 2]
        for k in range(2):
            atoms = shape.atoms[shape.starts[k] : shape.starts[k + 1]]
            walked = pairs[shape.rows[k * rows : (k + 1) * rows]]
            for row, (a, b) in enumerate(pairwise(atoms)):
                assert {a, b} == set(walked[row])


@pytest.mark.parametrize("seed", range(5))
def test_every_row_goes_to_exactly_one_shape(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 120
    pairs = {tuple(sorted(rng.choice(n, 2, replace=False).tolist())) for _ in range(90)}
    rows = [held.FixedAtoms([3, 40]), held.Distance(sorted(pairs)), held.Angle([[1, 2, 3], [50, 51, 52]])]
    rows.append(held.CenterOfMass([[7, 8, 9], [60, 61, 62]]))
    x = places(n, seed)
    constraint_set = ConstraintSet(rows, x, rng.choice([1.0, 12.0], n))
    plan = make_plan(constraint_set, x, 0.0)
    taken = np.concatenate([s.rows.ravel() for s in classify(constraint_set, plan.labels, plan.inverse_masses)])
    np.testing.assert_array_equal(np.sort(taken), np.flatnonzero(plan.labels >= 0))
    assert sum(k.clusters for k in plan.kinds) == plan.labels.max() + 1


# -- blocks -----------------------------------------------------------------------------------------


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
