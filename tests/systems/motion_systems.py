"""What the tests of the engine's public calls are run on: every kind of row, alone or among free atoms."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TRIANGLE = list(combinations(range(3), 2))
ZIGZAG = np.cumsum(np.tile([[0.8, 0.9, 0.1], [0.9, -0.8, 0.2]], (10, 1)), axis=0)
ATOMS = 26


def rows_of_every_kind() -> list[held.Constraint]:
    """Water, lanes, a chain, an anchored bond, mixed and general rows, and a dependent one."""
    return [
        held.Distance([(0, 1), (0, 2), (1, 2)]),
        held.Distance([(3, 4)]),
        held.Distance([(k, k + 1) for k in range(5, 13)]),
        held.FixedAtoms([14]),
        held.Distance([(14, 15)]),
        held.Distance([(16, 17), (17, 18), (16, 17)]),
        held.Angle([(16, 17, 18)]),
        held.RadiusOfGyration([[19, 20, 21]]),
        held.Sphere(22, [9.0, 9, 9]),
    ]


def system(extra: int, seed: int = 0, moving: bool = False):
    """The rows of every kind on scattered atoms among `extra` free ones; the constraint set and positions."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-4, 4, (ATOMS, 3))
    x[:3] = WATER
    x[5:14] = ZIGZAG[:9]
    masses = rng.choice([1.0, 12.0, 16.0], ATOMS)
    rows = rows_of_every_kind()
    if moving:
        rows.append(held.Distance([(23, 24)], lambda t: 3.0 + 0.3 * np.sin(t)))
        rows.append(held.LinearVelocity([[25]], [[1.0, 0.5, 0]], lambda t: np.cos(t)))
    n = ATOMS + extra
    numbers = rng.permutation(n)[:ATOMS]
    whole = rng.uniform(-4, 4, (n, 3))
    whole[numbers] = x
    all_masses = np.full(n, 7.0)
    all_masses[numbers] = masses
    renumbered = [item.renumbered(numbers) for item in rows]
    return ConstraintSet(renumbered, whole, all_masses), whole, numbers


def steps(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 0.03 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
