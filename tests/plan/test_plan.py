"""The plan: clusters, their shapes, ranks and solvers, blocks whose ranks add up, and rows between fixed atoms."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError
from kcons.motion import Motion
from kcons.plan import make_plan
from kcons.plan.clusters import LANES_CLUSTERS, Shape, classify, row_blocks
from kcons.solvers.small_clusters import LARGEST

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
        (WATER, all_pairs(3), 1, ("RigidTriangles", 1, 3, 3)),
        (WATER, all_pairs(3), 50, ("RigidTriangles", 50, 150, 150)),
        (WATER[:2], [(0, 1)], 9, ("SmallClusters", 9, 9, 9)),
        (WATER, [(0, 1), (0, 2)], 9, ("SmallClusters", 9, 18, 18)),
        (METHANE, [(0, k) for k in range(1, 5)], 9, ("SmallClusters", 9, 36, 36)),
        (TETRAHEDRON, all_pairs(4), 9, ("SmallClusters", 9, 54, 54)),
        (ZIGZAG, [(k, k + 1) for k in range(19)], 3, ("Chains", 3, 57, 57)),
        (HEXAGON, [(k, (k + 1) % 6) for k in range(6)], 9, ("SmallClusters", 9, 54, 54)),
        (METHANE, all_pairs(5), 4, ("SparseDistances", 4, 40, 36)),  # rank-deficient
        (OCTAHEDRON, all_pairs(6), 2, ("SparseDistances", 2, 30, 24)),
        (WATER[:2], [(0, 1), (1, 0)], 9, ("SparseDistances", 9, 18, 9)),  # small, and rank-deficient
        (WATER, [*all_pairs(3), (0, 1)], 9, ("SparseDistances", 9, 36, 27)),
    ],
)
def test_table_for_distances(shape, pairs, times, expected) -> None:
    rows, x = many(shape, pairs, times)
    plan = planned(rows, x)
    assert lines(plan) == [expected]
    assert plan.rank == expected[3]
    assert bool(plan.dependent) is (expected[3] < expected[2])
    assert not plan.driven


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([held.Distance([0, 1]), held.Angle([0, 1, 2])], ("SparseRows", 1, 2, 2)),
        ([held.Sphere([0, 1, 2], [9.0, 0, 0])], ("SingleRows", 3, 3, 3)),
        ([held.Distance([0, 1]), held.Plane([0, 1], [0, 0, 1.0])], ("SparseRows", 1, 3, 3)),
        ([held.Angle([[0, 1, 2], [2, 1, 0]])], ("SparseRows", 1, 2, 1)),
        ([held.Distance([0, 1]), held.CenterOfMass([[0, 1, 2, 3, 4]])], ("SparseRows", 1, 4, 4)),
        ([held.RadiusOfGyration([[0, 1, 2], [2, 1, 0]])], ("SparseRows", 1, 2, 1)),
        ([held.KnifeEdge(0, 1, [0, 0, 1.0])], ("SparseRows", 1, 1, 1)),
        ([held.ImplicitSurface([0, 1], lambda r: r[:, 0] - 3.0, target=None)], ("GeneralClusters", 2, 2, 2)),
    ],
)
def test_table_for_other_rows(rows, expected) -> None:
    assert lines(planned(rows, ZIGZAG[:5])) == [expected]


@pytest.mark.parametrize(
    ("fixed", "pairs", "expected"),
    [
        ([0], [(0, 1)], ("SparseDistances", 1, 1, 1)),
        ([0], [(0, 1), (0, 2)], ("SparseDistances", 2, 2, 2)),
        ([0, 3], [(0, 1), (1, 2), (2, 3)], ("SparseDistances", 1, 3, 3)),
        ([0, 1], [(0, 2), (1, 2), (0, 1)], ("SparseDistances", 1, 2, 2)),  # the last row lies between fixed atoms
        ([0, 1, 2], [(0, 3), (1, 3), (2, 3), (3, 4)], ("SparseDistances", 1, 4, 4)),
    ],
)
def test_anchored_clusters(fixed, pairs, expected) -> None:
    x = np.vstack([WATER, [[0.2, 0.4, 1.1], [1.0, 1.0, 2.0]]])
    plan = planned([held.FixedAtoms(fixed), held.Distance(pairs)], x)
    assert lines(plan) == [expected]
    assert plan.rank == expected[3] + 3 * len(fixed)
    np.testing.assert_array_equal(plan.pinned, fixed)
    assert (plan.inverse_masses[fixed] == 0).all()


# -- rows between fixed atoms -----------------------------------------------------------------------


def test_fulfilled_rows_between_fixed_atoms_are_dropped() -> None:
    plan = planned([held.FixedAtoms([0, 1]), held.Distance([[0, 1], [1, 2]])], WATER)
    assert plan.labels.tolist() == [-1] * 7 + [0]
    assert plan.rank == 7 and plan.between_fixed_atoms is None


@pytest.mark.parametrize(
    "row",
    [held.Distance([0, 1], 1.1), held.VelocityFormula("vx1 + vy2", [0, 1], None, 0.5), held.Plane(0, [1.0, 0, 0], 2)],
)
def test_rows_between_fixed_atoms_that_contradict_are_refused(row) -> None:
    far = np.vstack([np.full((20, 3), 9.0) + np.arange(20)[:, None], WATER])
    shifted = row.renumbered(np.arange(3) + 20)
    with pytest.raises(ContradictionError, match=r"between fixed atoms.*(free|remove)") as caught:
        Motion(ConstraintSet([held.FixedAtoms([20, 21]), shifted], far, np.ones(23)), far)
    assert caught.value.rows == (6,)
    assert set(caught.value.atoms) <= {20, 21} and str(20) in str(caught.value)


def test_atoms_fixed_on_a_path_that_breaks_a_row_between_them() -> None:
    """Dropped rows are watched as long as something moves; nothing changes on failure."""
    rows = [
        held.FixedAtoms([0], lambda t: WATER[0]),
        held.FixedAtoms([1], lambda t: WATER[1] + [0, 0, t]),
        held.Distance([[0, 1], [1, 2]]),
    ]
    motion = Motion(ConstraintSet(rows, WATER, np.ones(3)), WATER)
    assert motion.plan.between_fixed_atoms is not None
    motion.project_positions(WATER, WATER, time=0.0)
    x, v = WATER + 0.01, np.zeros((3, 3))
    kept = x.copy()
    with pytest.raises(ContradictionError, match=r"#6 Distance\(0, 1\)"):
        motion.project_positions(x, WATER, time=0.3, out=x, velocities=v, dt=0.1)
    np.testing.assert_array_equal(x, kept)
    assert not v.any()


def test_velocity_row_between_fixed_atoms_that_agrees() -> None:
    moving = held.FixedAtoms([0], held.MovingTarget(lambda t: [t, 0.0, 0.0], lambda t: [1.0, 0, 0], lambda t: 0.0))
    plan = planned([moving, held.VelocityFormula("vx1", 0, None, 1.0)], WATER)
    assert plan.rank == 3
    with pytest.raises(ContradictionError):
        planned([moving, held.VelocityFormula("vx1", 0, None, 1.1)], WATER)


# -- rows that are named twice ----------------------------------------------------------------------


def test_atoms_that_are_fixed_twice_count_once() -> None:
    held_twice = [held.FixedAtoms([0, 1]), held.FixedAtoms([1, 0]), held.Distance([1, 2])]
    motion = Motion(ConstraintSet(held_twice, WATER, np.ones(3)), WATER)
    assert (motion.rank, motion.degrees_of_freedom) == (7, 2)
    f = np.arange(9.0).reshape(3, 3)
    force = motion.constraint_force(WATER, 0 * WATER, f)
    assert force == pytest.approx(motion.acceleration(WATER, 0 * WATER, f) - f, abs=1e-13)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_multipliers_of_dependent_rows_in_very_different_units(unit: float) -> None:
    x, rng = unit * np.array([[0.0, 0, 0], [1.0, 0.2, 0], [0.3, 1.1, 0.4]]), np.random.default_rng(0)
    volume = held.Custom([0, 1], lambda r: float(np.sum((r[0] - r[1]) ** 2) ** 2), length=unit)
    motion = Motion(ConstraintSet([held.Distance([1, 2]), volume, volume, held.Angle([0, 1, 2])], x, np.ones(3)), x)
    f = rng.normal(size=x.shape)
    motion_force = motion.acceleration(x, 0 * x, f) - f
    assert motion.constraint_force(x, 0 * x, f) == pytest.approx(motion_force, abs=1e-9)
    twice = motion.multipliers(x, 0 * x, f)[1:3]
    assert twice[0] == pytest.approx(twice[1], rel=1e-6)


def test_rank_is_that_of_the_dense_matrix() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = 12
        x = rng.normal(size=(n, 3)) * 2
        pairs = [rng.choice(n, 2, replace=False).tolist() for _ in range(int(rng.integers(1, 36)))]
        plan = planned(held.Distance(pairs), x, 10 ** rng.uniform(0, 2, n))
        A = plan.constraint_set.jacobian(x).toarray()
        # Those that are eliminated last depend on the others.
        for rows in (A, A[~plan.eliminate_last]):
            assert plan.rank == np.linalg.matrix_rank(rows / np.linalg.norm(rows, axis=1)[:, None], tol=1e-8)


def test_dependent_rows_are_eliminated_last():
    """15 distances of rank 12: in an unlucky order a vanishing pivot is left at 1e-9, and multipliers of 1e9."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        x = rng.normal(size=(6, 3)) * [1.0, 1.0, 0.4]
        pairs = np.array([[i, j] for i in range(6) for j in range(i + 1, 6)])
        masses = rng.uniform(1.0, 20.0, 6)
        motion = Motion(ConstraintSet(held.Distance(pairs), x, masses), x)
        assert motion.rank == 12
        assert motion.plan.eliminate_last.sum() == 3
        lam = np.zeros(15)
        start = x + 1e-2 * rng.normal(size=x.shape)
        out = motion.project_positions(start, x, multipliers=lam)
        assert np.abs(lam).max() < 10.0
        # The shift is a combination of the gradients: it moves no center of mass and turns nothing.
        push = masses[:, None] * (out - start)
        assert np.abs(push.sum(axis=0)).max() < 1e-14 * masses.sum()
        assert np.abs(np.cross(x, push).sum(axis=0)).max() < 1e-13 * masses.sum()


# -- clusters and blocks ----------------------------------------------------------------------------


def places(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * 3


def shapes_of(rows, x, masses=None) -> list[Shape]:
    plan = planned(rows, x, masses)
    return list(classify(plan.constraint_set, plan.labels, plan.inverse_masses))


@pytest.mark.parametrize("order", list(np.ndindex(2, 2, 2)))
def test_triangles_of_any_orientation_are_water(order: tuple[int, ...]) -> None:
    pairs = [pair[::-1] if turned else pair for pair, turned in zip(all_pairs(3), order, strict=True)]
    (shape,) = shapes_of(*many(WATER, pairs[::-1], 9), np.tile([16.0, 1, 1], 9))
    assert shape.kind == "RigidTriangles" and shape.clusters == 9
    assert shape.atoms.shape == (9, 3) and shape.rows.shape == (9, 3)
    assert (shape.atoms % 3 == 0).any(axis=0).tolist().count(True) == 1  # oxygen in one place throughout


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
    kind = "SmallClusters" if rows <= LARGEST else "Chains"
    assert all(shape.kind == kind and shape.independent for shape in shapes)
    if rows > LARGEST:
        (shape,) = shapes
        assert shape.clusters == 2
        assert shape.starts.tolist() == [0, rows + 1, 2 * rows + 2]
        for k in range(2):
            atoms = shape.atoms[shape.starts[k] : shape.starts[k + 1]]
            walked = pairs[shape.rows[k * rows : (k + 1) * rows]]
            for row, (a, b) in enumerate(pairwise(atoms)):
                assert {a, b} == set(walked[row])


def blocks(rows, n_atoms):
    x = places(n_atoms, 1)
    rows = ConstraintSet(rows, x, np.ones(n_atoms))
    members, starts = row_blocks(rows, lambda item: True)
    return rows, x, sorted(members[a:b].tolist() for a, b in pairwise(starts))


def test_fixed_atoms_and_space_are_one_vertex():
    """A chain between two fixed atoms, or between a sphere and a fixed atom, is closed."""
    chain = held.Distance([[0, 1], [1, 2]])
    assert blocks([chain, held.FixedAtoms([0])], 3)[2] == []
    assert blocks([chain, held.FixedAtoms([0, 2])], 3)[2] == [[0, 1]]
    # Rows 2 to 4 hold the fixed atom.
    assert blocks([chain, held.FixedAtoms([0]), held.Sphere([2], np.zeros(3), None)], 3)[2] == [[0, 1, 5]]


@pytest.mark.parametrize("seed", range(6))
def test_ranks_of_blocks_add_up_to_the_rank_of_all(seed):
    """And no block falls apart: without any one of its atoms, its rows still hang together."""
    rng = np.random.default_rng(seed)
    n = 12
    every = np.array([(i, j) for i in range(n) for j in range(i)])
    pairs = every[rng.choice(len(every), 20, replace=False)]
    rows, x, found = blocks([held.Distance(pairs)], n)
    jacobian = rows.jacobian(x).toarray()
    single = len(pairs) - sum(map(len, found))
    assert np.linalg.matrix_rank(jacobian) == single + sum(np.linalg.matrix_rank(jacobian[rows]) for rows in found)
    for rows in found:
        for atom in np.unique(pairs[rows]):
            left = [set(pair) - {atom} for pair in pairs[rows].tolist()]
            reached = set(left[0])
            for _ in left:
                reached |= set().union(*(pair for pair in left if pair & reached))
            assert reached == set(np.unique(pairs[rows]).tolist()) - {atom}
