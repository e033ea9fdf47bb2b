"""Systems of the hard cases, and what must hold of all of them.

One test a case; the numbers are those that must be reached. Global rule: no NaN is ever returned, and no input array
is changed by a call that fails.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import Constraint, Distance, FixedAtoms
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import KconsError
from kcons.motion import Motion
from kcons.steppers import State, System

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
