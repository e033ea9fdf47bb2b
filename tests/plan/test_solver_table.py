"""The solver table: every line is picked for the shape it is made for, with its rank."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan import make_plan

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])


OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


HEXAGON = np.array([[np.cos(t), np.sin(t), 0.2 * (-1) ** k] for k, t in enumerate(np.arange(6) * np.pi / 3)])


ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)


def all_pairs(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


def many(shape: np.ndarray, pairs, times: int) -> tuple[held.Distance, np.ndarray]:
    shift = np.random.default_rng(0).uniform(-20, 20, (times, 1, 3))
    rows = np.concatenate([np.array(pairs) + len(shape) * k for k in range(times)])
    return held.Distance(rows), (shape + shift).reshape(-1, 3)


def planned(rows, x, masses=None):
    constraint_set = ConstraintSet(rows, x, np.ones(len(x)) if masses is None else masses)
    return make_plan(constraint_set, np.asarray(x), 0.0)


def lines(plan) -> list[tuple[str, int, int, int]]:
    return [(k.solver, k.clusters, k.rows, k.rank) for k in plan.kinds]


@pytest.mark.parametrize(
    ("shape", "pairs", "times", "expected"),
    [
        (WATER, all_pairs(3), 1, ("water", 1, 3, 3)),
        (WATER, all_pairs(3), 50, ("water", 50, 150, 150)),
        (WATER[:2], [(0, 1)], 9, ("lanes", 9, 9, 9)),
        (WATER, [(0, 1), (0, 2)], 9, ("lanes", 9, 18, 18)),
        (METHANE, [(0, k) for k in range(1, 5)], 9, ("lanes", 9, 36, 36)),
        (TETRAHEDRON, all_pairs(4), 9, ("lanes", 9, 54, 54)),
        (ZIGZAG, [(k, k + 1) for k in range(19)], 3, ("chain", 3, 57, 57)),
        (HEXAGON, [(k, (k + 1) % 6) for k in range(6)], 9, ("lanes", 9, 54, 54)),
        (METHANE, all_pairs(5), 4, ("sparse", 4, 40, 36)),  # rank-deficient
        (OCTAHEDRON, all_pairs(6), 2, ("sparse", 2, 30, 24)),
        (WATER[:2], [(0, 1), (1, 0)], 9, ("sparse", 9, 18, 9)),  # small, and rank-deficient
        (WATER, [*all_pairs(3), (0, 1)], 9, ("sparse", 9, 36, 27)),
    ],
)
def test_table_for_distances(shape, pairs, times, expected) -> None:
    rows, x = many(shape, pairs, times)
    plan = planned(rows, x)
    assert lines(plan) == [expected]
    assert plan.rank == expected[3]
    assert bool(plan.dependent) is (expected[3] < expected[2])
    assert not plan.driven


def test_few_clusters_of_many_kinds_share_the_sparse_solver() -> None:
    pairs, x, masses = [], [], []
    for kind in range(4):
        for _ in range(2):
            pairs += [(len(x) + i, len(x) + j) for i, j in ((0, 1), (0, 2))]
            x += list(WATER + 5.0 * len(x))
            masses += [12.0 + kind, 1.0, 1.0]
    plan = planned(held.Distance(pairs), np.array(x), np.array(masses))
    assert lines(plan) == [("sparse", 8, 16, 16)]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([held.Distance([0, 1]), held.Angle([0, 1, 2])], ("mixed", 1, 2, 2)),
        ([held.Sphere([0, 1, 2], [9.0, 0, 0])], ("single", 3, 3, 3)),
        ([held.Distance([0, 1]), held.Plane([0, 1], [0, 0, 1.0])], ("mixed", 1, 3, 3)),
        ([held.Angle([[0, 1, 2], [2, 1, 0]])], ("mixed", 1, 2, 1)),
        ([held.Distance([0, 1]), held.CenterOfMass([[0, 1, 2, 3, 4]])], ("mixed", 1, 4, 4)),
        ([held.RadiusOfGyration([[0, 1, 2], [2, 1, 0]])], ("mixed", 1, 2, 1)),
        ([held.KnifeEdge(0, 1, [0, 0, 1.0])], ("mixed", 1, 1, 1)),
    ],
)
def test_table_for_other_rows(rows, expected) -> None:
    assert lines(planned(rows, ZIGZAG[:5])) == [expected]


@pytest.mark.parametrize(
    ("fixed", "pairs", "expected"),
    [
        ([0], [(0, 1)], ("sparse", 1, 1, 1)),
        ([0], [(0, 1), (0, 2)], ("sparse", 2, 2, 2)),
        ([0, 3], [(0, 1), (1, 2), (2, 3)], ("sparse", 1, 3, 3)),
        ([0, 1], [(0, 2), (1, 2), (0, 1)], ("sparse", 1, 2, 2)),  # the last row lies between fixed atoms
        ([0, 1, 2], [(0, 3), (1, 3), (2, 3), (3, 4)], ("sparse", 1, 4, 4)),
    ],
)
def test_anchored_clusters(fixed, pairs, expected) -> None:
    x = np.vstack([WATER, [[0.2, 0.4, 1.1], [1.0, 1.0, 2.0]]])
    plan = planned([held.FixedAtoms(fixed), held.Distance(pairs)], x)
    assert lines(plan) == [expected]
    assert plan.rank == expected[3] + 3 * len(fixed)
    np.testing.assert_array_equal(plan.pinned, fixed)
    assert (plan.inverse_masses[fixed] == 0).all()
