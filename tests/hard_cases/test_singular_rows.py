"""Hard cases of the core (docs/hard-cases.md): dependent and singular rows, H01 to H07."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike
from reference import cases
from scipy.integrate import solve_ivp

from hard_cases.core_systems import TRIANGLE, Array, motion_of, pairs_of, refused, rotated, system_of, worst_residual
from kcons.constraints import Angle, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ContradictionError, SingularGeometryError
from kcons.motion import Motion
from kcons.steppers import Rattle, System, run


def spinning(x: Array, omega: ArrayLike, masses: ArrayLike) -> Array:
    """Velocities of a rotation about the centre of mass."""
    m = np.asarray(masses)[:, None]
    return np.cross(omega, x - (m * x).sum(axis=0) / m.sum())


# -- dependent and singular rows ----------------------------------------------------------------------


def test_H01_duplicate_rows() -> None:
    x = np.array([[0.0, 0, 0], [1.2, 0, 0]])
    masses = [1.0, 2.5]
    force = lambda x, t: np.array([[0.3, -0.2, 0.1], [0.1, 0.4, -0.2]]) - 0.5 * x  # noqa: E731
    once = system_of(Distance([0, 1]), x, masses, force)
    twice = system_of(Distance([(0, 1), (1, 0)]), x, masses, force)
    assert twice.motion.rank == 1 and twice.motion.degrees_of_freedom == 5
    v = [[0, 0.5, 0], [0, -0.2, 0.3]]
    f = force(x, 0)
    z = [s.motion.constraint_force(x, np.array(v), f) for s in (once, twice)]
    assert np.abs(z[0] - z[1]).max() <= 1e-12
    a, b = once.initial_state(x, v), twice.initial_state(x, v)
    worst = 0.0
    for _ in range(10_000):
        a, b = Rattle().step(once, a, 0.01), Rattle().step(twice, b, 0.01)
        worst = max(worst, float(np.abs(a.positions - b.positions).max()))
    assert worst <= 1e-12


def test_H02_one_bond_with_two_targets() -> None:
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    with refused(
        ContradictionError, r"constraints #0 and #1 on atoms \(0, 1\) have different targets 1\.0, 1\.001", x
    ) as _:
        ConstraintSet(Distance([(0, 1), (0, 1)], [1.0, 1.001]), x, [1, 1])
    assert issubclass(ContradictionError, ValueError)


OCTAHEDRON = np.vstack([np.eye(3), -np.eye(3)])
BRACED = {
    "tetrahedron": (np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), pairs_of(4), pairs_of(4)),
    "bipyramid": (
        np.array([[1.0, 0, 0], [-0.5, 0.87, 0], [-0.5, -0.87, 0], [0, 0, 1.1], [0, 0, -1.1]]),
        pairs_of(5),
        [p for p in pairs_of(5) if p != (3, 4)],
    ),
    "octahedron": (OCTAHEDRON, pairs_of(6), [p for p in pairs_of(6) if p[1] - p[0] != 3]),
}


def euler(x: Array, masses: Array, omega: Array, time: float) -> Array:
    """Free rotation about a resting centre of mass by Euler's equations, x at `time`."""
    d = x - masses @ x / masses.sum()
    spread = np.einsum("i,ij,ik->jk", masses, d, d)
    inertia = np.trace(spread) * np.eye(3) - spread

    def rate(t: float, y: Array) -> Array:
        turn, w = y[:9].reshape(3, 3), y[9:]
        return np.concatenate([(turn @ _cross_matrix(w)).ravel(), np.linalg.solve(inertia, -np.cross(w, inertia @ w))])

    end = solve_ivp(
        rate, (0, time), np.concatenate([np.eye(3).ravel(), omega]), method="DOP853", rtol=1e-13, atol=1e-14
    )
    return masses @ x / masses.sum() + d @ end.y[:9, -1].reshape(3, 3).T


def _cross_matrix(w: Array) -> Array:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


@pytest.mark.parametrize("body", BRACED)
def test_H03_braced_bodies(body: str) -> None:
    shape, braced, plain = BRACED[body]
    x = rotated(shape)
    masses = np.arange(1.0, len(x) + 1)
    omega = np.array([0.9, -0.5, 0.7])
    dt, steps = 0.005, 1000
    expected = euler(x, masses, omega, dt * steps)
    error = {}
    for name, pairs in (("braced", braced), ("plain", plain)):
        system = system_of(Distance(pairs), x, masses)
        assert system.motion.degrees_of_freedom == 6
        state = system.initial_state(x, spinning(x, omega, masses))
        residual = 0.0
        for _ in range(steps):
            state = Rattle().step(system, state, dt)
            residual = max(residual, worst_residual(system, state))
        assert residual <= 1e-10
        error[name] = np.abs(state.positions - expected).max()
    assert error["plain"] < 1e-3
    assert error["braced"] <= 10 * error["plain"]


@pytest.mark.parametrize(("n", "linearised"), [(4, 7), (6, 9)])
def test_H04_planar_ring_by_all_distances(n: int, linearised: int) -> None:
    angle = 2 * np.pi * np.arange(n) / n
    x = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    masses = np.ones(n)
    held = ConstraintSet(Distance(pairs_of(n)), x, masses)
    with refused(SingularGeometryError, rf"{linearised} linearised degrees of freedom but the rigid body has 6", x):
        Motion(held, x, degenerate="raise")
    # Converted, an out-of-plane force on every second atom bends nothing.
    push = np.zeros((n, 3))
    push[::2, 2] = 1.0
    push[1::2, 2] = -1.0
    push[0, 2] += 0.3
    system = System(Motion(held, x), lambda x, t: push)
    assert system.motion.degrees_of_freedom == 6
    end = run(system, system.initial_state(x), 0.02, 2000)
    assert np.max(np.abs(held.value(end.positions)) / held.scale) <= 1e-14


def test_H05_collinear_triatomic() -> None:
    case = cases.load("A06_linear_triatomic")
    x, v = case.initial.positions, case.initial.velocities
    rows = Distance(TRIANGLE, [1.16, 2.32, 1.16])
    with refused(SingularGeometryError, "7 linearised degrees of freedom but the rigid body has 5", x):
        motion_of(rows, x, case.masses, degenerate="raise")
    still = np.zeros_like(x)
    system = system_of(rows, x, case.masses, lambda x, t: case.force(x, still))
    assert system.motion.degrees_of_freedom == 5
    z = system.motion.constraint_force(x, v, case.force(x, v))
    assert np.abs(z - case.initial.constraint_forces).max() <= 1e-11 * np.abs(z).max()
    for known in case.solution:
        steps = round(known.time / 0.005)
        start = system.initial_state(x, v, project=True)
        coarse = run(system, start, known.time / steps, steps).positions
        fine = run(system, start, known.time / steps / 2, 2 * steps).positions
        assert np.abs((4 * fine - coarse) / 3 - known.positions).max() <= 1e-8


def test_H06_nearly_collinear() -> None:
    bend = np.radians(179.9)
    x = rotated([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
    masses = np.array([16.0, 12.0, 16.0])
    system = system_of(Distance(TRIANGLE), x, masses)
    assert system.motion.constraint_set.n_rows == system.motion.rank == 3
    axis = (x[0] - x[2]) / np.linalg.norm(x[0] - x[2])
    omega = np.cross(axis, [0.3, -0.5, 0.9])
    state = system.initial_state(x, spinning(x, omega, masses))
    energy, worst, residual = system.total_energy(state), 0.0, 0.0
    for _ in range(10_000):
        state = Rattle().step(system, state, 1e-3)
        worst = max(worst, abs(system.total_energy(state) / energy - 1))
        residual = max(residual, worst_residual(system, state))
    assert residual <= 1e-11
    assert worst <= 1e-8


def test_H07_angle_towards_180_degrees() -> None:
    for degrees in (170.0, 179.0, 179.9, 179.9999):
        bend = np.radians(degrees)
        x = np.array([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
        row = ConstraintSet(Angle([0, 1, 2]), x, np.ones(3)).jacobian(x).toarray()
        assert np.linalg.norm(row) == pytest.approx(np.sqrt(4 - 2 * np.cos(bend)), rel=1e-12)
        assert 2.44 < np.linalg.norm(row) < 2.45
    straight = np.array([[1.0, 0, 0], [0, 0, 0], [-1, 0, 0]])
    with refused(SingularGeometryError, "angle constraint singular at 180 deg, use a linear constraint", straight):
        ConstraintSet(Angle([0, 1, 2]), straight, np.ones(3))

    bend = np.radians(179.9)
    x = rotated([[1, 0, 0], [0, 0, 0], [np.cos(bend), np.sin(bend), 0]])
    masses = np.array([16.0, 12.0, 16.0])
    system = system_of([Distance([(0, 1), (1, 2)]), Angle([0, 1, 2])], x, masses)
    axis = (x[0] - x[2]) / np.linalg.norm(x[0] - x[2])
    state = system.initial_state(x, spinning(x, np.cross(axis, [0.03, -0.05, 0.09]), masses))
    energy, worst, opened = system.total_energy(state), 0.0, 0.0
    for _ in range(10_000):
        state = Rattle().step(system, state, 1e-3)
        worst = max(worst, abs(system.total_energy(state) / energy - 1))
        opened = max(opened, abs(np.degrees(system.motion.constraint_set.value(state.positions)[2])))
    assert worst <= 1e-10
    assert opened <= 1e-9
