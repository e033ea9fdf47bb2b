"""Factors and sweeps of the sparse elimination against dense algebra."""

import numpy as np
import pytest

from kcons.solvers.sparse.elimination import make_pattern
from kcons.solvers.sparse.substitution import backward, factor, forward


def pattern_of(pairs, n_atoms):
    flat = np.asarray(pairs, dtype=np.int64)
    return make_pattern(2 * np.arange(len(flat) + 1), flat.ravel(), n_atoms)


def random_tree(n_atoms, seed):
    rng = np.random.default_rng(seed)
    return [(int(rng.integers(max(0, k - 5), k)), k) for k in range(1, n_atoms)]


RINGS = [(k, (k + 1) % 12) for k in range(12)] + [(k, 12 + k) for k in range(12)] + [(3, 24), (24, 9)]


@pytest.mark.parametrize("pairs", [random_tree(40, 3), RINGS], ids=["tree", "rings"])
def test_sweeps_solve_the_dense_system(pairs):
    """Two right-hand sides with one factor of a matrix with r != s."""
    n_atoms, n = 41, len(pairs)
    rng = np.random.default_rng(0)
    pattern = pattern_of(pairs, n_atoms)
    ends = np.array(pairs)[pattern.order]
    r, s = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    r = s + 0.1 * r
    w = rng.uniform(0.5, 2.0, n_atoms)
    incidence = np.zeros((n, n_atoms))
    incidence[np.arange(n), ends[:, 0]], incidence[np.arange(n), ends[:, 1]] = 1.0, -1.0
    coupling = incidence @ np.diag(w) @ incidence.T
    matrix = coupling * (r @ s.T)
    links = np.zeros((n + 1, 4), np.uint32)
    links[:, 0], links[:, 1], links[:-1, 2:] = pattern.start, pattern.target_start, ends
    row = np.repeat(np.arange(n), np.diff(pattern.start))
    couplings = coupling[row, pattern.columns]
    state = np.zeros((n, 8))
    state[:, 0:6:2], state[:, 1:6:2] = r, s
    right = rng.normal(size=(2, n))
    state[:, 7] = right[0]
    moves = np.zeros((n_atoms, 4))
    moves[:, 3] = w
    flat, entries, pivots, solution = state.ravel(), np.zeros(4 * len(row)), np.zeros(n), np.zeros(n)
    tables = links.ravel(), pattern.columns
    factor(0, n, *tables, pattern.targets, couplings, np.diag(coupling).copy(), flat, entries, pivots)
    backward(0, n, *tables, flat, entries, pivots, moves.ravel(), solution)
    first = np.linalg.solve(matrix, right[0])
    np.testing.assert_allclose(solution, first, rtol=1e-9, atol=1e-9 * np.abs(first).max())
    state[:, 7] = right[1]
    forward(0, n, *tables, flat, entries)
    backward(0, n, *tables, flat, entries, pivots, moves.ravel(), solution)
    both = np.linalg.solve(matrix, right.sum(axis=0))
    np.testing.assert_allclose(solution, both, rtol=1e-9, atol=1e-9 * np.abs(both).max())
    expected = w[:, None] * (incidence.T @ (solution[:, None] * s))
    np.testing.assert_allclose(moves[:, :3], expected, atol=1e-9 * np.abs(expected).max())
    assert not entries.reshape(-1, 4)[:, 2:].any()
