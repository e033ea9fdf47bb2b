"""The plan: clusters, shapes, ranks, solvers, blocks, rows between fixed atoms; groups that are flat or straight."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from ase.build import molecule
from ase.collections import g2
from constraint_cases import blade

from kcons import constraints as held
from kcons.ase.topology import bonds_of
from kcons.constraints import Angle, Dihedral, Distance, FixedAtoms, LinearRelation, MovingTarget, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, SingularGeometryError
from kcons.motion import Motion
from kcons.plan import make_plan
from kcons.plan.clusters import LANES_CLUSTERS, Shape, classify, row_blocks
from kcons.plan.second_order import without_second_order_rows
from kcons.solvers.small_clusters import LARGEST
from kcons.topology import bond_angles

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
        ([blade([0, 1])], ("SparseRows", 1, 1, 1)),
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
    assert plan.rank == 7


@pytest.mark.parametrize(
    "row",
    [
        held.Distance([0, 1], 1.1),
        held.VelocityFormula("vx1 + vy2", [0, 1], None, 0.5),
        held.Plane(0, [1.0, 0, 0], 2),
        held.Distance([0, 1], MovingTarget(lambda t: 0.9572 + max(0.0, t - 1) ** 2)),
    ],
)
def test_rows_between_fixed_atoms_that_contradict_are_refused(row) -> None:
    far = np.vstack([np.full((20, 3), 9.0) + np.arange(20)[:, None], WATER])
    shifted = row.renumbered(np.arange(3) + 20)
    with pytest.raises(ContradictionError, match=r"between fixed atoms.*(free|remove)") as caught:
        Motion(ConstraintSet([held.FixedAtoms([20, 21]), shifted], far, np.ones(23)), far)
    assert caught.value.rows == (6,)
    assert set(caught.value.atoms) <= {20, 21} and str(20) in str(caught.value)


def test_rows_between_fixed_atoms_that_move_are_refused() -> None:
    """Also where these go together; a row that moves elsewhere is none of these."""
    rows = [held.FixedAtoms([0, 1], lambda t: WATER[:2] + t), held.Distance([[0, 1], [1, 2]])]
    with pytest.raises(ContradictionError, match=r"#6 Distance\(0, 1\) lies between fixed atoms and moves; remove"):
        planned(rows, WATER)
    x = np.vstack([WATER, WATER + 5.0])
    moving = held.Distance([3, 4], MovingTarget(lambda t: 0.9572 + t))
    assert planned([held.FixedAtoms([0, 1]), held.Distance([[0, 1], [1, 2]]), moving], x).rank == 8


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


# -- groups that are flat or straight: which are converted, left alone, refused -----------------------


def turned(x, seed=3):
    """The same points in a general orientation and place."""
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return np.asarray(x, dtype=float) @ q + rng.standard_normal(3)


def ring(n, radius=1.4):
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)


BENZENE = np.vstack([ring(6, 1.39), ring(6, 2.48)])
FORMATE = np.array([[0.0, 0, 0], [0, 1.1, 0], [1.1, -0.6, 0], [-1.1, -0.6, 0]])
CO2 = np.array([[-1.16, 0.0, 0.0], [0.0, 0.0, 0.0], [1.16, 0.0, 0.0]])
HEXAGON_12 = [p for p in all_pairs(6) if p[1] - p[0] != 3]


def converted(rows, x, **options):
    return without_second_order_rows(ConstraintSet(rows, x, np.ones(len(x)), **options), x, 0.0)


def rank_of(held, x):
    a = held.jacobian(x).toarray()
    return int(np.linalg.matrix_rank(a / np.linalg.norm(a, axis=1, keepdims=True), tol=1e-6))


def counts(held):
    """(distances, rows of linear relations)."""
    of = {"Distance": 0, "LinearRelation": 0}
    for item in held.constraints:
        of[item.family] += item.n_rows
    return of["Distance"], of["LinearRelation"]


CONVERTED = {
    "CO2 by 3": (CO2, all_pairs(3), (1, 3), 5),
    "C3O2 by 10": ([[0, 0, 0], [1.16, 0, 0], [2.45, 0, 0], [3.74, 0, 0], [4.9, 0, 0]], all_pairs(5), (1, 9), 5),
    "two triples of a line": (
        [[0, 0, 0], [1, 0, 0], [2.1, 0, 0], [3.3, 0, 0]],
        [*all_pairs(3), (1, 3), (2, 3)],
        (1, 6),
        5,
    ),
    "square by 6": (ring(4), all_pairs(4), (3, 3), 6),
    "hexagon by 15": (ring(6), all_pairs(6), (3, 9), 6),
    "hexagon by 12": (ring(6), HEXAGON_12, (3, 9), 6),
    "benzene by 66": (BENZENE, all_pairs(12), (3, 27), 6),
    "two squares with a common edge": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]],
        [p for p in all_pairs(6) if set(p) <= {0, 1, 2, 3} or set(p) <= {1, 2, 4, 5}],
        (5, 6),
        7,
    ),
    "hexagon with an atom above three of it": (
        np.vstack([ring(6), [[0.2, 0.1, 1.3]]]),
        [*all_pairs(6), (0, 6), (1, 6), (2, 6)],
        (6, 9),
        6,
    ),
}


ETHYLENE = np.array([[0.0, 0, 0], [1.34, 0, 0], [-0.5, 0.9, 0], [-0.5, -0.9, 0], [1.84, 0.9, 0], [1.84, -0.9, 0]])
ETHYLENE_BONDS = [(0, 1), (0, 2), (0, 3), (1, 4), (1, 5)]
ETHYLENE_ANGLES = [(1, 0, 2), (1, 0, 3), (2, 0, 3), (0, 1, 4), (0, 1, 5), (4, 1, 5)]
BENZENE_BONDS = [(i, (i + 1) % 6) for i in range(6)] + [(i, i + 6) for i in range(6)]
BENZENE_ANGLES = [
    t for i in range(6) for t in (((i - 1) % 6, i, (i + 1) % 6), ((i - 1) % 6, i, i + 6), ((i + 1) % 6, i, i + 6))
]


def check_conversion(rows, x, expected, freedom):
    """Linear rows of full rank, which some way off on their surface hold all that was given."""
    held = converted(rows, x)
    assert counts(held) == expected
    assert rank_of(held, x) == held.n_rows == 3 * len(x) - freedom
    assert np.abs(held.value(x)).max() < 4e-15 * np.abs(x).max()
    given = ConstraintSet(rows, x, np.ones(len(x)))
    motion, rng = Motion(held, x), np.random.default_rng(1)
    for _ in range(5):
        x = motion.project_positions(x + 0.1 * rng.standard_normal(x.shape), x)
    assert np.abs(given.value(x) / given.scale).max() < 1e-14


@pytest.mark.parametrize("case", CONVERTED)
def test_flat_groups_become_linear_rows_of_full_rank(case):
    shape, pairs, expected, freedom = CONVERTED[case]
    check_conversion(Distance(pairs), turned(shape), expected, freedom)


@pytest.mark.parametrize(
    ("x", "bonds", "angles", "expected", "freedom"),
    [
        (BENZENE, BENZENE_BONDS, BENZENE_ANGLES, (3, 27), 6),
        (ETHYLENE, ETHYLENE_BONDS, ETHYLENE_ANGLES, (5, 6), 7),
        (FORMATE, [(0, 1), (0, 2), (0, 3)], [(1, 0, 2), (1, 0, 3), (2, 0, 3)], (3, 3), 6),
    ],
    ids=["benzene", "ethylene", "formate"],
)
def test_planar_groups_held_by_bonds_and_angles_are_converted(x, bonds, angles, expected, freedom):
    """Three angles around a planar center sum to 360 degrees, and less as soon as it leaves the plane."""
    check_conversion([Distance(bonds), Angle(angles)], turned(x), expected, freedom)


LEFT_ALONE = {
    "methane by 10 distances": (METHANE, [Distance(all_pairs(5))], 9),
    "hexagon with an atom above all of it": (np.vstack([ring(6), [[0.2, 0.1, 1.3]]]), [Distance(all_pairs(7))], 15),
    "water by three distances": ([[0, 0, 0], [0.96, 0, 0], [-0.24, 0.93, 0]], [Distance(all_pairs(3))], 3),
    **{
        f"{degrees} degrees by three distances": (
            turned([[1, 0, 0], [0, 0, 0], [np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0]]),
            [Distance(all_pairs(3))],
            3,
        )
        for degrees in (179.0, 179.9, 179.99)
    },
    "planar zigzag by bonds, angles and trans dihedrals": (
        [[0, 0, 0], [1, 0.5, 0], [2, 0, 0], [3, 0.5, 0], [4, 0, 0]],
        [
            Distance([(k, k + 1) for k in range(4)]),
            Angle([(k, k + 1, k + 2) for k in range(3)]),
            Dihedral([(0, 1, 2, 3), (1, 2, 3, 4)]),
        ],
        9,
    ),
    "planar center by bonds and an improper": (
        FORMATE,
        [Distance([(0, 1), (0, 2), (0, 3)]), Dihedral([(1, 0, 2, 3)])],
        4,
    ),
    "CO2 held on its line and by three distances": (
        CO2,
        [Distance(all_pairs(3)), LinearRelation(1, [0, 2], [0.5, 0.5])],
        4,
    ),
    "square in a plane that is held": (
        ring(4),
        [Distance(all_pairs(4)), Plane([0, 1, 2, 3], normal=[0, 0, 1], offset=0.0)],
        9,
    ),
    "atom between two fixed ones": (
        [[0, 0, 0], [1, 0.5, 0], [2, 0, 0]],
        [Distance([(0, 1), (1, 2)]), FixedAtoms([0, 2])],
        8,
    ),
}


@pytest.mark.parametrize("case", LEFT_ALONE)
def test_regular_and_merely_dependent_rows_are_left_alone(case):
    shape, rows, rank = LEFT_ALONE[case]
    x = np.array(shape, dtype=float)
    given = ConstraintSet(rows, x, np.ones(len(x)))
    assert rank_of(given, x) == rank
    assert without_second_order_rows(given, x, 0.0) is given


def test_boat_of_cyclohexane_is_left_alone():
    """Its twelve rows have rank 11 along the whole boat family, 12 beside it: a motion, not a singularity."""
    pairs = [(i, (i + 1) % 6) for i in range(6)] + [(i, (i + 2) % 6) for i in range(6)]
    lengths = np.repeat([1.5, 3.0 * np.sin(np.radians(109.47 / 2))], 6)
    start = ring(6)
    start[:, 2] = [0.6, 0, 0, 0.6, 0, 0]
    held = ConstraintSet(Distance(pairs, lengths), start, np.ones(6))
    boat = start
    for _ in range(30):  # Gauss-Newton to the exact boat; it keeps the symmetry
        boat = boat - (np.linalg.pinv(held.jacobian(boat).toarray(), rcond=1e-6) @ held.value(boat)).reshape(-1, 3)
    assert np.abs(held.value(boat)).max() < 1e-15
    assert rank_of(held, boat) == 11
    assert without_second_order_rows(held, boat, 0.0) is held


# -- refusals ---------------------------------------------------------------------------------------------


def refuse(rows, x):
    given = ConstraintSet(rows, x, np.ones(len(x)))
    before = x.copy()
    with pytest.raises(SingularGeometryError) as caught:
        without_second_order_rows(given, x, 0.0)
    np.testing.assert_array_equal(x, before)
    return caught.value


def test_targets_that_fit_no_flat_geometry_are_refused():
    """With the degrees of freedom, and what to hold instead."""
    error = refuse(Distance(all_pairs(3), [1.16, 2.31, 1.16]), turned(CO2))
    assert str(error).startswith(
        "constraint set singular at this geometry: 7 linearized degrees of freedom but the rigid body has 5"
    )
    assert "hold one distance and x_b = c x_a + (1-c) x_c (LinearRelation) instead" in str(error)
    assert error.rows == (0, 1, 2) and error.atoms == (0, 1, 2)
    assert "targets do not fit a linear group" in str(error)
    for n, linearized in ((4, 7), (6, 9)):
        x = ring(n)
        lengths = ConstraintSet(Distance(all_pairs(n)), x, np.ones(n)).target()
        lengths[3] *= 1 + 1e-4
        error = refuse(Distance(all_pairs(n), lengths), turned(x))
        assert f"{linearized} linearized degrees of freedom but the rigid body has 6" in str(error)
        assert "hold three distances and" in str(error) and "targets do not fit a planar group" in str(error)
    breathing = MovingTarget(lambda t: 1.16 * (1 + 0.01 * np.sin(t)))
    error = refuse([Distance([(0, 1), (1, 2)], breathing), Distance([(0, 2)])], turned(CO2))
    assert "function of time" in str(error)


REFUSED = {
    "four-bar linkage folded onto a line": (
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0]],
        [Distance([(0, 1), (1, 2), (2, 3), (3, 0)])],
    ),
    "chain stretched between two fixed atoms": (
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]],
        [Distance([(0, 1), (1, 2), (2, 3)]), FixedAtoms([0, 3])],
    ),
    "sphere touching a plane": (
        [[0, 0, 1.0]],
        [Sphere([0], center=[0, 0, 0]), Plane([0], normal=[0, 0, 1], offset=1.0)],
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_singular_mechanisms_are_refused(case):
    """Nothing linear holds what these rows hold; they are named, with their degrees of freedom."""
    shape, rows = REFUSED[case]
    error = refuse(rows, np.array(shape, dtype=float))
    assert "linearized degrees of freedom here but" in str(error) and "#0" in str(error)


def test_flat_sheet_of_triangles_too_large_for_dense_algebra_is_refused():
    """1,540 bonds of a flat triangulated sheet: every inner atom could leave the plane at first order."""
    x = np.array([(i + 0.5 * (j % 2), np.sqrt(0.75) * j, 0.0) for i in range(23) for j in range(23)])
    near = [
        (a, b) for a in range(len(x)) for b in range(a + 1, min(len(x), a + 50)) if np.linalg.norm(x[a] - x[b]) < 1.01
    ]
    assert len(near) > 1400
    assert "at positions nearby" in str(refuse(Distance(near), x))


def test_large_regular_network_is_left_alone():
    """A cubic lattice of 1,331 atoms and 3,630 bonds, by the sparse test."""
    n = 11
    index = np.arange(n**3).reshape(n, n, n)
    x = np.stack(np.unravel_index(index.ravel(), (n, n, n)), axis=1).astype(float)
    links = [
        np.stack([np.moveaxis(index, k, 0)[:-1].ravel(), np.moveaxis(index, k, 0)[1:].ravel()], axis=1)
        for k in range(3)
    ]
    x += 0.05 * np.random.default_rng(0).standard_normal(x.shape)
    held = ConstraintSet(Distance(np.concatenate(links)), x, np.ones(len(x)))
    assert without_second_order_rows(held, x, 0.0) is held


def test_many_molecules_are_found_one_by_one():
    """200 waters, 200 CO2 and 20 benzenes in one object: only the flat ones change."""
    rng = np.random.default_rng(9)
    water = np.array([[0, 0, 0], [0.96, 0, 0], [-0.24, 0.93, 0]])
    shapes = [water] * 200 + [CO2] * 200 + [BENZENE] * 20
    starts = np.concatenate([[0], np.cumsum([len(s) for s in shapes])])
    x = np.vstack([turned(s, seed=k) + 20 * rng.standard_normal(3) for k, s in enumerate(shapes)])
    pairs = np.vstack([np.array(all_pairs(len(s))) + o for s, o in zip(shapes, starts, strict=False)])
    held = converted(Distance(pairs), x)
    assert counts(held) == (600 + 200 + 60, 600 + 20 * 27)
    assert np.abs(held.value(x)).max() < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("what", ["bonds and angles", "all distances"])
def test_molecules_of_the_g2_set(what):
    """159 real geometries, flat ones and symmetric ones: none is refused, and what was asked for is held."""
    rng = np.random.default_rng(0)
    converted_sets = 0
    for name in g2.names:
        atoms = molecule(name)
        x, bonds = atoms.positions.copy(), bonds_of(atoms)
        angles = bond_angles(bonds, len(x))
        if len(x) < 3 or not len(bonds):
            continue
        rows = [Distance(all_pairs(len(x)))]
        if what == "bonds and angles":
            if any(abs(atoms.get_angle(*t)) > 179.99 for t in angles) or not len(angles):
                continue
            rows = [Distance(bonds), Angle(angles)]
        given = ConstraintSet(rows, x, atoms.get_masses())
        motion = Motion(given, x)
        converted_sets += motion.constraint_set is not given
        y = x
        for _ in range(5):
            # Acrylonitrile has C-C-N at 179.2 degrees, 0.009 A off the line: steps must stay below that.
            y = motion.project_positions(y + 1e-3 * rng.standard_normal(x.shape), y)
        assert np.max(np.abs(given.value(y)) / given.scale) <= 2e-14, name
        a = motion.acceleration(y, motion.project_velocities(y, rng.standard_normal(x.shape)), np.ones(x.shape))
        assert np.all(np.isfinite(a)), name
    assert converted_sets >= 30


def porphin_like():
    """Four flat five-rings in a flat ring of bridges: all bonds, and all distances of second neighbors."""
    x, pairs = [], set()
    for k in range(4):
        center = 3.1 * np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2), 0])
        first = len(x)
        for t in np.pi + k * np.pi / 2 + 2 * np.pi * np.arange(5) / 5:
            x.append(center + 1.18 * np.array([np.cos(t), np.sin(t), 0]))
        pairs |= {tuple(sorted((first + i, first + (i + 1) % 5))) for i in range(5)}
    for k in range(4):
        here, there = 5 * k + 4, 5 * ((k + 1) % 4) + 1
        middle = 0.5 * (x[here] + x[there])
        x.append(middle * (1 + 0.25 / np.linalg.norm(middle)))
        pairs |= {(here, len(x) - 1), (there, len(x) - 1)}
    bonded = [[j for p in pairs if i in p for j in p if j != i] for i in range(len(x))]
    seconds = {(a, b) for near in bonded for a in near for b in near if a < b}
    return np.array(x), sorted(pairs | seconds)


def test_hinged_plates_that_lock_each_other_are_refused():
    """Each five-ring alone can be held by linear rows; that they cannot fold against each other cannot."""
    x, pairs = porphin_like()
    with pytest.raises(SingularGeometryError, match="27 linearized degrees of freedom here but 8 at positions nearby"):
        Motion(ConstraintSet(Distance(pairs), x, np.ones(len(x))), x)
    # One of the plates is fine.
    ring = [p for p in pairs if max(p) < 5]
    assert Motion(ConstraintSet(Distance(ring), x[:5], np.ones(5)), x[:5]).degrees_of_freedom == 6


# -- what the converted rows do ---------------------------------------------------------------------------


def test_targets_of_base_distances_are_kept_to_the_last_bit():
    lengths = np.array([1.1600000000000001, 2.3299999999999996, 1.17])
    held = converted(Distance(all_pairs(3), lengths), turned([[0, 0, 0], [1.16, 0, 0], [2.33, 0, 0]]))
    assert held.target()[0] == lengths[1]


#: Where the start is, and what the targets are those of.
STARTS = {
    "stretched line": (1.2 * CO2, CO2),
    "bent line": (CO2 + np.array([[0, 0, 0], [0, 0.02, 0], [0, 0, 0]]), CO2),
    "stretched ring": (1.2 * ring(6), ring(6)),
    **{
        f"puckered by {noise}": (ring(6) + noise * np.random.default_rng(4).standard_normal((6, 3)), ring(6))
        for noise in (1e-7, 1e-4, 1e-3)
    },
}


@pytest.mark.parametrize("case", STARTS)
def test_what_is_held_follows_the_targets_and_not_the_start(case):
    shape, proper = STARTS[case]
    x, pairs = turned(shape), all_pairs(len(shape))
    lengths = ConstraintSet(Distance(pairs), proper, np.ones(len(x))).target()
    given = ConstraintSet(Distance(pairs, lengths), x, np.ones(len(x)))
    motion = Motion(given, x)
    restored = motion.restore_positions(x)
    assert motion.rank == motion.constraint_set.n_rows == 3 * len(x) - (5 if len(x) == 3 else 6)
    assert np.max(np.abs(given.value(restored)) / lengths) < 1e-14


def test_many_puckered_rings_are_all_found():
    """More of them than regular blocks are sampled; noise of 1e-3 on planar targets."""
    rng = np.random.default_rng(0)
    flat = np.vstack([turned(ring(4), seed=k) + 20 * rng.standard_normal(3) for k in range(150)])
    pairs = np.vstack([np.array(all_pairs(4)) + 4 * k for k in range(150)])
    lengths = ConstraintSet(Distance(pairs), flat, np.ones(600)).target()
    held = converted(Distance(pairs, lengths), flat + 1e-3 * rng.standard_normal(flat.shape))
    assert counts(held) == (450, 450)


def test_group_across_a_periodic_boundary():
    x = np.mod(ring(6) + np.array([3.0, 0.2, 9.9]), 10.0)
    held = converted(Distance(all_pairs(6)), x, cell=[10.0, 10.0, 10.0])
    assert counts(held) == (3, 9)
    assert np.abs(held.value(x)).max() < 1e-14


def test_fixed_atoms_become_bases():
    x = ring(6)
    held = converted([Distance(all_pairs(6)), FixedAtoms([2])], x)
    assert Motion(held, x).degrees_of_freedom == 3
    relation = held.constraints[-1]
    assert relation.family == "LinearRelation" and (relation.atoms[:, 1:] == 2).any(axis=1).all()
