"""Functions that share no atom, one after the other and many at once; solvers called by address from a kernel."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from kcons import ConstraintSet, Motion
from kcons.constraints import Angle, Custom, Dihedral, Distance, Ellipsoid, Formula, Plane, Sphere, Torus
from kcons.errors import ConvergenceError
from kcons.solvers.addressable_solvers import pack_solver_tables, packed_positions, packed_tangents, set_lattice
from kcons.solvers.cluster_solver import Request
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.sparse import row_functions
from kcons.solvers.sparse.mixed_rows import SparseRows
from kcons.solvers.sparse.row_functions import BLOCK, FEWEST, GivenRows


def test_steps_that_overshoot_are_halved():
    """Plain Newton on atan runs away from a start like this one."""
    item = Custom([0], lambda r: np.arctan(r[0, 0]), lambda r: np.array([[1 / (1 + r[0, 0] ** 2), 0, 0]]), target=0.0)
    x = np.array([[0.0, 0.0, 0.0]])
    solver = SingleRows(ConstraintSet(item, x, [1.0]), np.arange(1), np.ones(1))
    new = np.array([[30.0, 0.0, 0.0]])
    assert solver.positions(Request(new, x)).converged
    assert abs(new[0, 0]) < 1e-14


@pytest.mark.parametrize("seed", [154, 1285, 1370, 2917])
def test_a_dihedral_that_turns_over_has_no_solution_far_away(seed):
    """Nearly straight at both ends it is flat 10 to 2000 displacements away, and would be right again."""
    rng = np.random.default_rng(seed)
    middle = rng.normal(size=3)
    sides = np.cross(middle, rng.normal(size=(2, 3)))
    sides *= 0.01 * np.linalg.norm(middle) / np.linalg.norm(sides, axis=1)[:, None]
    ends = 10 ** rng.uniform(-1, 1, (2, 1)) * (middle + sides)
    x = np.cumsum([np.zeros(3), ends[0], middle, ends[1]], axis=0)
    new = x.copy()
    new[3] = x[2] + np.linalg.norm(ends[1]) / np.linalg.norm(middle + sides[1]) * (middle - sides[1])
    inverse_masses = 10 ** rng.uniform(0, 1, 4)
    whole = ConstraintSet(Dihedral([[0, 1, 2, 3]]), x, 1 / inverse_masses)
    kept = new.copy()
    assert not SingleRows(whole, np.arange(1), inverse_masses).positions(Request(new, x)).converged
    assert np.array_equal(new, kept)


# -- many rows at once ------------------------------------------------------------------------------


AXIS, OFF = np.array([0.0, 0.6, 0.8]), np.array([0.1, 0.0, 0.0])
#: More than one block, of which the last one is not full.
MANY = np.arange(BLOCK + FEWEST)


def around(n: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    turn = rng.uniform(0, 2 * np.pi, n)
    return np.stack([np.cos(turn), np.sin(turn), rng.uniform(-0.4, 0.4, n)], axis=1) * rng.uniform(0.9, 1.1, (n, 1))


#: Of these atoms, with parameters that all share or that each has for itself.
ITEMS = {
    "Sphere": lambda atoms, own: Sphere(atoms, OFF + own),
    "Plane": lambda atoms, own: Plane(atoms, AXIS + own),
    "Cylinder": lambda atoms, own: Ellipsoid(atoms, OFF + own, [1.0, np.inf, 1.0], target=None),
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
    x = around(n)
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


@pytest.mark.parametrize(("n", "row"), [(3, 1), (len(MANY), 3), (len(MANY), BLOCK + 2)])
def test_a_row_that_fails_is_named_and_changes_nothing(n, row):
    x = around(n)
    whole = ConstraintSet(Sphere(np.arange(n), [0.0, 0, 0]), x, np.ones(n))
    solver = SingleRows(whole, np.arange(n), np.ones(n))
    new, v = x + 0.001, np.ones_like(x)
    new[row] = 3.0 * np.cross(x[row], [0.0, 0.0, 1.0])  # out of reach
    kept = new.copy()
    outcome = solver.positions(Request(new, x, velocities=v, inv_dt=1.0))
    assert not outcome.converged and outcome.worst_row == row
    assert np.array_equal(new, kept) and np.all(v == 1.0)
    v[row, 1] = np.nan
    kept, outcome = v.copy(), solver.tangents(Request(v, x))
    assert not outcome.converged and outcome.worst_row == row and np.array_equal(v, kept, equal_nan=True)
    with pytest.raises(ConvergenceError, match=rf"#{row} Sphere\({row}\)"):
        Motion(whole, x).project_positions(new, x)


def test_who_is_called_one_by_one():
    """Few rows, those of several objects in one block, parameters at unequal distances, functions of Python."""
    x = around(2 * BLOCK)

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


# -- called by address from a kernel ---------------------------------------------------------------


X = np.array([[0.0, 0, 0], [1.5, 0, 0], [2.0, 1.4, 0], [3.5, 1.4, 0.5], [0.3, 0.2, 4.0], [1.0, 1.0, 5.0]])
MASSES = np.array([12.0, 14.0, 1.0, 16.0, 2.0, 3.0])
CHAIN = [Distance([[0, 1], [1, 2], [2, 3]]), Angle([[0, 1, 2]]), Dihedral([[0, 1, 2, 3]])]
ALONE = [Sphere([4, 5], [0.0, 0, 0])]


def solvers(cell=None) -> list[SparseRows | SingleRows]:
    held = ConstraintSet([*CHAIN, *ALONE], X, MASSES, cell=cell)
    return [SparseRows(held, np.arange(5), 1 / MASSES), SingleRows(held, np.arange(5, 7), 1 / MASSES)]


def tables_of(given, lattice=None):
    tables = pack_solver_tables(given, np.zeros(0, np.int64), np.zeros((0, 3)))
    set_lattice(tables, lattice)
    return tables


@pytest.mark.parametrize("which", [[0], [1], [0, 1]], ids=str)
@pytest.mark.parametrize("cell", [None, np.diag([9.0, 9.5, 10.0])], ids=["open", "periodic"])
def test_the_same_as_from_python(which, cell) -> None:
    rng = np.random.default_rng(1)
    new, v, y = X + 0.02 * rng.normal(size=X.shape), *rng.normal(size=(2, *X.shape))
    shift = 0.0 if cell is None or 1 in which else rng.integers(-1, 2, X.shape) @ cell
    x_ref, new = X + shift, new + shift
    chosen = [solvers(cell)[k] for k in which]
    lattice = ConstraintSet([*CHAIN], X, MASSES, cell=cell).lattice
    tables = tables_of(chosen, lattice)
    place, speed, tangent = new.copy(), v.copy(), y.copy()
    most = packed_positions(place, x_ref, speed, 50.0, tables)
    assert packed_tangents(x_ref, tangent, tables)
    found = []
    for solver in chosen:
        found.append(solver.positions(Request(new, x_ref, None, lattice, 0.0, 0.0, v, 50.0)).iterations)
        assert solver.tangents(Request(y, x_ref, None, lattice)).converged
    assert most == max(found) > 1
    for one, other in ((place, new), (speed, v), (tangent, y)):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("bad", [0, 4], ids=["the first", "the last"])
def test_where_one_fails_nothing_has_changed(bad) -> None:
    new, v = X + 0.01, np.ones_like(X)
    new[bad] += [200.0, -300.0, 100.0]
    given = solvers()
    tables, kept = tables_of(given), new.copy()
    assert packed_positions(new, X, v, 50.0, tables) == -1
    v[bad] = np.nan
    unlike = v.copy()
    assert not packed_tangents(X, v, tables)
    np.testing.assert_array_equal(new, kept)
    np.testing.assert_array_equal(v, unlike)


def test_kernels_are_compiled_for_their_own_solver_only() -> None:
    """Those of the solver serve Python and other kernels."""
    solver = solvers()[0]
    x = X + 0.01
    solver.positions(Request(x, X))
    tables_of([solver])
    for kernel in solver.kernels[:3]:
        assert isinstance(kernel, numba.core.registry.CPUDispatcher) and len(kernel.signatures) == 1
