"""Constraint sets, literal and random, and what engine and oracle must agree in."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np
from hypothesis import assume

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion

EPS = float(np.finfo(float).eps)
#: Condition of the row-normalised mass-weighted matrix up to which sets are compared.
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


def setup(
    rows: list[held.Constraint], x: np.ndarray, masses: np.ndarray, rng: np.random.Generator, *, strict: bool = False
) -> Setup:
    """Random admissible velocities and forces; sets that are nearly singular are left out."""
    constraint_set = ConstraintSet(rows, x, masses)
    A = constraint_set.jacobian(x).toarray()
    root_m = np.sqrt(np.repeat(masses, 3))
    B = A / root_m
    B /= np.linalg.norm(B, axis=1, keepdims=True)
    singular = np.linalg.svd(B, compute_uv=False)
    kept = singular > 1e-7 * singular[0]
    condition = singular[0] / singular[kept][-1]
    well_posed = condition < WORST_CONDITION and bool(np.all(singular[~kept] < 1e-12 * singular[0]))
    if strict:
        assert well_posed, (condition, singular)
    else:
        assume(well_posed)
    c = constraint_set.velocity_target(x)
    v = projection.project_velocities(A, masses, rng.normal(size=x.shape), c)
    b = constraint_set.acceleration_target(x, v)
    return Setup(constraint_set, x, v, rng.normal(size=x.shape), A, b, masses, int(kept.sum()), float(condition))


# -- random molecules -------------------------------------------------------------------------------


def random_molecule(rng: np.random.Generator, atoms: int, rings: int) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """A random tree of bonds of length 0.9 to 1.6 with no straight angle, and some more bonds that close rings."""
    x = np.zeros((atoms, 3))
    x[0] = rng.normal(size=3)
    neighbours: list[list[int]] = [[] for _ in range(atoms)]
    bonds: list[tuple[int, int]] = []
    for new in range(1, atoms):
        for _ in range(200):
            parent = int(rng.integers(max(0, new - 4), new))
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            place = x[parent] + rng.uniform(0.9, 1.6) * direction
            arms = [(x[k] - x[parent]) / np.linalg.norm(x[k] - x[parent]) for k in neighbours[parent]]
            crowded = np.min(np.linalg.norm(x[:new] - place, axis=1)) < 0.8
            if not crowded and all(abs(arm @ direction) < 0.9 for arm in arms):
                break
        x[new] = place
        bonds.append((parent, new))
        neighbours[parent].append(new)
        neighbours[new].append(parent)
    for _ in range(rings):
        i, j = sorted(rng.choice(atoms, 2, replace=False).tolist())
        if (i, j) not in bonds:
            bonds.append((i, j))
    return x, bonds


def angles_of(bonds: list[tuple[int, int]]) -> list[tuple[int, int, int]]:
    shared = [(set(p), set(q)) for p, q in combinations(bonds, 2)]
    found = []
    for p, q in shared:
        if len(p & q) == 1:
            (vertex,) = p & q
            found.append((*(p - q), vertex, *(q - p)))
    return found


def dihedrals_of(angles: list[tuple[int, int, int]]) -> list[tuple[int, int, int, int]]:
    found = []
    for a, b, c in angles:
        for d, e, g in angles:
            for first, second in (((a, b, c), (d, e, g)), ((a, b, c), (g, e, d))):
                if first[1:] == second[:2] and first[0] != second[2]:
                    found.append((*first, second[2]))
    return found


def some(rng: np.random.Generator, items: list, most: int) -> list:
    """Up to `most` of the items, in random order."""
    count = min(len(items), int(rng.integers(0, most + 1)))
    return [items[k] for k in rng.permutation(len(items))[:count]]


Extra = Callable[[np.random.Generator, np.ndarray], held.Constraint]


def _pick(rng: np.random.Generator, x: np.ndarray, count: int) -> list[int]:
    return rng.choice(len(x), count, replace=False).tolist()


def _direction(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=3)


def _custom(rng: np.random.Generator, x: np.ndarray) -> held.Constraint:
    """Volume of the tetrahedron of four atoms, q = a . (b x c), written by hand."""

    def arms(r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return r[..., 1, :] - r[..., 0, :], r[..., 2, :] - r[..., 0, :], r[..., 3, :] - r[..., 0, :]

    def volume(r: np.ndarray) -> np.ndarray:
        a, b, c = arms(r)
        return np.sum(a * np.cross(b, c), axis=-1)

    def gradient(r: np.ndarray) -> np.ndarray:
        a, b, c = arms(r)
        g = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
        return np.concatenate([-g.sum(axis=-2, keepdims=True), g], axis=-2)

    def hessian_vector(r: np.ndarray, v: np.ndarray) -> np.ndarray:
        a, b, c = arms(r)
        p, q, s = arms(v)
        g = np.stack(
            [np.cross(q, c) + np.cross(b, s), np.cross(s, a) + np.cross(c, p), np.cross(p, b) + np.cross(a, q)],
            axis=-2,
        )
        return np.concatenate([-g.sum(axis=-2, keepdims=True), g], axis=-2)

    return held.Custom(_pick(rng, x, 4), volume, gradient, hessian_vector)


EXTRAS: dict[str, Extra] = {
    "plane": lambda rng, x: held.Plane(_pick(rng, x, 1), _direction(rng)),
    "sphere": lambda rng, x: held.Sphere(_pick(rng, x, 1), 3 * _direction(rng)),
    "cylinder": lambda rng, x: held.Cylinder(_pick(rng, x, 1), 3 * _direction(rng), _direction(rng)),
    "line": lambda rng, x: (lambda k: held.Line(k, x[k[0]], _direction(rng)))(_pick(rng, x, 1)),
    "linear combination": lambda rng, x: held.LinearCombination(_pick(rng, x, 2), rng.normal(size=(2, 3))),
    "wide linear combination": lambda rng, x: held.LinearCombination(_pick(rng, x, 5), rng.normal(size=(5, 3))),
    "centre of mass": lambda rng, x: held.CenterOfMass([_pick(rng, x, 4)]),
    "distance of centres": lambda rng, x: (lambda k: held.CenterDistance(k[:2], k[2:]))(_pick(rng, x, 5)),
    "difference of distances": lambda rng, x: (
        lambda k: held.DistanceDifference([[k[0], k[1]], [k[1], k[2]], [k[3], k[1]]], weights=[1.0, -1.0, 0.4])
    )(_pick(rng, x, 4)),
    "radius of gyration": lambda rng, x: held.RadiusOfGyration(_pick(rng, x, 5)),
    "ellipsoid": lambda rng, x: held.Ellipsoid(
        _pick(rng, x, 1), 3 * _direction(rng), rng.uniform(1, 3, 3), np.linalg.qr(rng.normal(size=(3, 3)))[0], None
    ),
    "torus": lambda rng, x: held.Torus(_pick(rng, x, 1), 2 * _direction(rng), _direction(rng), 2.5),
    "implicit surface": lambda rng, x: held.ImplicitSurface(
        _pick(rng, x, 1),
        lambda r: r[:, 0] * r[:, 1] * r[:, 2] + r[:, 2] ** 2,
        lambda r: np.stack([r[:, 1] * r[:, 2], r[:, 0] * r[:, 2], r[:, 0] * r[:, 1] + 2 * r[:, 2]], axis=1),
        target=None,
    ),
    "custom": _custom,
    "fixed atom": lambda rng, x: held.FixedAtoms(_pick(rng, x, 1)),
}


def random_set(seed: int, atoms: int, rings: int, extras: list[str], duplicates: bool) -> Setup:
    rng = np.random.default_rng(seed)
    x, bonds = random_molecule(rng, atoms, rings)
    masses = 10 ** rng.uniform(0, 3, atoms)
    angles = angles_of(bonds)
    dihedrals = [d for d in dihedrals_of(angles) if len(set(d)) == 4]
    kept = some(rng, bonds, len(bonds)) or bonds
    rows: list[held.Constraint] = [held.Distance(kept)]
    room = 3 * atoms - 6 - len(kept)
    if bent := some(rng, angles, max(0, room // 2)):
        rows.append(held.Angle(bent))
        room -= len(bent)
    if twisted := some(rng, dihedrals, max(0, room // 3)):
        rows.append(held.Dihedral(twisted))
    rows += [EXTRAS[name](rng, x) for name in extras]
    if duplicates:
        rows.append(held.Distance([kept[int(rng.integers(len(kept)))]]))
        if bent:
            i, j, k = bent[0]
            rows.append(held.Angle([k, j, i]))
    rng.shuffle(rows)
    return setup(rows, x, masses, rng)


# -- literal sets -----------------------------------------------------------------------------------

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
BIPYRAMID = np.array([[1.0, 0, 0], [-0.5, 0.8660254, 0], [-0.5, -0.8660254, 0], [0, 0, 1.1], [0, 0, -1.1]])
WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])


def all_pairs(atoms: int, first: int = 0) -> list[tuple[int, int]]:
    return [(first + i, first + j) for i, j in combinations(range(atoms), 2)]


def literal(name: str) -> tuple[list[held.Constraint], np.ndarray, int]:
    """Constraints, positions and the rank they must have."""
    chain = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (6, 1)), axis=0)
    methane = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
    table: dict[str, tuple[list[held.Constraint], np.ndarray, int]] = {
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
    return table[name]


LITERAL = [
    "one bond",
    "one bond twice",
    "one bond three times, in three objects",
    "water",
    "water, one bond twice",
    "water by distances and angle, one too many",
    "three waters",
    "tetrahedron",
    "methane, all ten distances",
    "bipyramid, all ten distances",
    "octahedron, all fifteen distances",
    "braced tetrahedra in a row",
    "zigzag chain",
    "chain with all its angles",
    "ring of six with a chord",
    "star of four",
    "carbon dioxide",
    "pendulum on a fixed atom",
    "both ends fixed",
    "a fixed bond",
]


def literal_setup(name: str, seed: int = 1) -> Setup:
    rows, x, rank = literal(name)
    rng = np.random.default_rng(seed)
    s = setup(rows, x, 10 ** rng.uniform(0, 2, len(x)), rng, strict=True)
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
