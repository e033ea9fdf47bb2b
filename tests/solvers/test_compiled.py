"""The engine's projections inside other kernels: the numbers of the solvers themselves."""

import numba
import numpy as np
import pytest
from test_lanes import CONNECTIONS

from kcons.solvers.compiled import TRIANGLES, kind_and_tables, land, level
from kcons.solvers.groups import lattice_kind
from kcons.solvers.lanes import SmallClusters
from kcons.solvers.water import PAIRS, RigidTriangles

CELL = np.diag([29.0, 28.0, 27.0])


def kernels(kind):
    solver = kind

    @numba.njit
    def landing(x, reference, v, inverse_dt, lattice, image, *tables):
        return land(solver, x, reference, v, inverse_dt, lattice, image, tables)

    @numba.njit
    def levelling(x, y, lattice, image, *tables):
        return level(solver, x, y, lattice, image, tables)

    return landing, levelling


def clusters(pairs, n=11, triangles=False):
    """A solver of n clusters, positions on its rows, and a little off them."""
    rng = np.random.default_rng(5)
    size = 1 + max(max(pair) for pair in pairs)
    shape = rng.normal(size=(size, 3)) + 0.5 * np.arange(size)[:, None]
    turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    x = np.ascontiguousarray((np.einsum("ak,nkj->naj", shape, turns)).reshape(-1, 3))
    atoms = np.arange(size * n).reshape(n, size)
    i, j = np.array(pairs).T
    lengths = np.tile(np.linalg.norm(shape[i] - shape[j], axis=1), n)
    rows = np.arange(len(pairs) * n).reshape(n, -1)
    inverse_masses = 1.0 / rng.uniform(1, 16, size)
    if triangles:
        solver = RigidTriangles(rows, atoms, lengths.reshape(n, 3), inverse_masses)
    else:
        solver = SmallClusters(rows, atoms, pairs, lengths.reshape(n, -1), inverse_masses)
    return solver, x, x + 0.01 * rng.normal(size=x.shape), rng.normal(size=x.shape)


CASES = {"triangles": PAIRS, **CONNECTIONS}


@pytest.mark.parametrize("name", ["triangles", "bond", "star2", "star4", "chain5"])
@pytest.mark.parametrize("cell", [None, CELL], ids=["open", "periodic"])
def test_numbers_are_those_of_the_solver(name, cell):
    solver, x, moved, v = clusters(CASES[name], triangles=name == "triangles")
    kind, tables = kind_and_tables(solver)
    assert kind == (TRIANGLES if name == "triangles" else len(CASES[name]))
    lattice = None if cell is None else np.array([cell, np.linalg.inv(cell)])
    landing, levelling = kernels(kind)
    places, speeds = (moved.copy(), moved.copy()), (v.copy(), v.copy())
    outcome = solver.positions(places[0], x, None, lattice, speeds[0], 100.0)
    found = landing(places[1], x, speeds[1], 100.0, *lattice_kind(lattice), *tables)
    assert outcome.converged and found == outcome.iterations > 0
    assert np.array_equal(*places) and np.array_equal(*speeds) and not np.array_equal(places[0], moved)
    before = v.copy()
    vectors = v.copy(), v.copy()
    assert solver.tangents(x, vectors[0], None, lattice).converged
    assert levelling(x, vectors[1], *lattice_kind(lattice), *tables)
    assert np.array_equal(*vectors) and not np.array_equal(vectors[0], before)


@pytest.mark.parametrize("name", ["triangles", "bond"])
def test_what_has_no_solution_changes_nothing(name):
    solver, x, moved, v = clusters(CASES[name], triangles=name == "triangles")
    kind, tables = kind_and_tables(solver)
    landing, levelling = kernels(kind)
    moved[-1] = 1e3
    place, speed = moved.copy(), v.copy()
    assert landing(place, x, speed, 100.0, *lattice_kind(None), *tables) == -1
    assert np.array_equal(place, moved) and np.array_equal(speed, v)
    v[-1] = np.nan
    vectors = v.copy()
    assert not levelling(x, vectors, *lattice_kind(None), *tables)
    assert np.array_equal(vectors, v, equal_nan=True)


def test_other_solvers_are_not_compiled_in():
    assert kind_and_tables(object()) is None


def test_the_kind_must_be_a_constant():
    solver, x, _, v = clusters(PAIRS, triangles=True)

    @numba.njit
    def levelling(kind, x, y, lattice, image, *tables):
        return level(kind, x, y, lattice, image, tables)

    with pytest.raises(numba.TypingError, match="must be a constant"):
        levelling(np.float64(0), x, v, *lattice_kind(None), *solver.tables())
    for call in (land, level):
        with pytest.raises(NotImplementedError):
            call(*[None] * call.__code__.co_argcount)
