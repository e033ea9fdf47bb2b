"""What all solvers of distances share: lengths by row, rows of lanes left over, and when lengths are resolved."""

import numpy as np
import pytest

from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.cluster_solver import Request
from kcons.solvers.distance_clusters import resolved
from kcons.solvers.kernels.lattices import NO_LATTICE, OPEN
from kcons.solvers.rigid_triangles import RigidTriangles
from kcons.solvers.small_clusters import SmallClusters
from kcons.solvers.sparse.distances import SparseDistances

PAIRS = np.array([[0, 1], [0, 2], [1, 2]])
SHAPE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]])
N = 11


def solvers():
    """Eleven triangles, or eleven angles of two bonds, by each solver; rows of the set run backwards from 40."""
    atoms = np.arange(3 * N).reshape(N, 3)
    for kind in ("triangles", "small", "sparse", "chains"):
        pairs = PAIRS if kind in ("triangles", "small", "sparse") else PAIRS[[0, 2]]
        lengths = np.tile(np.linalg.norm(SHAPE[pairs[:, 0]] - SHAPE[pairs[:, 1]], axis=1), (N, 1))
        rows = 40 - np.arange(lengths.size).reshape(lengths.shape)
        if kind == "triangles":
            yield RigidTriangles(rows, atoms, lengths, np.ones(3)), pairs
        elif kind == "small":
            yield SmallClusters(rows, atoms, pairs, lengths, np.ones(3)), pairs
        elif kind == "sparse":
            flat = (3 * np.arange(N)[:, None, None] + pairs).reshape(-1, 2)
            yield SparseDistances(rows.ravel(), flat, lengths.ravel(), np.ones(3 * N)), pairs
        else:
            yield Chains(rows, 3 * np.arange(N + 1), atoms.ravel(), lengths, np.ones(3 * N)), pairs


SOLVERS = {type(solver).__name__: (solver, pairs) for solver, pairs in solvers()}


@pytest.mark.parametrize("name", SOLVERS)
def test_wanted_lengths_and_rates_are_those_of_the_rows(name):
    solver, pairs = SOLVERS[name]
    i, j = (3 * np.arange(N)[:, None, None] + pairs).reshape(-1, 2).T
    rows = 40 - np.arange(len(i))
    x_ref = (SHAPE + 4.0 * np.arange(N)[:, None, None]).reshape(-1, 3)
    wanted = np.full(41, np.nan)
    wanted[rows] = np.linalg.norm(x_ref[i] - x_ref[j], axis=1) * np.linspace(0.99, 1.01, len(i))
    x = x_ref + 0.01 * np.random.default_rng(0).normal(size=x_ref.shape)
    assert solver.positions(Request(x, x_ref, wanted)).converged
    np.testing.assert_allclose(np.linalg.norm(x[i] - x[j], axis=1), wanted[rows], rtol=1e-13)
    wanted[rows] = np.linspace(-1.0, 2.0, len(i))
    y = np.random.default_rng(1).normal(size=x.shape)
    assert solver.tangents(Request(y, x_ref, wanted)).converged
    unit = (x_ref[i] - x_ref[j]) / np.linalg.norm(x_ref[i] - x_ref[j], axis=1)[:, None]
    np.testing.assert_allclose(np.sum(unit * (y[i] - y[j]), axis=1), wanted[rows], atol=1e-13)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("which", ["positions", "tangents"])
@pytest.mark.parametrize("broken", [0, 7, 8, N - 1])
def test_the_failing_row_is_one_of_the_cluster_in_whichever_lane(name, which, broken):
    solver, pairs = SOLVERS[name]
    x_ref = (SHAPE + 4.0 * np.arange(N)[:, None, None]).reshape(-1, 3)
    x = x_ref.copy()
    x[3 * broken] = np.nan
    outcome = getattr(solver, which)(Request(x, x_ref))
    assert not outcome.converged
    row = 40 - solver.rows[outcome.worst_row]
    assert row // len(pairs) == broken


@pytest.mark.parametrize(("at", "miss", "expected"), [(0.0, 5e-15, True), (0.0, 1e-12, False), (1e4, 1e-12, True)])
def test_lengths_are_resolved_as_far_as_positions_are(at, miss, expected):
    x = np.array([[at, 0, 0], [at + 1.0, 0, 0]])
    pairs = np.array([0, 1], dtype=np.uint32)
    assert resolved(x, pairs, np.array([x[1, 0] - x[0, 0] + miss]), NO_LATTICE, OPEN) is expected
