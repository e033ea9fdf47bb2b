"""Rigid ideal gases and fluids of dumbbells for the tests of barostats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import State
from kcons.thermostats import Barostat, CellSystem, thermal_velocities
from kcons.thermostats.correlated_series import spread

Array = NDArray[np.float64]
#: 3 rows, and methane by all its 10 distances, of rank 9.
TRIANGLE = np.array([[0.0, 0, 0], [0.9, 0, 0], [-0.2, 0.8, 0]])
METHANE = 0.63 * np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
DUMBBELL = np.array([[0.0, 0, 0], [1.0, 0, 0]])


def placed(shape: Array, n: int, side: float, seed: int) -> Array:
    """`n` molecules at random, turned at random, atoms wrapped into the cell."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    x = rng.uniform(0, side, (n, 1, 3)) + shape @ turns
    return x.reshape(-1, 3) % side


def gas(
    shape: Array = DUMBBELL, n: int = 50, side: float = 12.0, seed: int = 1, **functions
) -> tuple[CellSystem, Array]:
    """Rigid molecules held by all their distances, without forces between them."""
    x = placed(shape, n, side, seed)
    m = len(shape)
    pairs = np.array([(i, j) for i in range(m) for j in range(i + 1, m)])
    lengths = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)
    rows = Distance((pairs + m * np.arange(n)[:, None, None]).reshape(-1, 2), np.tile(lengths, n))
    masses = np.tile(1.0 + np.arange(m), n)
    held = ConstraintSet(rows, x, masses, cell=np.full(3, side))
    return CellSystem(Motion(held, x), **functions), x


def no_force(x: Array, time: float, cell: Array) -> Array:
    return np.zeros_like(x)


def round_shape(x: Array, time: float, cell: Array) -> float:
    """Keeps the shape of the cell, and knows nothing of its volume."""
    return 100 * ((cell**2).sum() / abs(np.linalg.det(cell)) ** (2 / 3) - 3)


def started(system: CellSystem, x: Array, barostat: Barostat, thermal: float = 1.0) -> State:
    state = system.initial_state(x, thermal_velocities(system, x, thermal, 2))
    vars(state)["barostat"] = barostat.begin(system)
    return state


def cells_of(system: CellSystem, state: State, barostat: Barostat, trials: int, thermal: float = 1.0) -> Array:
    """Cells after each of so many trials, with nothing between them, shape (trials, 3, 3)."""
    cells = np.empty((trials, 3, 3))
    for k in range(trials):
        state = barostat.move(system, state, thermal, 1.0)
        vars(state)["step"] = k + 1
        cells[k] = state.cell
    return cells


def p_value(values: Array, distribution: stats.rv_continuous) -> float:
    """Of a Kolmogorov-Smirnov test on every so many of correlated values, which are then nearly independent."""
    apart = 2 * int(np.ceil(len(values) / spread(values).independent))
    return float(stats.kstest(values[::apart], distribution.cdf).pvalue)
