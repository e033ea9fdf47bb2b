"""Two implementations of one theory: the dense oracle and the clustered engine must give the same numbers.

Of random molecules in cells, whose rows move and are held in all families: `test_random_cells`. Steps of positions:
`test_distance_solvers` and `test_random_cells`.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion

EPS = float(np.finfo(float).eps)

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


def all_pairs(atoms: int, first: int = 0) -> list[tuple[int, int]]:
    return [(first + i, first + j) for i, j in combinations(range(atoms), 2)]


def literal() -> dict[str, tuple[list[held.Constraint], np.ndarray, int]]:
    """Constraints, positions and the rank they must have."""
    chain = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (6, 1)), axis=0)
    label = np.random.default_rng(0).permutation(69)
    pairs = [(n + k, n + k + 1) for n in (0, 12, 24) for k in range(11)]
    pairs += [pair for k in range(11) for pair in all_pairs(3, 36 + 3 * k)]
    return {
        "one bond": ([held.Distance([0, 1])], WATER[:2], 1),
        "water": ([held.Distance(all_pairs(3))], WATER, 3),
        "water, one bond twice": ([held.Distance(all_pairs(3)), held.Distance([1, 0])], WATER, 3),
        "three waters": (
            [held.Distance(all_pairs(3, 3 * k)) for k in range(3)],
            np.vstack([WATER, WATER[:, [2, 0, 1]] + 5, WATER[:, [1, 2, 0]] - 4]),
            9,
        ),
        "octahedron, all fifteen distances": ([held.Distance(all_pairs(6))], OCTAHEDRON, 12),
        "braced tetrahedra in a row": (
            [
                held.Distance(all_pairs(4)),
                held.Distance(all_pairs(4, 4)),
                held.Distance([[0, 4], [1, 4], [0, 5], [2, 5], [3, 7], [1, 6], [2, 7]]),
            ],
            np.vstack([TETRAHEDRON, TETRAHEDRON @ np.diag([1.0, 1.1, 0.9]) + [4.0, 0.3, -0.2]]),
            18,
        ),
        "chain with all its angles": (
            [held.Distance([(k, k + 1) for k in range(11)]), held.Angle([(k, k + 1, k + 2) for k in range(10)])],
            chain,
            21,
        ),
        "ring of six with a chord": (
            [held.Distance([(k, (k + 1) % 6) for k in range(6)] + [(0, 3)])],
            np.array([[np.cos(t), np.sin(t), 0.3 * (-1) ** k] for k, t in enumerate(np.arange(6) * np.pi / 3)]),
            7,
        ),
        "carbon dioxide": (
            [held.Distance([0, 2]), held.LinearRelation(1, [0, 2], [0.5, 0.5])],
            np.array([[-1.16, 0.1, 0.2], [0, 0, 0], [1.16, -0.1, -0.2]]),
            4,
        ),
        "pendulum on a fixed atom": ([held.FixedAtoms([0]), held.Distance([0, 1])], WATER[:2], 4),
        "a fixed bond": ([held.FixedAtoms([0, 1]), held.Distance(all_pairs(3))], WATER, 8),
        "chains and waters in no order": (
            [held.Distance(label[np.random.default_rng(1).permutation(pairs)])],
            np.vstack(
                [chain, chain - 9, chain + 9, *(WATER[:, [k % 3, (k + 1) % 3, (k + 2) % 3]] + k for k in range(11))]
            )[np.argsort(label)],
            66,
        ),
    }


LITERAL = literal()


@pytest.mark.parametrize("name", LITERAL)
def test_engine_and_oracle_agree(name: str) -> None:
    """Accelerations, velocities and forces in units of sqrt(m), in which the matrix has the condition that counts."""
    rows, x, rank = LITERAL[name]
    rng = np.random.default_rng(1)
    masses = 10 ** rng.uniform(0, 2, len(x)) if len(x) < 50 else np.full(len(x), 12.0)  # lanes are for equal molecules
    constraint_set = ConstraintSet(rows, x, masses)
    motion = Motion(constraint_set, x)
    assert motion.rank == rank and motion.degrees_of_freedom == x.size - rank
    A, root = constraint_set.jacobian(x).toarray(), np.sqrt(masses)[:, None]
    B = A / np.repeat(root, 3)
    singular = np.linalg.svd(B / np.linalg.norm(B, axis=1, keepdims=True), compute_uv=False)
    condition = singular[0] / singular[rank - 1]
    assert condition < 1e3 and np.all(singular[rank:] < 1e-12)
    tolerance = max(1e-12, 50 * EPS * condition)

    def close(found: np.ndarray, expected: np.ndarray, size: float, allowed: float = tolerance) -> None:
        assert np.abs(found - expected).max() <= allowed * size

    raw, f, mu = rng.normal(size=x.shape) / root, rng.normal(size=x.shape), rng.normal(size=len(A))
    v = projection.project_velocities(A, masses, raw, constraint_set.velocity_target(x))
    close(root * motion.project_velocities(x, raw), root * v, np.abs(root * raw).max())
    b = constraint_set.acceleration_target(x, v)
    z = projection.constraint_force(A, masses, f, b)
    size = max(np.abs(z / root).max(), np.abs(f / root).max())
    close(root * motion.acceleration(x, v, f), root * projection.acceleration(A, masses, f, b), size)
    close(motion.constraint_force(x, v, f) / root, z / root, size)
    lam = motion.multipliers(x, v, f)
    close((A.T @ lam).reshape(z.shape) / root, z / root, size)
    # Fixed atoms have infinite mass in the engine: where rows depend, theirs do not share in the least norm.
    if rank == len(A) or not any(c.fixes_atoms for c in constraint_set.constraints):
        expected, units = projection.multipliers(A, masses, f, b), np.linalg.norm(B, axis=1)
        # A M^-1 A^T has the square of the condition.
        close(lam * units, expected * units, max(size, np.abs(expected * units).max()), tolerance * condition)
    still = f + projection.constraint_force(A, masses, f, np.zeros(len(A)))
    close(motion.project_forces(x, f) / root, still / root, np.abs(f / root).max())
    # Nothing is left of what is all normal, M^-1 A^T mu and A^T mu, and that is no failure.
    normal = (A.T @ mu).reshape(x.shape)
    size = np.abs(normal).max()
    close(motion.project_forces(x, normal), 0 * x, size, 1e2 * tolerance)
    close(motion.project_velocities(x, normal / root**2), 0 * x, size, 1e2 * tolerance)
    close(motion.project_velocities(x, 0 * x), 0 * x, 0.0)


@pytest.mark.parametrize(("times", "masses"), [(2, [1.0, 2.0]), (3, [1.7, 23.0]), (5, [1.0, 1.0])])
def test_a_bond_given_several_times_is_one_bond(times: int, masses: list[float]) -> None:
    """Along an axis, with masses of few digits: A M^-1 A^T is singular to the last bit."""
    x, f = np.array([[1.0, 0, 0], [0.0, 0, 0]]), np.array([[1.0, 2, 3], [-2.0, 1, 0]])
    v = np.array([[0.0, 1, 0], [0.0, -1, 2]])
    one = Motion(ConstraintSet(held.Distance([0, 1]), x, masses), x)
    many = Motion(ConstraintSet(held.Distance([[0, 1]] * times), x, masses), x)
    assert one.rank == many.rank == 1
    np.testing.assert_allclose(many.acceleration(x, v, f), one.acceleration(x, v, f), rtol=0, atol=1e-14)
    np.testing.assert_allclose(many.constraint_force(x, v, f), one.constraint_force(x, v, f), rtol=0, atol=1e-13)
    lam = one.multipliers(x, v, f)[0] / times
    np.testing.assert_allclose(many.multipliers(x, v, f), lam, rtol=1e-13)
    step = x + 0.05 * v
    np.testing.assert_allclose(many.project_positions(step, x), one.project_positions(step, x), rtol=0, atol=1e-15)


def test_an_atom_without_freedom_does_not_move() -> None:
    x = np.array([[2.5, 0.3, 0.7], [1.0, 1.0, 1.0]])
    rows = [held.Torus(0, [0, 0, 0], [0, 0, 1], 2.0), held.Line(0, x[0], [0.2, 0.1, 1.0])]
    motion = Motion(ConstraintSet(rows, x, [2.0, 3.0]), x)
    assert motion.degrees_of_freedom == 3
    v = motion.project_velocities(x, np.ones((2, 3)))
    np.testing.assert_allclose(v, [[0, 0, 0], [1, 1, 1]], rtol=0, atol=1e-14)
    f = motion.project_forces(x, np.ones((2, 3)))
    np.testing.assert_allclose(f, [[0, 0, 0], [1, 1, 1]], rtol=0, atol=1e-14)
