"""Flat groups of atoms, and rows that are singular on them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.constraint_set import ConstraintSet
from kcons.plan.second_order import without_second_order_rows

Array = NDArray[np.float64]


def pairs_of(n: int) -> list[tuple[int, int]]:
    return list(combinations(range(n), 2))


def turned(x: Sequence[Sequence[float]] | Array, seed: int = 3) -> Array:
    """The same points in a general orientation and place."""
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return np.asarray(x, dtype=float) @ q + rng.standard_normal(3)


def ring(n: int, radius: float = 1.4, phase: float = 0.0) -> Array:
    angle = 2 * np.pi * np.arange(n) / n + phase
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)


BENZENE = np.vstack([ring(6, 1.39), ring(6, 2.48)])
FORMATE = np.array([[0.0, 0, 0], [0, 1.1, 0], [1.1, -0.6, 0], [-1.1, -0.6, 0]])
CO2 = np.array([[-1.16, 0.0, 0.0], [0.0, 0.0, 0.0], [1.16, 0.0, 0.0]])
HEXAGON_12 = [p for p in pairs_of(6) if p[1] - p[0] != 3]


def converted(rows: Constraint | Sequence[Constraint], x: Array, **options: object) -> ConstraintSet:
    given = ConstraintSet(rows, x, np.ones(len(x)), **options)  # type: ignore[arg-type]
    return without_second_order_rows(given, x, 0.0)


def rank_of(held: ConstraintSet, x: Array) -> int:
    a = held.jacobian(x).toarray()
    return int(np.linalg.matrix_rank(a / np.linalg.norm(a, axis=1, keepdims=True), tol=1e-6))


def counts(held: ConstraintSet) -> tuple[int, int]:
    """(distances, rows of linear relations)."""
    of = {"Distance": 0, "LinearRelation": 0}
    for item in held.constraints:
        of[item.family] += item.n_rows
    return of["Distance"], of["LinearRelation"]


CONVERTED = {
    "CO2 by 3": (CO2, pairs_of(3), (1, 3), 5),
    "OCS by 3": ([[0, 0, 0], [1.16, 0, 0], [2.72, 0, 0]], pairs_of(3), (1, 3), 5),
    "C3O2 by 10": ([[0, 0, 0], [1.16, 0, 0], [2.45, 0, 0], [3.74, 0, 0], [4.9, 0, 0]], pairs_of(5), (1, 9), 5),
    "two triples of a line": (
        [[0, 0, 0], [1, 0, 0], [2.1, 0, 0], [3.3, 0, 0]],
        [*pairs_of(3), (1, 3), (2, 3)],
        (1, 6),
        5,
    ),
    "square by 6": (ring(4), pairs_of(4), (3, 3), 6),
    "formate by 6": (FORMATE, pairs_of(4), (3, 3), 6),
    "hexagon by 15": (ring(6), pairs_of(6), (3, 9), 6),
    "hexagon by 12": (ring(6), HEXAGON_12, (3, 9), 6),
    "benzene by 66": (BENZENE, pairs_of(12), (3, 27), 6),
    "two squares with a common edge": (
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0]],
        [p for p in pairs_of(6) if set(p) <= {0, 1, 2, 3} or set(p) <= {1, 2, 4, 5}],
        (5, 6),
        7,
    ),
    "hexagon with an atom above three of it": (
        np.vstack([ring(6), [[0.2, 0.1, 1.3]]]),
        [*pairs_of(6), (0, 6), (1, 6), (2, 6)],
        (6, 9),
        6,
    ),
}
