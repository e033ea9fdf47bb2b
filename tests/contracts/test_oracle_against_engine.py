"""Two implementations of one theory: the dense oracle and the clustered engine must give the same numbers.

Of random molecules in cells, whose rows move and are held in all families: `test_random_cells`.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion

EPS = float(np.finfo(float).eps)
#: Condition of the row-normalized mass-weighted matrix up to which sets are compared.
WORST_CONDITION = 1e3


class Setup(NamedTuple):
    """A constraint set at a point of its surface, with tangent velocities and forces."""

    constraint_set: ConstraintSet
    x: np.ndarray
    v: np.ndarray
    f: np.ndarray
    A: np.ndarray
    b: np.ndarray
    masses: np.ndarray
    rank: int
    condition: float

    @property
    def tolerance(self) -> float:
        """Relative error allowed: 1e-12, or 50 roundings times the condition of the matrix (at most 1.1e-11)."""
        return max(1e-12, 50 * EPS * self.condition)


def setup(rows: list[held.Constraint], x: np.ndarray, masses: np.ndarray, rng: np.random.Generator) -> Setup:
    """Random admissible velocities and forces; not of sets that are nearly singular."""
    constraint_set = ConstraintSet(rows, x, masses)
    A = constraint_set.jacobian(x).toarray()
    B = A / np.sqrt(np.repeat(masses, 3))
    B /= np.linalg.norm(B, axis=1, keepdims=True)
    singular = np.linalg.svd(B, compute_uv=False)
    kept = singular > 1e-7 * singular[0]
    condition = singular[0] / singular[kept][-1]
    assert condition < WORST_CONDITION and np.all(singular[~kept] < 1e-12 * singular[0]), (condition, singular)
    v = projection.project_velocities(A, masses, rng.normal(size=x.shape), constraint_set.velocity_target(x))
    b = constraint_set.acceleration_target(x, v)
    return Setup(constraint_set, x, v, rng.normal(size=x.shape), A, b, masses, int(kept.sum()), float(condition))


TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


def all_pairs(atoms: int, first: int = 0) -> list[tuple[int, int]]:
    return [(first + i, first + j) for i, j in combinations(range(atoms), 2)]


def literal() -> dict[str, tuple[list[held.Constraint], np.ndarray, int]]:
    """Constraints, positions and the rank they must have."""
    chain = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (6, 1)), axis=0)
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
    }


LITERAL = literal()


def literal_setup(name: str, seed: int = 1) -> Setup:
    rows, x, rank = LITERAL[name]
    rng = np.random.default_rng(seed)
    s = setup(rows, x, 10 ** rng.uniform(0, 2, len(x)), rng)
    assert s.rank == rank
    return s


def close(found: np.ndarray, expected: np.ndarray, size: float, tolerance: float, what: str) -> None:
    error = np.abs(found - expected).max(initial=0.0) / max(size, 1e-300)
    assert error <= tolerance, f"{what}: relative error {error:.2e}, allowed {tolerance:.2e}"


def same_dynamics(s: Setup) -> None:
    """Accelerations times sqrt(m) and forces over sqrt(m): the units in which the matrix has the condition given."""
    motion = Motion(s.constraint_set, s.x)
    assert motion.rank == s.rank
    assert motion.degrees_of_freedom == s.x.size - s.rank
    root_m = np.sqrt(s.masses)[:, None]
    a = projection.acceleration(s.A, s.masses, s.f, s.b)
    z = projection.constraint_force(s.A, s.masses, s.f, s.b)
    size = max(np.abs(z / root_m).max(), np.abs(s.f / root_m).max())
    close(root_m * motion.acceleration(s.x, s.v, s.f), root_m * a, size, s.tolerance, "acceleration")
    close(motion.constraint_force(s.x, s.v, s.f) / root_m, z / root_m, size, s.tolerance, "constraint force")
    lam = motion.multipliers(s.x, s.v, s.f)
    close((s.A.T @ lam).reshape(z.shape) / root_m, z / root_m, size, s.tolerance, "A^T lambda")
    # Fixed atoms have infinite mass in the engine: where rows depend, theirs do not share in the least norm.
    fixed = any(c.fixes_atoms for c in s.constraint_set.constraints)
    if s.rank == len(s.A) or not fixed:
        expected = projection.multipliers(s.A, s.masses, s.f, s.b)
        units = np.linalg.norm(s.A / np.repeat(root_m, 3), axis=1)
        size = max(size, np.abs(expected * units).max())
        # A M^-1 A^T has the square of the condition.
        close(lam * units, expected * units, size, s.tolerance * s.condition, "multipliers")


def same_projections(s: Setup, rng: np.random.Generator) -> None:
    motion = Motion(s.constraint_set, s.x)
    root_m = np.sqrt(s.masses)[:, None]
    raw = rng.normal(size=s.x.shape) / root_m
    expected = projection.project_velocities(s.A, s.masses, raw, s.constraint_set.velocity_target(s.x))
    found = motion.project_velocities(s.x, raw)
    size = max(np.abs(root_m * raw).max(), np.abs(root_m * expected).max())
    close(root_m * found, root_m * expected, size, s.tolerance, "velocities")
    again = motion.project_velocities(s.x, found)
    close(root_m * again, root_m * found, size, s.tolerance, "velocities projected twice")
    z = projection.constraint_force(s.A, s.masses, s.f, np.zeros(len(s.A)))
    close(
        motion.project_forces(s.x, s.f) / root_m,
        (s.f + z) / root_m,
        np.abs(s.f / root_m).max(),
        s.tolerance,
        "forces",
    )


def same_position_projection(s: Setup, rng: np.random.Generator, step: float) -> None:
    """sigma within the set's tolerance, and a correction in the span of M^-1 A(x_ref)^T; velocities take it up."""
    motion = Motion(s.constraint_set, s.x)
    root_m = np.sqrt(np.repeat(s.masses, 3))
    x_new = s.x + step * (s.v + 0.3 * rng.normal(size=s.x.shape))
    kept, velocities = x_new.copy(), s.v.copy()
    x = motion.project_positions(x_new, s.x, velocities=velocities, dt=step)
    np.testing.assert_array_equal(x_new, kept)
    assert np.all(np.abs(s.constraint_set.value(x)) <= s.constraint_set.tolerance(x))
    correction = (x - x_new).ravel()
    V = projection.row_space(s.A / root_m)
    outside = (root_m * correction - V @ (V.T @ (root_m * correction))) / root_m
    close(outside, np.zeros_like(correction), 1.0, 1e-15 * np.abs(x).max() * s.condition, "off the span")
    fixed = [c.atoms.ravel() for c in s.constraint_set.constraints if c.fixes_atoms]
    movable = ~np.isin(np.arange(len(x)), np.concatenate([*fixed, np.zeros(0, int)]))
    size = (np.abs(correction).max() + EPS * np.abs(x).max() / step) / step
    close(velocities[movable], (s.v + (x - x_new) / step)[movable], size, 1e-11, "velocities")


@pytest.mark.parametrize("name", LITERAL)
def test_literal_sets(name: str) -> None:
    s = literal_setup(name)
    same_dynamics(s)
    same_projections(s, np.random.default_rng(2))
    for step in (1e-3, 0.03):
        same_position_projection(s, np.random.default_rng(3), step)


# -- many clusters --------------------------------------------------


def many_molecules(rng: np.random.Generator) -> tuple[list[held.Constraint], np.ndarray, int]:
    """Clusters of every shape, in numbers that fill no vector register evenly; constraints, positions, rank."""
    methane = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
    zigzag = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (20, 1)), axis=0)
    shapes = [
        (11, WATER, all_pairs(3), 3),
        (9, WATER[:2], [(0, 1)], 1),
        (7, WATER, [(0, 1), (0, 2)], 2),
        (5, methane[:4], [(0, 1), (0, 2), (0, 3)], 3),
        (3, methane, [(0, k) for k in range(1, 5)], 4),
        (3, TETRAHEDRON, all_pairs(4), 6),
        (1, OCTAHEDRON, all_pairs(6), 12),
        (1, zigzag, [(k, k + 1) for k in range(39)], 39),
    ]
    places, pairs, rank, first = [], [], 0, 0
    for count, shape, bonds, each in shapes:
        for _ in range(count):
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            places.append(shape @ turn + rng.uniform(-10, 10, 3))
            pairs += [(first + i, first + j) for i, j in bonds]
            first, rank = first + len(shape), rank + each
    places.append(rng.uniform(-10, 10, (6, 3)))  # free atoms
    x = np.vstack(places)
    # Rows and atoms in no order: clusters must be found, not assumed.
    label = rng.permutation(len(x))
    shuffled = np.empty_like(x)
    shuffled[label] = x
    return [held.Distance(label[np.array(pairs)[rng.permutation(len(pairs))]])], shuffled, rank


def test_many_molecules() -> None:
    rng = np.random.default_rng(0)
    rows, x, rank = many_molecules(rng)
    s = setup(rows, x, 10 ** rng.uniform(0, 2, len(x)), rng)
    assert s.rank == rank
    same_dynamics(s)
    same_projections(s, rng)
    same_position_projection(s, rng, 1e-3)
    same_position_projection(s, rng, 0.02)


# -- what the comparison brought to light -----------------------------------------------------------


@pytest.mark.parametrize("name", LITERAL)
def test_what_is_all_normal_projects_to_nothing(name: str) -> None:
    """Nothing is left of velocities M^-1 A^T mu and forces A^T mu, and that is no failure."""
    s = literal_setup(name)
    motion = Motion(s.constraint_set, s.x)
    mu = np.random.default_rng(8).normal(size=len(s.A))
    normal = (s.A.T @ mu).reshape(s.x.shape)
    size = np.abs(normal).max()
    close(motion.project_forces(s.x, normal), np.zeros_like(normal), size, 1e2 * s.tolerance, "forces")
    v = normal / s.masses[:, None]
    close(motion.project_velocities(s.x, v), np.zeros_like(v), np.abs(v).max(), 1e2 * s.tolerance, "velocities")
    close(motion.project_velocities(s.x, 0 * v), np.zeros_like(v), 1.0, 0.0, "velocities of nothing")


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
