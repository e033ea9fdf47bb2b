"""Functions of many rows at once, against the same functions called one by one."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet
from kcons.constraints import Custom, Cylinder, Ellipsoid, Formula, Plane, Sphere, Torus
from kcons.solvers.cluster_solver import Request
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.sparse import row_functions
from kcons.solvers.sparse.row_functions import BLOCK, FEWEST, GivenRows

AXIS, OFF = np.array([0.0, 0.6, 0.8]), np.array([0.1, 0.0, 0.0])
#: More than one block, of which the last one is not full.
MANY = np.arange(BLOCK + FEWEST)


def scattered(n: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    turn = rng.uniform(0, 2 * np.pi, n)
    return np.stack([np.cos(turn), np.sin(turn), rng.uniform(-0.4, 0.4, n)], axis=1) * rng.uniform(0.9, 1.1, (n, 1))


#: Of these atoms, with parameters that all share or that each has for itself.
ITEMS = {
    "Sphere": lambda atoms, own: Sphere(atoms, OFF + own),
    "Plane": lambda atoms, own: Plane(atoms, AXIS + own),
    "Cylinder": lambda atoms, own: Cylinder(atoms, OFF + own, AXIS),
    "Ellipsoid": lambda atoms, own: Ellipsoid(atoms, OFF + own, [1.0, 2.0, 3.0], target=None),
    "Torus": lambda atoms, own: Torus(atoms, OFF + own, AXIS, 0.5),
    "Formula": lambda atoms, own: Formula("z1 - a*sin(x1 + t)*y1**2", atoms, {"a": 0.5 + np.ravel(own[..., 0])}, None),
}


def owned(own: bool, n: int) -> np.ndarray:
    return 0.01 * np.random.default_rng(3).normal(size=(n, 3)) if own else np.zeros(3)


@pytest.mark.parametrize("own", [False, True], ids=["shared", "own"])
@pytest.mark.parametrize("name", ITEMS)
def test_solutions_are_those_of_rows_called_one_by_one(name, own, monkeypatch):
    """In two blocks, with targets of their own, the second one not full."""
    n = len(MANY)
    x = scattered(n)
    whole = ConstraintSet(ITEMS[name](MANY, owned(own, n)), x, np.linspace(1.0, 2.0, n), time=0.3)
    rng = np.random.default_rng(1)
    new, y, rates = x + 0.01 * rng.normal(size=x.shape), rng.normal(size=x.shape), rng.normal(size=n)
    found = []
    for fewest in (FEWEST, 10**6):
        monkeypatch.setattr(row_functions, "FEWEST", fewest)
        solver = SingleRows(whole, MANY, 1 / whole.masses)
        assert (solver._given.at_once(BLOCK)[:, 0] != 0).tolist() == [fewest == FEWEST] * 2
        positions, velocities, tangents, lam = new.copy(), y.copy(), y.copy(), np.empty((2, n))
        outcome = solver.positions(Request(positions, x, None, None, 0.3, 0.2, velocities, 7.0), lam[0])
        assert outcome.converged and 0 < outcome.iterations <= 6
        assert solver.tangents(Request(tangents, x, rates, None, 0.3), lam[1]).converged
        found.append((positions, velocities, tangents, lam))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    assert np.all(np.abs(whole.value(found[0][0], 0.3)) <= 2 * whole.tolerance(x, 0.3))


def test_a_row_that_fails_is_named_in_any_block():
    x = scattered(len(MANY))
    solver = SingleRows(ConstraintSet(Sphere(MANY, [0.0, 0, 0]), x, np.ones(len(x))), MANY, np.ones(len(x)))
    for row in (3, BLOCK + 2):
        new, v = x + 0.001, np.ones_like(x)
        new[row] = 3.0 * np.cross(x[row], [0.0, 0.0, 1.0])  # out of reach
        kept = new.copy()
        outcome = solver.positions(Request(new, x, velocities=v, inv_dt=1.0))
        assert not outcome.converged and outcome.worst_row == row
        assert np.array_equal(new, kept) and np.all(v == 1.0)
        v[row, 1] = np.nan
        assert solver.tangents(Request(v, x)).worst_row == row


def test_who_is_called_one_by_one():
    """Few rows, those of several objects in one block, parameters at unequal distances, functions of Python."""
    x = scattered(2 * BLOCK)

    def taken(*items) -> list[bool]:
        whole = ConstraintSet(items, x, np.ones(len(x)))
        return (GivenRows(whole, np.arange(whole.n_rows), 10).at_once(BLOCK)[:, 0] != 0).tolist()

    all_atoms = np.arange(2 * BLOCK)
    assert taken(Sphere(all_atoms, [0, 0, 0])) == [True, True]
    assert taken(Sphere(all_atoms[: FEWEST - 1], [0, 0, 0])) == [False]
    assert taken(Sphere(all_atoms[: BLOCK + 4], [0, 0, 0]), Plane(all_atoms[BLOCK + 4 :], AXIS)) == [True, False]
    assert taken(Sphere(all_atoms[:BLOCK], [0, 0, 0]), Plane(all_atoms[BLOCK:], AXIS)) == [True, True]
    assert taken(Custom(all_atoms[:, None], lambda r: r[0] @ r[0], lambda r: 2 * r)) == [False, False]
    assert taken() == []
