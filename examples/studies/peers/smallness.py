"""What solvers with dense matrices need: few rows with constant targets, plain arrays, one thread for BLAS."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec

import numpy as np

from kcons.comparison.methods import independent_rows
from kcons.comparison.test_systems import TestSystem
from kcons.constraints import Distance, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray

#: Dense matrices of all rows at once.
MOST_ATOMS, MOST_ROWS = 40, 60


def too_much(test_system: TestSystem) -> str | None:
    """Why a dense solver cannot run the test system, or None."""
    held = test_system.constraint_set
    if held.moving:
        return "its constraints cannot move"
    if not held.holonomic.all():
        return "it holds functions of the positions only"
    if test_system.n_atoms > MOST_ATOMS or held.n_rows > MOST_ROWS:
        return f"its matrices are dense; more than {MOST_ATOMS} atoms or {MOST_ROWS} rows take too long"
    return None


@cache
def one_thread(after: str) -> None:
    """Keep BLAS to one thread (where threadpoolctl is installed), once the libraries of a peer are loaded.

    Threads spin on matrices this small, and take a hundred times as long.
    """
    if find_spec("threadpoolctl") is not None:
        from threadpoolctl import threadpool_limits

        threadpool_limits(1)


def plain_set(test_system: TestSystem) -> ConstraintSet:
    """What the test system holds as independent rows, by distances alone where that is the same."""
    if test_system.bonds is None or len(test_system.fixed) or test_system.cell is not None:
        return independent_rows(test_system)
    held = ConstraintSet(Distance(test_system.bonds), test_system.positions, test_system.masses)
    return independent_rows(test_system, held)


Rows = tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]


def dense_rows(held: ConstraintSet) -> Rows:
    """sigma(q) and its Jacobian as dense arrays, of flat positions q.

    Distances and spheres are written out, so that a peer does not pay for the generality of a constraint set.
    """
    if held.lattice is not None or not all(isinstance(item, Distance | Sphere) for item in held.constraints):
        return (
            lambda q: held.value(q.reshape(-1, 3)),
            lambda q: np.asarray(held.jacobian(q.reshape(-1, 3)).toarray()),
        )
    first: list[int] = []
    second: list[int] = []
    centers: list[FloatArray] = []
    for item in held.constraints:
        for k, atoms in enumerate(item.atoms):
            first.append(int(atoms[0]))
            second.append(int(atoms[1]) if isinstance(item, Distance) else -1)
            centers.append(_center(item, k) if isinstance(item, Sphere) else np.zeros(3))
    row, i, j, center = np.arange(held.n_rows), np.array(first), np.array(second), np.array(centers)
    pairs = np.flatnonzero(j >= 0)
    lengths = held.target()
    columns = 3 * i[:, None] + np.arange(3)
    others = 3 * j[pairs, None] + np.arange(3)

    def ends(q: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = q.reshape(-1, 3)
        d = x[i] - center
        d[pairs] -= x[j[pairs]]
        return d, np.sqrt(np.einsum("ij,ij->i", d, d))

    def value(q: FloatArray) -> FloatArray:
        return np.asarray(ends(q)[1] - lengths)

    def jacobian(q: FloatArray) -> FloatArray:
        d, r = ends(q)
        d /= r[:, None]
        a = np.zeros((len(row), q.size))
        a[row[:, None], columns] = d
        a[row[pairs][:, None], others] = -d[pairs]
        return a

    return value, jacobian


def _center(item: Sphere, row: int) -> FloatArray:
    return np.asarray(np.broadcast_to(item.center, (item.n_rows, 3))[row], dtype=float)
