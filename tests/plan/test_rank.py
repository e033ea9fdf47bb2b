"""Independent rows are counted by their rank, and dependent ones eliminated last."""

from __future__ import annotations

import numpy as np

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.plan import make_plan
from kcons.plan.clusters import Shape
from kcons.plan.rank import ORDERED_IN_ALL, ORDERED_ROWS, rank_of_small, ranked, small_enough


def planned(rows, x, masses=None):
    constraint_set = ConstraintSet(rows, x, np.ones(len(x)) if masses is None else masses)
    return make_plan(constraint_set, np.asarray(x), 0.0)


def lines(plan) -> list[tuple[str, int, int, int]]:
    return [(k.solver, k.clusters, k.rows, k.rank) for k in plan.kinds]


def test_a_bond_to_two_fixed_atoms_in_line_has_rank_one() -> None:
    x = np.array([[-1.0, 0, 0], [0, 0, 0], [1.5, 0, 0]])
    rows = [held.FixedAtoms([0, 2]), held.LinearCombination([1, 0], [[1.0, 0, 0], [-1, 0, 0]])]
    rows.append(held.LinearCombination([1, 2], [[1.0, 0, 0], [-1, 0, 0]]))
    plan = planned(rows, x)
    assert lines(plan) == [("mixed", 1, 2, 1)]


def test_rank_is_that_of_the_dense_matrix() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = 12
        x = rng.normal(size=(n, 3)) * 2
        pairs = [rng.choice(n, 2, replace=False).tolist() for _ in range(int(rng.integers(1, 36)))]
        constraint_set = ConstraintSet(held.Distance(pairs), x, 10 ** rng.uniform(0, 2, n))
        plan = make_plan(constraint_set, x, 0.0)
        A = constraint_set.jacobian(x).toarray()
        assert plan.rank == np.linalg.matrix_rank(A / np.linalg.norm(A, axis=1)[:, None], tol=1e-8)


def test_dependent_rows_are_eliminated_last():
    """15 distances of rank 12: in an unlucky order a vanishing pivot is left at 1e-9, and multipliers of 1e9."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        x = rng.normal(size=(6, 3)) * [1.0, 1.0, 0.4]
        pairs = np.array([[i, j] for i in range(6) for j in range(i + 1, 6)])
        masses = rng.uniform(1.0, 20.0, 6)
        motion = Motion(ConstraintSet(held.Distance(pairs), x, masses), x)
        assert motion.rank == 12
        assert motion.plan.late.sum() == 3
        lam = np.zeros(15)
        start = x + 1e-2 * rng.normal(size=x.shape)
        out = motion.project_positions(start, x, multipliers=lam)
        assert np.abs(lam).max() < 10.0
        # The shift is a combination of the gradients: it moves no centre of mass and turns nothing.
        push = masses[:, None] * (out - start)
        assert np.abs(push.sum(axis=0)).max() < 1e-14 * masses.sum()
        assert np.abs(np.cross(x, push).sum(axis=0)).max() < 1e-13 * masses.sum()


def test_left_over_are_the_rows_that_are_conditioned_worst():
    """A flat square with both diagonals: one row of six is left for the end; a tetrahedron has none."""
    x = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1]], float)
    pairs = [[i + base, j + base] for base in (0, 4) for i in range(4) for j in range(i)]
    rows = ConstraintSet([held.Distance(pairs)], x, np.ones(8))
    late = np.zeros(12, bool)
    assert ranked(rows, [np.arange(6), np.arange(6, 12)], np.ones(8), x, 0.0, late) == 11
    assert late[:6].sum() == 1 and not late[6:].any()


def test_many_small_clusters_are_counted_at_once():
    """Three waters in a row across a cell, and one that is straight: nine rows, of rank eight."""
    water = np.array([[0.0, 0, 0], [0.9, 0.3, 0], [-0.3, 0.9, 0]])
    straight = np.array([[0.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])
    x = np.concatenate([water, water + 3.0, straight + 6.0])
    atoms = np.arange(9).reshape(3, 3)
    shape = Shape("lanes", np.arange(9).reshape(3, 3), 3, False, atoms, np.array([[0, 1], [0, 2], [1, 2]]))
    assert rank_of_small(shape, np.ones(9), x, None) == 8
    wrapped = np.where(np.arange(9)[:, None] % 2, x + np.array([20.0, 0, 0]), x)
    lattice = np.stack([np.eye(3) * 20.0, np.eye(3) / 20.0])
    assert rank_of_small(shape, np.ones(9), wrapped, lattice) == 8


def test_clusters_small_enough_to_look_at_rows_one_by_one():
    assert small_enough([]) and small_enough([np.arange(ORDERED_ROWS)])
    assert not small_enough([np.arange(ORDERED_ROWS + 1)])
    assert not small_enough([np.arange(ORDERED_ROWS)] * (ORDERED_IN_ALL // ORDERED_ROWS + 1))
