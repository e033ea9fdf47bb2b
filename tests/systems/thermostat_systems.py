"""Small systems for the tests of thermostats, and an independent integration of the isokinetic equations."""

from __future__ import annotations

import io
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from stepper_systems import system_of as system

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import State, Stepper, System
from kcons.thermostats import ForceGroups, Isokinetic, thermal_velocities

Array = NDArray[np.float64]
METHANE = 0.63 * np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
TEN = list(combinations(range(5), 2))
SHAPE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0], [0.2, -0.5, 0.8]])
MASSES = np.array([16.0, 1.0, 2.0, 3.0])
ROWS = {
    "dumbbells": [[0, 1]],
    "bent": [[0, 1], [0, 2]],
    "triangles": [[0, 1], [0, 2], [1, 2]],
    "tetrahedra": [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]],
}


def repelling(x: Array, t: float = 0.0) -> Array:
    """Soft pairs: no place in space, no torque."""
    d = x[:, None] - x[None, :]
    r2 = (d * d).sum(-1) + np.eye(len(x))
    return (d * np.exp(-r2)[..., None]).sum(1) * 2


def swirling(x: Array, t: float = 0.0) -> Array:
    """Adds up to nothing wherever it is, and exerts a torque."""
    return repelling(x) + np.cross([0.3, 0.1, 1.0], x - x.mean(axis=0))


def quartic(x: Array, t: float = 0.0) -> Array:
    return -(x**3)


def quartic_potential(x: Array, t: float = 0.0) -> float:
    return float((x**4).sum() / 4)


def waves(x: Array, t: float = 0.0) -> Array:
    """A field that is the same nowhere, and exerts torques."""
    return np.sin(np.array([1.0, 1.3, 0.7]) * x + np.array([0.1, 0.5, 0.9]))


def waves_potential(x: Array, t: float = 0.0) -> float:
    k = np.array([1.0, 1.3, 0.7])
    return float((np.cos(k * x + np.array([0.1, 0.5, 0.9])) / k).sum())


#: Steps of two groups of forces, and a System of groups.
TWO = {"slow": 1, "fast": 4}


def grouped(motion: Motion, **forces) -> System:
    return System(motion, ForceGroups(forces))


def dumbbells(n: int = 2, seed: int = 0, force=waves, potential=waves_potential) -> tuple[System, Array]:
    rng = np.random.default_rng(seed)
    x = np.repeat(2.5 * np.stack(np.unravel_index(np.arange(n), (2, 2, 99)), 1).astype(float), 2, axis=0)
    turn = rng.standard_normal((n, 3))
    x[1::2] += turn / np.linalg.norm(turn, axis=1)[:, None]
    masses = np.tile([1.0, 2.0], n)
    pairs = np.arange(2 * n).reshape(-1, 2)
    return system([Distance(pairs, np.ones(n))], x, masses, force, potential), x


def started(n: int = 2, **options) -> tuple[System, State]:
    """Dumbbells with velocities at kT = 0.5."""
    held, x = dumbbells(n, **options)
    return held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4))


def loaded(state: State) -> State:
    """From the file that it is saved to."""
    file = io.BytesIO()
    state.save(file)
    file.seek(0)
    return State.load(file)


def integrated(system: System, state: State, end: float) -> tuple[Array, Array]:
    """Gauss's principle with all rows and v^T M at once, dense, by an ODE solver."""
    held, masses = system.motion.constraint_set, np.repeat(system.masses, 3)

    def slope(t, y):
        x, v = y[: len(y) // 2], y[len(y) // 2 :]
        place = x.reshape(-1, 3)
        f = np.asarray(system.force(place, t)).ravel()
        rows = np.vstack([held.jacobian(place, t).toarray(), masses * v])
        b = np.append(held.acceleration_target(place, v.reshape(-1, 3), t), 0.0)
        z = rows.T @ np.linalg.lstsq((rows / masses) @ rows.T, b - rows @ (f / masses), rcond=None)[0]
        return np.concatenate([v, (f + z) / masses])

    begin = np.concatenate([state.positions.ravel(), state.velocities.ravel()])
    found = solve_ivp(slope, (state.time, end), begin, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return found[: len(masses)].reshape(-1, 3), found[len(masses) :].reshape(-1, 3)


def springs(x, t):
    """Each atom in a harmonic well of its own strength, and an attraction of neighboring molecules."""
    return -np.linspace(0.1, 0.3, len(x))[:, None] * x - 0.05 * (x - np.roll(x, 3, axis=0))


def molecules(name="dumbbells", n=11, *, ions=0, at=0.0, force=springs, **options) -> tuple[System, State]:
    """Molecules that turn, and free atoms after them; 11 fill one group of lanes and part of a second."""
    rng = np.random.default_rng(3)
    size = 1 + max(map(max, ROWS[name]))
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    x = (np.einsum("ak,nkj->naj", SHAPE[:size], turn) + 3.0 * np.arange(n)[:, None, None] / n).reshape(-1, 3)
    x = np.concatenate([x, rng.normal(size=(ions, 3))]) + at
    masses = np.concatenate([np.tile(MASSES[:size], n), np.full(ions, 23.0)])
    pairs = (size * np.arange(n)[:, None, None] + np.array(ROWS[name])).reshape(-1, 2)
    system = System(Motion(ConstraintSet([Distance(pairs)], x, masses, **options), x), force)
    return system, system.initial_state(x, 0.3 * rng.normal(size=x.shape), project=True)


def water_and_more():
    """Rigid water and a bond given twice: rows, positions, masses."""
    x = np.array([[0.0, 0, 0], [0.96, 0, 0], [-0.24, 0.93, 0], [1.5, 1.2, 0.7], [2.4, 1.4, 0.2]])
    return [Distance([[0, 1], [0, 2], [1, 2], [3, 4], [4, 3]])], x, [16.0, 1.0, 1.0, 3.0, 2.0]


class ByTheEngine:
    """A thermostat whose steps are made operation by operation."""

    def __init__(self, thermostat: Stepper) -> None:
        self.thermostat = thermostat

    def step(self, system: System, state: State, dt: float) -> State:
        packed, system.packed = system.packed, None  # type: ignore[misc]
        assert packed is not None
        try:
            return self.thermostat.step(system, state, dt)
        finally:
            system.packed = packed  # type: ignore[misc]


def isokinetics(system: System, **options) -> tuple[Isokinetic, ByTheEngine]:
    """A thermostat with compiled steps, and one without."""
    assert system.packed is not None
    return Isokinetic(momentum="free", **options), ByTheEngine(Isokinetic(momentum="free", **options))


def distance(a: State, b: State) -> float:
    return max(float(np.abs(a.positions - b.positions).max()), float(np.abs(a.velocities - b.velocities).max()))
