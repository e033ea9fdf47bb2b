"""Hard cases of the core (docs/hard-cases.md): masses, steps, starts, H08 to H16."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from hard_cases.core_systems import (
    TRIANGLE,
    WATER,
    WATER_MASSES,
    Array,
    chain,
    motion_of,
    pendulum,
    refused,
    rotated,
    system_of,
    worst_residual,
)
from kcons.constraints import Angle, Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InputError
from kcons.motion import Motion
from kcons.steppers import Rattle, State, System, run

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
