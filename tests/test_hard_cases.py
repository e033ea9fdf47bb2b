"""Hard cases of the core, one test a case (docs/hard-cases.md); the numbers are those that must be reached.

Global rule: no NaN is ever returned, and no input array is changed by a call that fails.
"""

from __future__ import annotations

import contextlib
import io
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from reference import cases
from scipy.integrate import solve_ivp

from kcons.constraint_set import ConstraintSet
from kcons.constraints import (
    Angle,
    Constraint,
    Distance,
    FixedAtoms,
    LinearCombination,
    LinearRelation,
    Plane,
)
from kcons.errors import (
    ContradictionError,
    ConvergenceError,
    InfeasibleError,
    InputError,
    KconsError,
    NonFiniteError,
    OverdeterminedError,
    SingularGeometryError,
)
from kcons.motion import Motion
from kcons.steppers import Rattle, State, System, run

Array = NDArray[np.float64]
WATER = np.array([[0.0, 0.0, 0.0], [0.9572, 0.0, 0.0], [-0.23999, 0.92663, 0.0]])
WATER_MASSES = np.array([15.999, 1.008, 1.008])
TRIANGLE = [(0, 1), (0, 2), (1, 2)]


def pairs_of(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


def motion_of(rows: Constraint | list[Constraint], x: ArrayLike, masses: ArrayLike, **options) -> Motion:
    degenerate = options.pop("degenerate", "convert")
    return Motion(ConstraintSet(rows, x, masses, **options), x, degenerate=degenerate)


def system_of(rows: Constraint | list[Constraint], x: ArrayLike, masses: ArrayLike, force=None, **options) -> System:
    potential = options.pop("potential", None)
    return System(motion_of(rows, x, masses, **options), force, potential=potential)


def chain(n: int, angle: float = 110.0, length: float = 1.0) -> Array:
    """Zigzag of n atoms."""
    half = np.radians(angle / 2)
    k = np.arange(n)
    return length * np.stack([k * np.sin(half), (k % 2) * np.cos(half), 0.0 * k], axis=1)


def rotated(x: ArrayLike, seed: int = 0) -> Array:
    return np.asarray(x, dtype=float) @ np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]


def spinning(x: Array, omega: ArrayLike, masses: ArrayLike) -> Array:
    """Velocities of a rotation about the centre of mass."""
    m = np.asarray(masses)[:, None]
    return np.cross(omega, x - (m * x).sum(axis=0) / m.sum())


def pendulum(angle: float) -> tuple[System, State]:
    """Mass 1 on a rod of length 1 about a fixed atom in the origin, gravity 1, at rest at `angle` from below."""
    x = np.array([[0.0, 0.0, 0.0], [np.sin(angle), 0.0, -np.cos(angle)]])
    down = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    system = system_of(
        [FixedAtoms([0]), Distance([0, 1], 1.0)], x, [1.0, 1.0], lambda x, t: down, potential=lambda x, t: x[1, 2]
    )
    return system, system.initial_state(x)


@contextlib.contextmanager
def refused(error: type[BaseException], match: str, *arrays: Array) -> Iterator[None]:
    """The call raises a typed error with this message and leaves the arrays as they were, bit for bit."""
    before = [a.tobytes() for a in arrays]
    with pytest.raises(error, match=match) as caught:
        yield
    assert isinstance(caught.value, KconsError)
    assert [a.tobytes() for a in arrays] == before


def worst_residual(system: System, state: State) -> float:
    held = system.motion.constraint_set
    return float(np.max(np.abs(held.value(state.positions, state.time)) / held.scale))


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


# -- masses, steps, starts ----------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [1.0, 1e4, 1e8, 1e12])
def test_H08_mass_ratios(ratio: float) -> None:
    n = 20
    x = chain(n, angle=156.0)
    masses = np.where(np.arange(n) % 2 == 0, 1.0, ratio)
    held = ConstraintSet(Distance([(k, k + 1) for k in range(n - 1)]), x, masses)
    b = held.jacobian(x).toarray() / np.sqrt(np.repeat(masses, 3))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    assert np.linalg.cond(b @ b.T) <= 22.4
    motion = Motion(held, x)
    rng = np.random.default_rng(0)
    v = motion.project_velocities(x, rng.standard_normal((n, 3)) / np.sqrt(masses)[:, None])
    a = motion.acceleration(x, v, rng.standard_normal((n, 3)))
    rows = held.jacobian(x)
    miss = rows @ a.ravel() - held.acceleration_target(x, v)
    size = np.sqrt(rows.multiply(rows).sum(axis=1))
    assert np.max(np.abs(miss) / size) <= 1e-14 * np.linalg.norm(a)

    # Rounding of the stored positions alone moves the centre by 1e-13 of the largest coordinate (free atoms too).
    x = chain(n, length=0.15)
    x -= x.mean(axis=0)
    system = system_of(Distance([(k, k + 1) for k in range(n - 1)]), x, masses)
    m = masses[:, None]
    v = 0.15 * 0.05 * rng.standard_normal((n, 3)) / np.sqrt(m)
    v -= (m * v).sum(axis=0) / masses.sum()
    state = system.initial_state(x, v, project=True)
    centre = masses @ x / masses.sum()
    end = run(system, state, 0.01, 10_000)
    assert np.abs(masses @ end.positions / masses.sum() - centre).max() <= 1e-12
    momentum = np.sum(m * end.velocities, axis=0)
    assert np.abs(momentum).max() <= 1e-12 * np.abs(m * v).sum()
    assert worst_residual(system, end) <= 1e-14


def free_rotor(offset: float = 0.0) -> tuple[System, State]:
    """Turns with omega = 1 in the xy plane."""
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]]) + offset
    system = system_of(Distance([0, 1], 1.2), x, [1.5, 2.5])
    return system, system.initial_state(x, [[0, 0.75, 0], [0, -0.45, 0]])


@pytest.mark.parametrize("omega_dt", [0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_H09_free_rotor_turns_by_asin(omega_dt: float) -> None:
    system, state = free_rotor()
    turned = 0.0
    for _ in range(50):
        d = state.positions[0] - state.positions[1]
        state = Rattle().step(system, state, omega_dt)
        e = state.positions[0] - state.positions[1]
        turned += np.arctan2(d[0] * e[1] - d[1] * e[0], d @ e)
    assert abs(turned - 50 * np.arcsin(omega_dt)) <= 1e-11


@pytest.mark.parametrize("omega_dt", [1.0 + 1e-9, 1.01, 1.2, 1.5])
def test_H09_step_without_solution(omega_dt: float) -> None:
    system, state = free_rotor()
    state = replace(state, step=6)
    with refused(ConvergenceError, r"step 7.*time step too large", state.positions, state.velocities):
        Rattle().step(system, state, omega_dt)
    with pytest.raises(ConvergenceError) as caught:
        Rattle().step(system, state, omega_dt)
    assert (caught.value.step, caught.value.row, caught.value.atoms) == (7, 0, (0, 1))


def test_H10_start_20_percent_off() -> None:
    """Water with O-H 1 and H-H 1.6, masses 16, 1, 1, stretched about its centre of mass."""
    masses = np.array([16.0, 1.0, 1.0])
    m = masses[:, None]
    proper = rotated([[0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]])
    centre = (m * proper).sum(axis=0) / masses.sum()
    x = centre + 1.2 * (proper - centre)
    rows = Distance(TRIANGLE, [1.0, 1.0, 1.6])
    system = system_of(rows, x, masses)
    v = np.random.default_rng(4).standard_normal((3, 3))
    with refused(InputError, r"off row #\d Distance.*project=True", x, v):
        system.initial_state(x, v)
    state = system.initial_state(x, v, project=True)
    assert worst_residual(system, state) <= 1e-12
    moved = state.positions - x
    assert np.abs((m * moved).sum(axis=0) / masses.sum()).max() <= 1e-14
    assert np.sqrt(np.sum(m * moved**2)) == pytest.approx(0.2771281292, abs=2e-10)
    assert_velocity_projection(system, state.positions, v, state.velocities)


def assert_velocity_projection(system: System, x: Array, v: Array, tangent: Array) -> None:
    """Loss of kinetic energy 1/2 (Jv)^T (J M^-1 J^T)^-1 Jv, P and L kept, tangent to 1e-12."""
    m = system.masses[:, None]
    rows = system.motion.constraint_set.jacobian(x).toarray()
    jv = rows @ v.ravel()
    loss = 0.5 * jv @ np.linalg.pinv(rows / np.repeat(system.masses, 3) @ rows.T, rcond=1e-12) @ jv
    kinetic = system.kinetic_energy
    assert loss > 0.01 * kinetic(v)
    assert kinetic(v) - kinetic(tangent) == pytest.approx(loss, rel=1e-12)
    assert np.abs(rows @ tangent.ravel()).max() <= 1e-12
    assert np.abs(np.sum(m * (tangent - v), axis=0)).max() <= 1e-14 * np.abs(m * v).max()
    assert np.abs(np.sum(np.cross(x, m * (tangent - v)), axis=0)).max() <= 1e-14 * np.abs(m * v).max()


def test_H11_velocities_violating() -> None:
    rng = np.random.default_rng(1)
    x = rotated(chain(6))
    rows = [Distance([(k, k + 1) for k in range(5)]), Angle([(0, 1, 2), (3, 4, 5)])]
    system = system_of(rows, x, rng.uniform(1, 16, 6))
    v = rng.standard_normal((6, 3))
    with refused(InputError, "initial velocities violate the constraints", x, v):
        system.initial_state(x, v)
    state = system.initial_state(x, v, project=True)
    assert_velocity_projection(system, x, v, state.velocities)
    again = system.motion.project_velocities(x, state.velocities)
    assert np.abs(again - state.velocities).max() <= 1e-15 * np.abs(v).max()


@pytest.mark.parametrize("offset", [1e3, 1e6, 1e9])
def test_H12_far_from_the_origin(offset: float) -> None:
    system, state = free_rotor(offset)
    energy = system.total_energy(state)
    for _ in range(1000):
        state = Rattle().step(system, state, 0.01)
    length = np.linalg.norm(state.positions[0] - state.positions[1])
    assert abs(length - 1.2) <= 4 * np.spacing(offset) * 1.2
    assert abs(system.total_energy(state) / energy - 1) <= 1e-10


@pytest.mark.parametrize("offset", [1e6, 1e9])
def test_H12_engine_alone_far_from_the_origin(offset: float) -> None:
    """Convergence knows what double precision can reach; velocities come from the multipliers."""
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]]) + offset
    motion = motion_of(Distance([0, 1]), x, [1.5, 2.5])
    step = np.array([[0.01, 0.03, -0.02], [0.02, -0.03, 0.01]])
    v = np.zeros((2, 3))
    y = motion.project_positions(x + step, x, velocities=v, dt=0.01)
    assert abs(np.linalg.norm(y[0] - y[1]) - np.linalg.norm(x[0] - x[1])) <= 4 * np.spacing(offset) * 1.2
    p = 1.5 * v[0] + 2.5 * v[1]
    assert np.abs(p).max() <= 1e-14 * np.abs(v).max()


TRICLINIC = np.array([[6.0, 0.0, 0.0], [1.5, 5.5, 0.0], [-1.0, 1.2, 6.5]])


def wrapped(x: Array, cell: Array) -> Array:
    """Atoms put into the cell one by one; those inside are not touched."""
    return x - np.floor(x @ np.linalg.inv(cell)) @ cell


@pytest.mark.parametrize("cell", [np.diag([6.0, 5.0, 5.5]), TRICLINIC], ids=["orthorhombic", "triclinic"])
def test_H13_periodic_wrap(cell: Array) -> None:
    rng = np.random.default_rng(2)
    x = np.vstack([rotated(WATER) + np.array([0.1, 0.2, 5.3]), rotated(chain(5), 1) + 3.0])
    masses = np.concatenate([WATER_MASSES, np.full(5, 12.0)])
    rows = [Distance([*TRIANGLE, (3, 4), (4, 5), (5, 6), (6, 7)]), Angle([(3, 4, 5)])]
    free = system_of(rows, x, masses)
    v = free.motion.project_velocities(x, 0.02 * rng.standard_normal((8, 3)) + [0.04, -0.03, 0.05])
    start = wrapped(x, cell)
    boxed = system_of(rows, start, masses, cell=cell)
    a, b = free.initial_state(x, v), boxed.initial_state(start, v)
    crossings, worst = 0, 0.0
    for _ in range(10_000):
        a, b = Rattle().step(free, a, 0.01), Rattle().step(boxed, b, 0.01)
        inside = wrapped(b.positions, cell)
        crossings += int(np.any(inside != b.positions))
        b = replace(b, positions=inside)
    apart = (a.positions - b.positions) @ np.linalg.inv(cell)
    worst = np.abs((apart - np.round(apart)) @ cell).max()
    assert crossings >= 5
    assert worst <= 1e-11
    with refused(InputError, r"#?0.*target 3 is not shorter than half", start):
        ConstraintSet(Distance([0, 1], 3.0), start, masses, cell=cell)


def secular_drift(energies: Array) -> float:
    """Difference of the means over both halves under a smooth window: the oscillation cancels."""
    n = len(energies) // 2
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4
    return float((energies[n : 2 * n] @ window - energies[:n] @ window) / window.sum())


@pytest.mark.slow
def test_H14_long_run() -> None:
    """1e5 steps; residual from the first to the last step, energy without slope."""
    system, state = pendulum(2.0)
    energies = np.empty(100_000)
    residual = 0.0
    for k in range(len(energies)):
        state = Rattle().step(system, state, 0.01)
        energies[k] = system.total_energy(state)
        residual = max(residual, abs(np.linalg.norm(state.positions[1]) - 1.0))
    assert residual <= 1e-14
    assert abs(secular_drift(energies)) / 500.0 <= 4e-10
    assert np.std(energies) == pytest.approx(2.1e-5, rel=0.1)


@pytest.mark.validation
def test_H14_1e7_steps() -> None:
    system, state = pendulum(2.0)
    blocks = np.empty(1000)
    residual = 0.0
    for k in range(len(blocks)):
        total = 0.0
        for _ in range(10_000):
            state = Rattle().step(system, state, 0.01)
            total += system.total_energy(state)
        blocks[k] = total / 10_000
        residual = max(residual, abs(np.linalg.norm(state.positions[1]) - 1.0))
    assert residual <= 1e-14
    assert 2 * abs(secular_drift(blocks)) <= 1e-6


@pytest.mark.parametrize("shape", ["random", "straight"])
def test_H16_chain_of_1e5_bonds(shape: str) -> None:
    n = 100_001
    rng = np.random.default_rng(0)
    if shape == "straight":
        x = np.zeros((n, 3))
        x[:, 0] = np.arange(n)
    else:
        d = rng.standard_normal((n, 3))
        x = np.cumsum(d / np.linalg.norm(d, axis=1, keepdims=True), axis=0)
    pairs = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    x -= x[n // 2]
    tracemalloc.start()
    motion = motion_of(Distance(pairs, 1.0), x, np.ones(n))
    assert motion.rank == n - 1
    y = motion.project_positions(x + 0.02 * rng.standard_normal((n, 3)), x)
    v = motion.project_velocities(x, rng.standard_normal((n, 3)))
    f = rng.standard_normal((n, 3))
    a = motion.acceleration(x, v, f)
    z = motion.constraint_force(x, v, f)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3e8
    held = motion.constraint_set
    # The ends lie at 5e4: stored positions are good for 7e-12, and nothing else may be lost.
    assert np.all(np.abs(held.value(y)) <= held.tolerance(y))
    rows = held.jacobian(x)
    assert np.abs(rows @ v.ravel()).max() <= 1e-12
    assert np.abs(rows @ a.ravel() - held.acceleration_target(x, v)).max() <= 1e-12 * np.abs(a).max()
    assert np.abs(z.sum(axis=0)).max() <= 1e-12 * np.abs(z).sum()


# -- bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_H17_bad_mass(mass: float) -> None:
    x = chain(5)
    masses = np.array([1.0, 1, 1, mass, 1])
    with refused(InputError, rf"atom 3 has mass {mass:g}; constrained atoms need positive mass", x, masses):
        ConstraintSet(Distance([(2, 3)]), x, masses)
    assert Motion(ConstraintSet([FixedAtoms([3]), Distance([2, 4])], x, [1, 1, 1, 0.0, 1]), x).rank == 4


def test_H18_coincident_atoms() -> None:
    x = np.zeros((2, 3))
    with refused(SingularGeometryError, "atoms 0 and 1 coincide: distance gradient undefined", x):
        ConstraintSet(Distance([0, 1], 1.0), x, [1, 1])
    apart = np.array([[0.0, 0, 0], [1, 0, 0]])
    motion = motion_of(Distance([0, 1]), apart, [1, 1])
    v = np.ones((2, 3))
    for call in (
        lambda: motion.project_positions(apart.copy(), x),
        lambda: motion.project_velocities(x, v),
        lambda: motion.acceleration(x, v, v),
        lambda: motion.project_forces(x, v),
    ):
        with refused(SingularGeometryError, "atoms 0 and 1 coincide: distance gradient undefined", x, v):
            call()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_H19_not_finite(bad: float) -> None:
    x = chain(4)
    rows = Distance([(0, 1), (1, 2), (2, 3)])
    spoiled = x.copy()
    spoiled[2, 1] = bad
    good = np.zeros((4, 3))
    with refused(InputError, "position of atom 2 is not finite", spoiled):
        ConstraintSet(rows, spoiled, np.ones(4))
    with refused(InputError, "target"):
        Distance([0, 1], bad)
    with refused(InputError, "cell"):
        ConstraintSet(rows, x, np.ones(4), cell=[10.0, bad, 10.0])
    motion = motion_of(rows, x, np.ones(4))
    with refused(InputError, "atom 2", spoiled, x, good):
        motion.project_positions(spoiled, x, velocities=good, dt=0.1, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_positions(x, spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_velocities(x, spoiled, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.project_velocities(spoiled, good)
    with refused(InputError, "atom 2", spoiled):
        motion.acceleration(x, good, spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.acceleration(x, spoiled, good)
    with refused(InputError, "atom 2", spoiled):
        motion.project_forces(x, spoiled, out=spoiled)
    with refused(InputError, "atom 2", spoiled):
        motion.restore_positions(spoiled)

    def force(x: Array, t: float) -> Array:
        f = -x
        if t > 0.95:
            f[1, 0] = bad
        return f

    system = System(motion, force)
    with refused(InputError, "atom 2", spoiled):
        system.initial_state(spoiled)
    with refused(InputError, "atom 2", spoiled):
        system.initial_state(x, spoiled)
    last: list[State] = []
    with refused(NonFiniteError, "non-finite force at step 10", x) as _, np.errstate(all="raise"):
        run(system, system.initial_state(x), 0.1, 20, observers=[last.append])
    assert last[-1].step == 9 and np.isfinite(last[-1].positions).all() and np.isfinite(last[-1].velocities).all()


def test_H20_no_degree_of_freedom_left() -> None:
    """Four atoms in a plane, twelve rows: fine at rest, refused as soon as something moves."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.2, 1, 0], [0, 1.1, 0]])
    in_plane = [LinearCombination([a], [axis], None) for a in range(4) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    rows = [Plane([0, 1, 2, 3], normal=[0, 0, 1], offset=0.0), *in_plane]
    system = system_of(rows, x, np.ones(4), lambda x, t: np.ones((4, 3)))
    assert system.motion.rank == 12 and system.motion.degrees_of_freedom == 0
    v = 0.1 * np.ones((4, 3))
    for project in (False, True):
        with refused(OverdeterminedError, "rank 12 leaves no degree of freedom", x, v):
            system.initial_state(x, v, project=project)
    end = run(system, system.initial_state(x), 0.1, 10)
    assert np.abs(end.positions - x).max() <= 1e-15
    assert issubclass(OverdeterminedError, ValueError)


def test_H20_braced_atoms_and_more_rows_than_coordinates() -> None:
    """Fourteen consistent rows on twelve coordinates: rank 12, no freedom, no exception at rest."""
    x = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.3]])
    motion = motion_of(
        [
            Distance(pairs_of(4)),
            Plane([0, 1, 2, 3], normal=[0, 0, 1]),
            LinearCombination([[0], [1], [2], [3]], [[[0, 1.0, 0]], [[1.0, 0, 0]], [[1.0, 0, 0]], [[0.5, 1.0, 0]]]),
        ],
        x,
        np.ones(4),
    )
    assert motion.constraint_set.n_rows == 14
    assert motion.rank == 12 and motion.degrees_of_freedom == 0
    assert np.abs(motion.project_velocities(x, np.ones((4, 3)))).max() <= 1e-12


def test_H21_triangle_inequality_violated() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.9, 0]])
    with refused(InfeasibleError, r"infeasible: residual cannot go below 0\.333333.*sum of squares", x):
        ConstraintSet(Distance(TRIANGLE, [1.0, 1.0, 3.0]), x, np.ones(3))
    assert issubclass(InfeasibleError, RuntimeError)


def test_H21_polygon_that_cannot_close() -> None:
    """Sides 1, 1, 1, 4: each takes a quarter of the excess, sum of squares 4 (1/4)^2."""
    x = np.array([[0.0, 0, 0], [1, 0.2, 0], [2, -0.1, 0.3], [3, 0, 0]])
    motion = motion_of(Distance([(0, 1), (1, 2), (2, 3), (3, 0)], [1.0, 1.0, 1.0, 4.0]), x, np.ones(4))
    with refused(InfeasibleError, r"infeasible: residual cannot go below 0\.25", x):
        motion.restore_positions(x, out=x)
    with pytest.raises(InfeasibleError) as caught:
        motion.restore_positions(x)
    assert caught.value.iterations <= 200


# -- forces, hosts' habits ----------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e6, 1e9, 1e12])
def test_H25_huge_force_along_a_bond(size: float) -> None:
    masses = np.array([1.5, 2.5])
    x = rotated([[0.75, 0, 0], [-0.45, 0, 0]])

    def along(x: Array) -> Array:
        return (x[0] - x[1]) / np.linalg.norm(x[0] - x[1])

    u = along(x)
    pull = np.stack([size * u, -size * u])
    system = system_of(Distance([0, 1]), x, masses, lambda x, t: np.stack([size * along(x), -size * along(x)]))
    side = np.cross(u, [0.3, 0.5, -0.7])
    v = np.stack([masses[1] * side, -masses[0] * side]) / masses.sum()
    a = system.motion.acceleration(x, v, pull)
    centripetal = -np.dot(side, side) / 1.2
    assert abs(u @ (a[0] - a[1]) - centripetal) <= 1e-15 * size / masses.min() + 1e-14
    state = system.initial_state(x, v)
    for _ in range(3):
        state = Rattle().step(system, state, 1e-3)
        assert worst_residual(system, state) <= 1e-10


@pytest.mark.parametrize(("name", "constant"), [("10deg", 0.00403), ("90deg", 0.0338), ("150deg", 0.0024)])
def test_H26_fixed_atom_and_bond_are_a_pendulum(name: str, constant: float) -> None:
    known = cases.load(f"A03_planar_pendulum_{name}").solution[0]
    system, state = pendulum(np.radians(float(name.removesuffix("deg"))))
    assert system.motion.rank == 4 and system.motion.degrees_of_freedom == 2
    steps = round(known.time / 0.002)
    dt = known.time / steps
    state = run(system, state, dt, steps)
    assert np.abs(state.positions[1] - known.positions[0]).max() <= 10 * constant * dt**2
    assert np.array_equal(state.positions[0], np.zeros(3))


def test_H26_bond_between_fixed_atoms() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.5, 0.9, 0]])
    motion = motion_of([FixedAtoms([0, 1]), Distance([(0, 1), (1, 2)])], x, np.ones(3))
    assert motion.rank == 7 and motion.degrees_of_freedom == 2
    with refused(ContradictionError, r"#6 Distance\(0, 1\) lies between fixed atoms and is off", x):
        motion_of([FixedAtoms([0, 1]), Distance([(0, 1), (1, 2)], [1.01, 1.03])], x, np.ones(3))


def test_H27_float32_input() -> None:
    rng = np.random.default_rng(5)
    x32 = rotated(WATER).astype(np.float32)
    v32 = rng.standard_normal((3, 3)).astype(np.float32)
    m32 = WATER_MASSES.astype(np.float32)
    f32 = rng.standard_normal((3, 3)).astype(np.float32)
    results = []
    for kind in (np.float32, np.float64):
        x, v, m, f = (a.astype(kind) for a in (x32, v32, m32, f32))
        motion = motion_of(Distance(TRIANGLE), x, m)
        system = System(motion, lambda x, t, f=f: f)
        end = run(system, system.initial_state(x, v, project=True), 0.01, 100)
        results.append(
            [
                motion.project_positions(x + kind(0.01) * v, x),
                motion.project_velocities(x, v),
                motion.acceleration(x, motion.project_velocities(x, v), f),
                motion.constraint_force(x, motion.project_velocities(x, v), f),
                motion.project_forces(x, f),
                end.positions,
                end.velocities,
            ]
        )
    for a, b in zip(*results, strict=True):
        assert a.dtype == b.dtype == np.float64
    # x + 0.01 v is itself float32 arithmetic of this test: compare from the second on.
    for a, b in zip(results[0][1:], results[1][1:], strict=True):
        assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max()


@pytest.mark.parametrize("atoms", [0, 1, 5])
@pytest.mark.parametrize("rows", [[], [Distance(np.zeros((0, 2), int))]], ids=["no objects", "an empty object"])
def test_H28_no_constraints(atoms: int, rows: list[Constraint]) -> None:
    rng = np.random.default_rng(3)
    x, v, masses = rng.standard_normal((atoms, 3)), rng.standard_normal((atoms, 3)), rng.uniform(1, 2, atoms)
    system = system_of(rows, x, masses, lambda x, t: -x)
    motion = system.motion
    assert motion.rank == 0 and motion.degrees_of_freedom == 3 * atoms
    assert np.array_equal(motion.project_positions(x, x), x)
    assert np.array_equal(motion.project_velocities(x, v), v)
    assert np.array_equal(motion.project_forces(x, v), v)
    assert np.array_equal(motion.constraint_force(x, v, x), np.zeros_like(x))
    assert motion.multipliers(x, v, x).shape == (0,)
    assert "rows 0" in str(motion.report(x, v))
    state = run(system, system.initial_state(x, v), 0.02, 1000)
    y, w, m = x.copy(), v.copy(), masses[:, None]
    for _ in range(1000):
        w = w + 0.01 * -y / m
        y = y + 0.02 * w
        w = w + 0.01 * -y / m
    scale = max(1.0, np.abs(y).max(initial=0.0))
    assert np.abs(state.positions - y).max(initial=0.0) <= 1e-14 * scale * 1
    assert np.abs(state.velocities - w).max(initial=0.0) <= 1e-14 * scale * 1


def test_H29_bad_indices() -> None:
    x = chain(4)
    masses = np.ones(4)
    with refused(InputError, r"row 1 names an atom twice: \(2, 2\)"):
        Distance([(0, 1), (2, 2)])
    with refused(InputError, "row 0 has the negative atom index -1"):
        Distance([(0, -1)])
    with refused(InputError, r"row 1, Distance\(2, 7\): there is no atom 7; the system has atoms 0 to 3", x):
        ConstraintSet(Distance([(0, 1), (2, 7)]), x, masses)
    for target in (0.0, -1.0):
        with refused(InputError, r"row 1, Distance\(1, 2\): target -?\d is not positive", x):
            ConstraintSet(Distance([(0, 1), (1, 2)], [1.0, target]), x, masses)
    with refused(InputError, "integers"):
        Distance([(0.0, 1.5)])
    for shape in ((4,), (4, 2), (3, 3)):
        with refused(InputError, "shape"):
            motion_of(Distance([(0, 1)]), x, masses).project_positions(np.zeros(shape), x)
    with refused(InputError, "positions must have shape"):
        ConstraintSet(Distance([(0, 1)]), x.ravel(), masses)
    with refused(InputError, "masses must have shape"):
        ConstraintSet(Distance([(0, 1)]), x, np.ones(3))


# -- symmetries ---------------------------------------------------------------------------------------


def test_H30_time_reversal() -> None:
    x = np.array([[0.0, 0.0, 0.0], [np.sin(1.2), 0.0, -np.cos(1.2)]])
    down = np.array([[0, 0, 0], [0, 0, -1.0]])
    system = system_of([FixedAtoms([0]), Distance([0, 1], 1.0)], x, [1, 1], lambda x, t: down)
    start = system.initial_state(x, [[0, 0, 0], [0, 0.8, 0]])
    end = run(system, start, 0.01, 10_000)
    back = run(system, end.reversed(), 0.01, 10_000)
    assert np.abs(end.positions - start.positions).max() > 0.1
    assert np.abs(back.positions - start.positions).max() <= 1e-10
    assert np.abs(back.velocities + start.velocities).max() <= 1e-10


def springs(links: Array, lengths: Array, k: float = 0.5):
    """Harmonic forces between atoms, the same in every frame."""
    i, j = links.T

    def force(x: Array, t: float) -> Array:
        d = x[i] - x[j]
        r = np.linalg.norm(d, axis=1)
        pull = (k * (lengths - r) / r)[:, None] * d
        f = np.zeros_like(x)
        np.add.at(f, i, pull)
        np.add.at(f, j, -pull)
        return f

    return force


def test_H31_order_and_orientation() -> None:
    rng = np.random.default_rng(8)
    x = np.vstack([rotated(WATER), rotated(chain(6), 1) + np.array([2.5, 1.0, 0.0])])
    masses = np.concatenate([WATER_MASSES, rng.uniform(1, 16, 6)])
    pairs = np.array([*TRIANGLE, *[(k, k + 1) for k in range(3, 8)]])
    angles = np.array([(3, 4, 5), (5, 6, 7)])
    links = np.array([(0, 4), (1, 6), (2, 8), (3, 7)])
    lengths = 0.9 * np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1)
    system = system_of([Distance(pairs), Angle(angles)], x, masses, springs(links, lengths))
    v = system.motion.project_velocities(x, 0.1 * rng.standard_normal((9, 3)))
    end = run(system, system.initial_state(x, v), 0.01, 1000).positions
    assert np.abs(end - x).max() > 0.3

    order = rng.permutation(9)  # new atom k is old atom order[k]
    new = np.argsort(order)
    flipped = new[pairs[rng.permutation(len(pairs))]][:, ::-1]
    rows = [Angle(new[angles[::-1]]), Distance(flipped[:4]), Distance(flipped[4:])]
    other = system_of(rows, x[order], masses[order], springs(new[links], lengths))
    permuted = run(other, other.initial_state(x[order], v[order]), 0.01, 1000).positions
    assert np.abs(permuted[new] - end).max() <= 1e-11

    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    shift = np.array([3.0, -2.0, 1.0])
    moved = x @ turn + shift
    other = system_of([Distance(pairs), Angle(angles)], moved, masses, springs(links, lengths))
    turned = run(other, other.initial_state(moved, v @ turn), 0.01, 1000).positions
    assert np.abs((turned - shift) @ turn.T - end).max() <= 1e-11


def test_H32_restart_is_bit_identical() -> None:
    x = rotated(chain(8))
    masses = np.linspace(1, 12, 8)
    rows = [Distance([(k, k + 1) for k in range(7)], 1.0), Angle([(0, 1, 2), (4, 5, 6)], np.radians(110.0))]
    force = lambda x, t: -0.3 * x + np.sin(t)  # noqa: E731

    def fresh(x: Array) -> System:
        return system_of(rows, x, masses, force)

    system = fresh(x)
    start = system.initial_state(x, 0.1 * np.random.default_rng(0).standard_normal((8, 3)), project=True)
    whole = run(system, start, 0.01, 1000)
    half = run(system, start, 0.01, 500)
    file = io.BytesIO()
    half.save(file)
    file.seek(0)
    state = State.load(file)
    assert state.step == 500
    resumed = run(fresh(state.positions), state, 0.01, 500)
    assert resumed.positions.tobytes() == whole.positions.tobytes()
    assert resumed.velocities.tobytes() == whole.velocities.tobytes()


def stiff_and_rigid() -> tuple[System, State, float]:
    """A rigid bond next to a spring with k = 1e6; also the largest frequency on the surface."""
    k = 1e6
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.4, 0.9, 0]])
    masses = np.array([3.0, 1.0, 2.0])
    rest = np.linalg.norm(x[2] - x[1])
    system = system_of(
        Distance([0, 1]),
        x,
        masses,
        springs(np.array([(1, 2)]), np.array([rest]), k),
        potential=lambda x, t: 0.5 * k * (np.linalg.norm(x[2] - x[1]) - rest) ** 2,
    )
    u = np.zeros((3, 3))
    u[2] = (x[2] - x[1]) / rest
    u[1] = -u[2]
    # omega^2 = k u . M_par^+ u; the bonds may straighten, where less of the spring is held back.
    along = np.zeros((3, 3))
    along[1, 0], along[2, 0] = -1.0, 1.0
    free = max(float(np.sum(d * system.motion.acceleration(x, 0 * x, d))) for d in (u, along))
    free = max(free, 1 / masses[1] + 1 / masses[2])
    return (
        system,
        system.initial_state(x, [[0, 0.4, 0.1], [0, -0.3, 0.2], [0, 0.5, -0.4]], project=True),
        np.sqrt(k * free),
    )


def test_H41_stiff_next_to_rigid() -> None:
    system, state, omega = stiff_and_rigid()
    energy, worst = system.total_energy(state), 0.0
    dt = 0.5 * 2 / omega
    for _ in range(10_000):
        state = Rattle().step(system, state, dt)
        worst = max(worst, abs(system.total_energy(state) - energy))
    assert worst <= 0.5 * energy
    assert worst_residual(system, state) <= 1e-14
    # Above the limit it fails, and says so.
    system, state, omega = stiff_and_rigid()
    with refused(KconsError, "step", state.positions, state.velocities):
        run(system, state, 1.6 * 2 / omega, 20_000)


def test_H42_zero_and_negative_steps() -> None:
    x = rotated(chain(6))
    rows = [Distance([(k, k + 1) for k in range(5)]), Angle([(0, 1, 2)])]
    system = system_of(rows, x, np.linspace(1, 6, 6), lambda x, t: -0.5 * x)
    start = system.initial_state(x, 0.3 * np.random.default_rng(2).standard_normal((6, 3)), project=True)
    still = Rattle().step(system, start, 0.0)
    assert still.positions.tobytes() == start.positions.tobytes()
    assert still.velocities.tobytes() == start.velocities.tobytes()
    for dt in (0.001, 0.01, 0.05):
        back = Rattle().step(system, Rattle().step(system, start, dt), -dt)
        assert np.abs(back.positions - start.positions).max() <= 1e-12
        assert np.abs(back.velocities - start.velocities).max() <= 1e-12
    state = start
    changes = (0.01, 0.02, -0.005, 0.03)
    for dt in changes:
        state = Rattle().step(system, state, dt)
    for dt in reversed(changes):
        state = Rattle().step(system, state, -dt)
    assert np.abs(state.positions - start.positions).max() <= 1e-12


# -- the global rule ----------------------------------------------------------------------------------

BATHS: dict[str, tuple[Array, list[Constraint]]] = {
    "one bond": (np.array([[0.0, 0, 0], [1, 0, 0]]), [Distance([0, 1])]),
    "waters": (
        np.vstack([WATER + 4.0 * k for k in range(5)]),
        [Distance([(3 * k + i, 3 * k + j) for k in range(5) for i, j in TRIANGLE])],
    ),
    "CH2 groups": (
        np.vstack([np.array([[0.0, 0, 0], [1, 0.2, 0], [-0.3, 1, 0]]) + 4.0 * k for k in range(5)]),
        [Distance([(3 * k, 3 * k + j) for k in range(5) for j in (1, 2)])],
    ),
    "chain": (chain(12), [Distance([(k, k + 1) for k in range(11)])]),
    "chain with angles": (chain(7), [Distance([(k, k + 1) for k in range(6)]), Angle([(1, 2, 3), (3, 4, 5)])]),
    "pendulum": (chain(3), [FixedAtoms([0]), Distance([(0, 1), (1, 2)])]),
    "linear molecule": (np.array([[-1.0, 0, 0], [0, 0, 0], [1.2, 0, 0]]), [Distance(TRIANGLE)]),
    "few among many": (
        np.vstack([chain(3), 5 + chain(20)]),
        [Distance([(0, 1)]), LinearRelation(2, [0, 1], [-1.0, 2.0], None)],
    ),
}


@pytest.mark.parametrize("bath", BATHS)
@pytest.mark.parametrize("trial", range(6))
def test_global_rule_no_nan_and_no_change_on_failure(bath: str, trial: int) -> None:
    """Whatever displacement comes in: a solution to the tolerance, or a typed error and untouched arrays."""
    x, rows = BATHS[bath]
    rng = np.random.default_rng(100 + trial)
    motion = motion_of(rows, x, rng.uniform(1, 16, len(x)))
    held = motion.constraint_set
    new = x + 10.0 ** (trial - 3) * rng.standard_normal(x.shape)
    v = rng.standard_normal(x.shape)
    arrays = (new, v, x)
    before = [a.tobytes() for a in arrays]
    try:
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
    except ConvergenceError:
        assert [a.tobytes() for a in arrays] == before
    else:
        assert np.all(np.isfinite(new)) and np.all(np.isfinite(v))
        assert np.all(np.abs(held.value(new)) <= 2 * held.tolerance(new))
    spoiled = new.copy()
    spoiled[held.row_atoms(held.n_rows - 1)[-1], 0] = np.nan
    with refused(InputError, "not finite", spoiled, v):
        motion.project_positions(spoiled, x, velocities=v, dt=0.1, out=spoiled)
    with refused(InputError, "not finite", spoiled, v):
        motion.project_velocities(x, spoiled, out=spoiled)
