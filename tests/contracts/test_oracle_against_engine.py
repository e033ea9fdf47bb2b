"""Two implementations of one theory: the dense oracle and the clustered engine must give the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import CASES, MASSES, scattered
from oracle_sets import (
    LITERAL,
    OCTAHEDRON,
    TETRAHEDRON,
    WATER,
    all_pairs,
    close,
    literal_setup,
    same_dynamics,
    same_position_projection,
    same_projections,
    setup,
)

from kcons import constraints as held
from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion


@pytest.mark.parametrize("name", LITERAL)
def test_literal_sets(name: str) -> None:
    s = literal_setup(name)
    same_dynamics(s)
    same_projections(s, np.random.default_rng(2))


@pytest.mark.parametrize("name", LITERAL)
def test_position_projection_of_literal_sets(name: str) -> None:
    for step in (1e-3, 0.03):
        same_position_projection(literal_setup(name), np.random.default_rng(3), step)


@pytest.mark.parametrize("name", [name for name in CASES if not CASES[name]().moving])
def test_every_family(name: str) -> None:
    rng = np.random.default_rng(4)
    x = Motion(ConstraintSet([CASES[name]()], scattered(11), MASSES), scattered(11)).restore_positions(scattered(11))
    s = setup([CASES[name]()], x, MASSES, rng)
    same_dynamics(s)
    same_projections(s, rng)
    if s.constraint_set.holonomic.all():
        same_position_projection(s, rng, 1e-3)


# -- many clusters, periodic cells, rows that move --------------------------------------------------


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


@pytest.mark.parametrize("seed", range(3))
def test_many_molecules(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, x, rank = many_molecules(rng)
    s = setup(rows, x, 10 ** rng.uniform(0, 2, len(x)), rng)
    assert s.rank == rank
    same_dynamics(s)
    same_projections(s, rng)
    same_position_projection(s, rng, 1e-3)
    same_position_projection(s, rng, 0.02)


def test_molecules_wrapped_into_a_triclinic_cell() -> None:
    """Atoms folded into the cell one by one: the same numbers as for whole molecules."""
    rng = np.random.default_rng(3)
    rows, x, _ = many_molecules(rng)
    masses = 10 ** rng.uniform(0, 2, len(x))
    s = setup(rows, x, masses, rng)
    cell = np.array([[9.0, 0, 0], [2.0, 8.5, 0], [-1.5, 1.0, 9.5]])
    shift = np.floor(x @ np.linalg.inv(cell)) @ cell
    motion = Motion(ConstraintSet(rows, x - shift, masses, cell=cell), x - shift)
    root_m = np.sqrt(masses)[:, None]
    a = projection.acceleration(s.A, masses, s.f, s.b)
    size = np.abs(s.f / root_m).max() + np.abs(root_m * a).max()
    close(root_m * motion.acceleration(x - shift, s.v, s.f), root_m * a, size, 1e-11, "acceleration")
    step = 1e-3 * s.v
    expected = Motion(s.constraint_set, x).project_positions(x + step, x)
    found = motion.project_positions(x - shift + step, x - shift)
    np.testing.assert_allclose(found + shift, expected, rtol=0, atol=1e-13)
    # Any atom may be in any image, before the step and after it.
    before, after = (rng.integers(-2, 3, x.shape) @ cell for _ in range(2))
    found = motion.project_positions(x + step + after, x + before)
    np.testing.assert_allclose(found - after, expected, rtol=0, atol=2e-13)


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_rows_that_move_and_velocity_rows(time: float) -> None:
    rng = np.random.default_rng(11)
    x = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (4, 1)), axis=0) + 0.1 * rng.normal(size=(8, 3))
    bonds = [(k, k + 1) for k in range(7)]
    masses = 10 ** rng.uniform(0, 2, 8)

    def moving(start: float, swing: float, omega: float) -> held.MovingTarget:
        return held.MovingTarget(
            lambda t: start + swing * np.sin(omega * t),
            lambda t: swing * omega * np.cos(omega * t),
            lambda t: -swing * omega**2 * np.sin(omega * t),
        )

    length = float(np.linalg.norm(x[bonds[0][0]] - x[bonds[0][1]]))
    rows: list[held.Constraint] = [
        held.Distance(bonds[0], moving(length, 0.2, 1.3)),
        held.Distance(bonds[1:]),
        held.Plane(5, [0.2, 0.3, 1.0], moving(float(x[5] @ [0.2, 0.3, 1.0] / np.sqrt(1.13)), 0.4, 0.8)),
        held.LinearVelocity([1, 3], rng.normal(size=(2, 3)), lambda t: np.cos(2 * t)),
        held.KnifeEdge(6, 7, [0.1, 0.2, 1.0]),
        held.Sphere(2, [9.0, 1.0, 2.0]),
    ]
    constraint_set = ConstraintSet(rows, x, masses)
    motion = Motion(constraint_set, x)
    x = motion.restore_positions(x, time=time)
    assert np.all(np.abs(constraint_set.value(x, time)) <= constraint_set.tolerance(x, time))
    A, c = constraint_set.jacobian(x, time).toarray(), constraint_set.velocity_target(x, time)
    assert np.abs(c).max() > 0.1
    raw = rng.normal(size=x.shape)
    v = projection.project_velocities(A, masses, raw, c)
    close(motion.project_velocities(x, raw, time=time), v, np.abs(v).max(), 1e-13, "velocities")
    f, b = rng.normal(size=x.shape), constraint_set.acceleration_target(x, v, time)
    z = projection.constraint_force(A, masses, f, b)
    close(motion.constraint_force(x, v, f, time), z, np.abs(z).max(), 1e-13, "constraint force")
    a = projection.acceleration(A, masses, f, b)
    close(motion.acceleration(x, v, f, time), a, np.abs(a).max(), 1e-13, "acceleration")
    lam = projection.multipliers(A, masses, f, b)
    close(motion.multipliers(x, v, f, time), lam, np.abs(lam).max(), 1e-13, "multipliers")
    np.testing.assert_allclose(A @ a.ravel(), b, rtol=0, atol=1e-13 * np.abs(b).max())


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


@pytest.mark.parametrize("times", [2, 3, 5])
@pytest.mark.parametrize("masses", [[1.0, 2.0], [1.0, 1.0], [1.7, 23.0]])
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


@pytest.mark.parametrize(
    "name", ["pendulum on a fixed atom", "both ends fixed", "a fixed bond", "water, one bond twice"]
)
def test_one_set_may_serve_several_engines(name: str) -> None:
    s = literal_setup(name)
    before = s.constraint_set.incidence.toarray()
    for _ in range(3):
        same_dynamics(s)
        same_projections(s, np.random.default_rng(9))
    np.testing.assert_array_equal(s.constraint_set.incidence.toarray(), before)
