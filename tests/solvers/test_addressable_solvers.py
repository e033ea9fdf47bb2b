"""Solvers called by address from a kernel: what they find, and that all of them wait for each other."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from kcons import ConstraintSet
from kcons.constraints import Angle, Dihedral, Distance, Sphere
from kcons.solvers.addressable_solvers import pack_solver_tables, packed_positions, packed_tangents, set_lattice
from kcons.solvers.cluster_solver import Request
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.sparse.mixed_rows import SparseRows

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
