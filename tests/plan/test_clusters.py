"""Which rows belong together, and what shape their clusters have."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan import make_plan
from kcons.plan.clusters import LANES_CLUSTERS, LANES_ROWS, Shape, classify, cluster_labels

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


def same_partition(labels, groups) -> bool:
    found = {frozenset(np.flatnonzero(labels == label).tolist()) for label in set(labels.tolist()) if label >= 0}
    return found == {frozenset(group) for group in groups}


# -- labels -----------------------------------------------------------------------------------------


def test_fixed_atoms_separate_and_their_rows_belong_to_no_cluster() -> None:
    rows = [held.FixedAtoms([2, 5]), held.Distance([[0, 1], [1, 2], [2, 3], [3, 4], [2, 5]])]
    x = places(6)
    labels = cluster_labels(ConstraintSet(rows, x, np.ones(6)), np.array([2, 5]))
    assert same_partition(labels, [(6, 7), (8, 9)])
    assert (labels[:6] == -1).all() and labels[10] == -1


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


@pytest.mark.parametrize("rows", [LANES_ROWS, LANES_ROWS + 1])
def test_open_chains_beyond_the_lanes(rows: int) -> None:
    rng = np.random.default_rng(1)
    label = rng.permutation(2 * (rows + 1))
    pairs = [(label[k], label[k + 1]) for k in range(2 * rows + 1) if k != rows]
    pairs = np.array(pairs)[rng.permutation(len(pairs))]
    shapes = shapes_of(held.Distance(pairs), places(len(label)))
    assert {s.kind for s in shapes} == ({"SmallClusters"} if rows <= LANES_ROWS else {"Chains"})
    if rows > LANES_ROWS:
        (shape,) = shapes
        assert shape.clusters == 2 and shape.independent
        assert shape.starts.tolist() == [0, rows + 1, 2 * rows + 2]
        for k in range(2):
            atoms = shape.atoms[shape.starts[k] : shape.starts[k + 1]]
            walked = pairs[shape.rows[k * rows : (k + 1) * rows]]
            for row, (a, b) in enumerate(pairwise(atoms)):
                assert {a, b} == set(walked[row])


@pytest.mark.parametrize(
    ("pairs", "independent"),
    [
        ([(k, k + 1) for k in range(9)] + [(9, 0)], False),  # a ring
        ([(0, k) for k in range(1, 10)], True),  # a star
        ([(k, k + 1) for k in range(8)] + [(4, 9)], True),  # a branch
        ([(k, k + 1) for k in range(9)] + [(0, 1)], False),  # one bond twice
    ],
)
def test_other_graphs_are_sparse(pairs: list[tuple[int, int]], independent: bool) -> None:
    (shape,) = shapes_of(held.Distance(pairs), places(10))
    assert shape.kind == "SparseDistances" and shape.clusters == 1
    assert shape.independent is independent


def test_mixed_and_general_rows() -> None:
    rows = [
        held.Distance([[0, 1], [4, 5], [8, 9], [12, 13]]),
        held.Angle([[0, 1, 2]]),  # compiled: mixed
        held.RadiusOfGyration([[4, 5, 6, 7, 8]]),  # a function: mixed
        held.LinearVelocity([[10, 11]], [[1.0, 0, 0], [0, 1.0, 0]]),  # velocity rows: mixed
        held.Sphere([3], [9.0, 0, 0]),  # a function alone
        held.ImplicitSurface([14, 15], lambda r: r[:, 0] - 3.0, target=None),  # a function of two rows at once
    ]
    shapes = {s.kind: s for s in shapes_of(rows, places(16))}
    assert set(shapes) == {"SmallClusters", "SingleRows", "SparseRows", "GeneralClusters"}
    assert shapes["SparseRows"].rows.tolist() == [0, 1, 2, 4, 5, 6] and shapes["SparseRows"].clusters == 3
    assert shapes["SingleRows"].rows.tolist() == [7] and shapes["SingleRows"].clusters == 1
    assert shapes["GeneralClusters"].rows.tolist() == [8, 9] and shapes["GeneralClusters"].clusters == 2
    assert shapes["SmallClusters"].rows.tolist() == [[3]]


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
