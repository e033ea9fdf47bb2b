"""Constraint sets, and what engine and oracle must agree in."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

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


# -- literal sets -----------------------------------------------------------------------------------

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
BIPYRAMID = np.array([[1.0, 0, 0], [-0.5, 0.8660254, 0], [-0.5, -0.8660254, 0], [0, 0, 1.1], [0, 0, -1.1]])
WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


def all_pairs(atoms: int, first: int = 0) -> list[tuple[int, int]]:
    return [(first + i, first + j) for i, j in combinations(range(atoms), 2)]


def literal() -> dict[str, tuple[list[held.Constraint], np.ndarray, int]]:
    """Constraints, positions and the rank they must have."""
    chain = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (6, 1)), axis=0)
    methane = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
    return {
        "one bond": ([held.Distance([0, 1])], WATER[:2], 1),
        "one bond twice": ([held.Distance([[0, 1], [1, 0]])], WATER[:2], 1),
        "one bond three times, in three objects": ([held.Distance([0, 1])] * 3, WATER[:2], 1),
        "water": ([held.Distance(all_pairs(3))], WATER, 3),
        "water, one bond twice": ([held.Distance(all_pairs(3)), held.Distance([1, 0])], WATER, 3),
        "water by distances and angle, one too many": (
            [held.Distance(all_pairs(3)), held.Angle([1, 0, 2])],
            WATER,
            3,
        ),
        "three waters": (
            [held.Distance(all_pairs(3, 3 * k)) for k in range(3)],
            np.vstack([WATER, WATER[:, [2, 0, 1]] + 5, WATER[:, [1, 2, 0]] - 4]),
            9,
        ),
        "tetrahedron": ([held.Distance(all_pairs(4))], TETRAHEDRON, 6),
        "methane, all ten distances": ([held.Distance(all_pairs(5))], methane, 9),
        "bipyramid, all ten distances": ([held.Distance(all_pairs(5))], BIPYRAMID, 9),
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
        "zigzag chain": ([held.Distance([(k, k + 1) for k in range(11)])], chain, 11),
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
        "star of four": ([held.Distance([(0, k) for k in range(1, 5)])], methane, 4),
        "carbon dioxide": (
            [held.Distance([0, 2]), held.LinearRelation(1, [0, 2], [0.5, 0.5])],
            np.array([[-1.16, 0.1, 0.2], [0, 0, 0], [1.16, -0.1, -0.2]]),
            4,
        ),
        "pendulum on a fixed atom": ([held.FixedAtoms([0]), held.Distance([0, 1])], WATER[:2], 4),
        "both ends fixed": (
            [held.FixedAtoms([0, 4]), held.Distance([(k, k + 1) for k in range(4)])],
            chain[:5],
            10,
        ),
        "a fixed bond": ([held.FixedAtoms([0, 1]), held.Distance(all_pairs(3))], WATER, 8),
    }


LITERAL = literal()


def literal_setup(name: str, seed: int = 1) -> Setup:
    rows, x, rank = LITERAL[name]
    rng = np.random.default_rng(seed)
    s = setup(rows, x, 10 ** rng.uniform(0, 2, len(x)), rng)
    assert s.rank == rank
    return s


# -- what is compared -------------------------------------------------------------------------------


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
    """sigma within the set's tolerance, and the correction M^-1 A(x_ref)^T Lambda with the Lambda returned."""
    motion = Motion(s.constraint_set, s.x)
    root_m = np.sqrt(np.repeat(s.masses, 3))
    x_new = s.x + step * (s.v + 0.3 * rng.normal(size=s.x.shape))
    kept, velocities, lam = x_new.copy(), s.v.copy(), np.empty(len(s.A))
    x = motion.project_positions(x_new, s.x, velocities=velocities, dt=step, multipliers=lam)
    np.testing.assert_array_equal(x_new, kept)
    sigma = np.abs(s.constraint_set.value(x))
    allowed = s.constraint_set.tolerance(x)
    worst = int(np.argmax(sigma / allowed))
    assert sigma[worst] <= allowed[worst], f"row {s.constraint_set.row_name(worst)}: {sigma[worst]:.2e}"
    correction = (x - x_new).ravel()
    size = np.abs(correction).max() + EPS * np.abs(x).max() / step
    fixed = np.concatenate(
        [c.atoms.ravel() for c in s.constraint_set.constraints if c.fixes_atoms] or [np.zeros(0, int)]
    )
    movable = ~np.isin(np.arange(len(x)), fixed)
    moving = np.repeat(movable, 3)
    V = projection.row_space(s.A / root_m)
    outside = root_m * correction - V @ (V.T @ (root_m * correction))
    close(outside / root_m, np.zeros_like(correction), 1.0, 1e-15 * np.abs(x).max() * s.condition, "off the span")
    from_lam = (s.A.T @ lam / root_m**2)[moving]
    close(from_lam, correction[moving], 1.0, 1e-15 * np.abs(x).max() * s.condition, "M^-1 A^T Lambda")
    # Where atoms are fixed there is no multiplier, and nothing to add.
    close(velocities[movable], (s.v + (x - x_new) / step)[movable], size / step, 1e-11, "velocities")
