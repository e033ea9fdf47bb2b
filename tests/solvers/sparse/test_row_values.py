"""Compiled values and gradients against the constraint classes."""

import numpy as np
import pytest
from numba import njit

from kcons.constraints import Angle, CenterDistance, Cylinder, Dihedral, Distance, LinearCombination, Plane, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.solvers.kernels.aligned_memory import part_of
from kcons.solvers.kernels.array_views import at_first
from kcons.solvers.sparse.mixed_rows import SparseRows
from kcons.solvers.sparse.row_values import addresses_for, evaluate, miss

KINDS = {
    RowKind.DISTANCE: Distance([[3, 1], [7, 2]]),
    RowKind.ANGLE: Angle([[0, 1, 2], [5, 3, 8]]),
    "dihedrals": Dihedral([[0, 1, 2, 3], [8, 6, 4, 2]]),
    RowKind.LINEAR: LinearCombination([[4, 6, 7]], np.arange(9.0).reshape(1, 3, 3) - 3.5),
    "functions": Cylinder([2, 8], [0.1, 0.2, 0.3], [1.0, 2.0, -0.5]),
    "functions of differences": CenterDistance([[3, 4], [0, 1]], [[7], [5]]),
}


@njit
def of_arrays(
    functions, n, kinds, links, slot_atoms, numbers, base, moves, moved, lattice, periodic, values, lines, which
):  # fmt: skip
    """`evaluate`, which takes pointers, for the rows of arrays."""
    evaluate(
        functions, 0, n, at_first(kinds), at_first(links), at_first(slot_atoms), at_first(numbers), at_first(base),
        at_first(moves), at_first(base), at_first(moved), lattice, periodic, at_first(values), at_first(lines), which,
    )  # fmt: skip


def evaluated(constraints, x, cell=None, moves=0.0, moved=0.0):
    """Values and dense gradients of the kernel with positions split into whole and moves, in the set's order.

    Positions come `moved`, which rows with a place in space take off.
    """
    constraint_set = ConstraintSet(constraints, x, np.ones(len(x)), cell=cell)
    n = constraint_set.n_rows
    solver = SparseRows(constraint_set, np.arange(n), np.ones(len(x)))
    atoms, slot_atoms, kinds, links = (part_of(solver.tables, k, np.uint32) for k in (1, 3, 4, 5))
    base, change = np.zeros((2, len(atoms), 4))
    base[:, :3], change[:, :3] = (x - moves + moved)[atoms], np.broadcast_to(moves, x.shape)[atoms]
    taken = np.zeros((len(slot_atoms), 4))
    slots = links.reshape(-1, 4)[:, 2]
    for k, row in enumerate(solver.rows):
        if not constraint_set.locate(int(row))[0].relative:
            taken[slots[k] : slots[k + 1], :3] = np.broadcast_to(moved, x.shape)[
                atoms[slot_atoms[slots[k] : slots[k + 1]]]
            ]
    lattice = np.zeros((2, 3, 3)) if cell is None else constraint_set.lattice
    values, lines = np.zeros(n), np.zeros(8 * len(slot_atoms))
    for which in range(2):
        of_arrays(
            addresses_for(kinds)[1], n, kinds, links, slot_atoms, solver.numbers, base.ravel(), change.ravel(),
            taken.ravel(), lattice, cell is not None, values, lines, which,
        )  # fmt: skip
    lines = lines.reshape(-1, 8)
    np.testing.assert_array_equal(lines[:, 0:6:2], lines[:, 1:6:2])
    gradient = np.zeros((n, len(x), 3))
    measured = np.zeros(n)
    for k, row in enumerate(solver.rows):
        measured[row] = values[k]
        for p in range(slots[k], slots[k + 1]):
            gradient[row, atoms[slot_atoms[p]]] += lines[p, 0:6:2]
    return constraint_set, measured, gradient.reshape(n, -1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cell", [None, np.array([[40.0, 0, 0], [6, 36, 0], [-4, 8, 44]])], ids=["open", "triclinic"])
def test_rows_equal_their_constraints(kind, cell):
    rng = np.random.default_rng(list(KINDS).index(kind))
    x = 2 * rng.normal(size=(9, 3))
    if cell is not None and KINDS[kind].translation_invariant:
        x = x + rng.integers(-1, 2, size=(9, 3)) @ cell
    constraint_set, values, gradient = evaluated([KINDS[kind]], x, cell, 0.1 * rng.normal(size=(9, 3)))
    np.testing.assert_allclose(values, constraint_set.measure(x), rtol=1e-13, atol=1e-13)
    expected = constraint_set.jacobian(x).toarray()
    np.testing.assert_allclose(
        gradient, expected, atol=1e-13 * max(1, np.abs(expected).max()) * (1 if cell is None else 100)
    )


def test_rows_with_a_place_take_off_what_positions_were_moved_by():
    """Ties see the atoms where they are, places where they are stored."""
    rng = np.random.default_rng(10)
    x, moved = 2 * rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    rows = [*KINDS.values(), Plane([1], [0, 0.6, 0.8])]
    constraint_set, values, _ = evaluated(rows, x, moves=0.1, moved=moved)
    relative = np.concatenate([np.full(c.n_rows, c.relative) for c in constraint_set.constraints])
    expected = np.where(relative, constraint_set.measure(x + moved), constraint_set.measure(x))
    assert 0 < relative.sum() < len(relative)
    np.testing.assert_allclose(values, expected, rtol=1e-13, atol=1e-13)


def test_rows_with_a_period_miss_by_the_shorter_way():
    turn = 2 * np.pi
    assert miss(3.1, -3.1, turn) == pytest.approx(2 * np.pi - 6.2)
    # More than a quarter of a turn is nothing to go round for.
    assert miss(-1.0, 1.9, turn) == pytest.approx(2.9)
    assert miss(1.0, -1.9, turn) == pytest.approx(-2.9)
    assert miss(-1.0, 2.4, turn) == pytest.approx(3.4 - 2 * np.pi)
    assert miss(3.1, 0.1, 0.0) == pytest.approx(-3.0)
