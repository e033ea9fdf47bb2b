"""Small clusters in lanes against a dense Newton iteration."""

import numpy as np
import pytest

from kcons.solvers.small_clusters import SmallClusters
from tests.systems.solver_calls import positions, tangents

CONNECTIONS = {
    "bond": [(0, 1)],
    "star2": [(0, 1), (0, 2)],
    "chain3": [(0, 1), (1, 2), (2, 3)],
    "star3": [(0, 1), (0, 2), (3, 0)],
    "ring3": [(0, 1), (1, 2), (2, 0)],
    "ring4": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "star4": [(0, 1), (0, 2), (0, 3), (0, 4)],
    "chain5": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)],
    "tetrahedron": [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)],
}
CELLS = {
    "open": None,
    "orthorhombic": np.diag([9.0, 8.0, 10.0]),
    "triclinic": np.array([[9.0, 0.0, 0.0], [2.0, 8.0, 0.0], [-1.5, 2.5, 10.0]]),
}


def jacobian(x, pairs):
    rows = np.zeros((len(pairs), len(x), 3))
    for k, (i, j) in enumerate(pairs):
        u = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j])
        rows[k, i], rows[k, j] = u, -u
    return rows.reshape(len(pairs), -1)


def dense_positions(x_new, x_ref, pairs, lengths, inv_mass):
    """Literal Newton iteration; returns displaced points and multipliers."""
    weights = np.repeat(inv_mass, 3)
    pull = weights[:, None] * jacobian(x_ref, pairs).T
    multipliers, x = np.zeros(len(pairs)), x_new.copy()
    i, j = np.array(pairs).T
    for _ in range(20):
        sigma = np.linalg.norm(x[i] - x[j], axis=1) - lengths
        multipliers -= np.linalg.solve(jacobian(x, pairs) @ pull, sigma)
        x = x_new + (pull @ multipliers).reshape(-1, 3)
    return x, multipliers


def dense_tangents(x, y, pairs, rates, inv_mass):
    a = jacobian(x, pairs)
    pull = np.repeat(inv_mass, 3)[:, None] * a.T
    multipliers = np.linalg.solve(a @ pull, a @ y.reshape(-1) - rates)
    return y - (pull @ multipliers).reshape(-1, 3), multipliers


class Clusters:
    """Clusters with shuffled atoms among bystanders that must stay as they are."""

    def __init__(self, pairs, n_clusters, seed=0, inv_mass=None, offset=0.0):
        rng = np.random.default_rng(seed)
        self.pairs = pairs
        n_local = 1 + max(max(pair) for pair in pairs)
        self.n_atoms = n_clusters * n_local + 5
        self.atoms = rng.permutation(self.n_atoms)[: n_clusters * n_local].reshape(-1, n_local)
        shape = rng.normal(size=(n_local, 3))
        shape /= np.linalg.norm(shape, axis=1)[:, None]
        shape = shape * 1.1 + np.arange(n_local)[:, None] * np.array([0.4, 0.2, -0.3])
        turns = np.linalg.qr(rng.normal(size=(n_clusters, 3, 3)))[0]
        self.x_ref = rng.normal(size=(self.n_atoms, 3))
        centres = rng.uniform(0, 8, size=(n_clusters, 1, 3))
        self.x_ref[self.atoms] = np.einsum("nij,aj->nai", turns, shape) + centres + offset
        i, j = np.array(pairs).T
        bonds = shape[i] - shape[j]
        self.lengths = np.tile(np.linalg.norm(bonds, axis=1), (n_clusters, 1))
        self.x_new = self.x_ref + 0.03 * rng.normal(size=self.x_ref.shape)
        self.y = rng.normal(size=self.x_ref.shape)
        self.velocities = rng.normal(size=self.x_ref.shape)
        self.inv_mass = 1 / rng.uniform(1, 16, n_local) if inv_mass is None else inv_mass
        n_rows = n_clusters * len(pairs)
        self.rows = 7 + rng.permutation(n_rows).reshape(n_clusters, -1)

    def solver(self):
        return SmallClusters(self.rows, self.atoms, self.pairs, self.lengths, self.inv_mass)

    def lengths_of(self, x):
        i, j = np.array(self.pairs).T
        return np.linalg.norm(x[self.atoms[:, i]] - x[self.atoms[:, j]], axis=2)

    @property
    def flat(self):
        return self.lengths.reshape(-1).copy()


def lattice_of(cell):
    return None if cell is None else np.array([cell, np.linalg.inv(cell)])


@pytest.mark.parametrize("name", CONNECTIONS)
@pytest.mark.parametrize("n_clusters", [1, 8, 13])
def test_matches_dense_newton(name, n_clusters):
    c = Clusters(CONNECTIONS[name], n_clusters)
    solver = c.solver()
    x, velocities = c.x_new.copy(), c.velocities.copy()
    multipliers = np.full(c.rows.size, np.nan)
    outcome = positions(solver, x, c.x_ref, c.flat, None, velocities, 500.0, multipliers)
    assert outcome.converged
    assert outcome.residual <= 4e-15
    assert 0 <= outcome.worst_row < c.rows.size
    expected = c.x_new.copy()
    for n, atoms in enumerate(c.atoms):
        expected[atoms], m = dense_positions(c.x_new[atoms], c.x_ref[atoms], c.pairs, c.lengths[n], c.inv_mass)
        k = len(c.pairs)
        np.testing.assert_allclose(multipliers[n * k : n * k + k], m, atol=1e-12)
    np.testing.assert_allclose(x, expected, atol=1e-12)
    np.testing.assert_allclose(velocities, c.velocities + 500 * (expected - c.x_new), atol=1e-9)
    bystanders = np.setdiff1d(np.arange(c.n_atoms), c.atoms)
    np.testing.assert_array_equal(x[bystanders], c.x_new[bystanders])
    assert np.abs(c.lengths_of(x) / c.lengths - 1).max() <= 1e-14


@pytest.mark.parametrize("name", CONNECTIONS)
@pytest.mark.parametrize("driven", [False, True])
def test_tangents_match_dense_solve(name, driven):
    c = Clusters(CONNECTIONS[name], 11, seed=1)
    rates = np.random.default_rng(2).normal(size=c.rows.size) if driven else None
    y, multipliers = c.y.copy(), np.full(c.rows.size, np.nan)
    outcome = tangents(c.solver(), c.x_ref, y, rates, None, multipliers)
    assert outcome.converged
    k = len(c.pairs)
    for n, atoms in enumerate(c.atoms):
        wanted = rates[n * k : n * k + k] if driven else np.zeros(k)
        expected, m = dense_tangents(c.x_ref[atoms], c.y[atoms], c.pairs, wanted, c.inv_mass)
        np.testing.assert_allclose(y[atoms], expected, atol=1e-12)
        np.testing.assert_allclose(multipliers[n * k : n * k + k], m, atol=1e-11)
        speed = jacobian(c.x_ref[atoms], c.pairs) @ y[atoms].reshape(-1) - wanted
        assert np.abs(speed).max() <= 5e-15 * max(1.0, np.abs(wanted).max()) * np.sqrt(3)


@pytest.mark.parametrize("cell", ["orthorhombic", "triclinic"])
@pytest.mark.parametrize("name", ["bond", "star3", "ring4"])
def test_periodic_equals_unwrapped(cell, name):
    c = Clusters(CONNECTIONS[name], 9, seed=3)
    x, y = c.x_new.copy(), c.y.copy()
    assert positions(c.solver(), x, c.x_ref, c.flat).converged
    assert tangents(c.solver(), c.x_ref, y).converged
    matrix = CELLS[cell]
    rng = np.random.default_rng(4)
    jumps = rng.integers(-2, 3, size=(2, c.n_atoms, 3)) @ matrix
    wrapped, z = c.x_new + jumps[0], c.y.copy()
    lattice = lattice_of(matrix)
    assert positions(c.solver(), wrapped, c.x_ref + jumps[1], c.flat, lattice).converged
    assert tangents(c.solver(), c.x_ref + jumps[1], z, None, lattice).converged
    np.testing.assert_allclose(wrapped - jumps[0], x, atol=1e-13)
    np.testing.assert_allclose(z, y, atol=1e-13)


def test_slab_is_periodic_in_two_directions():
    c = Clusters(CONNECTIONS["star2"], 5)
    cell = np.diag([9.0, 8.0, 1.0])
    lattice = lattice_of(cell)
    lattice[1, 2] = 0.0
    lattice[1, :, 2] = 0.0
    x, z = c.x_new.copy(), c.x_new.copy()
    assert positions(c.solver(), x, c.x_ref, c.flat).converged
    assert positions(c.solver(), z, c.x_ref, c.flat, lattice).converged
    np.testing.assert_allclose(z, x, atol=1e-14)


def test_pinned_atoms_stay():
    c = Clusters(CONNECTIONS["chain3"], 10, inv_mass=np.array([0.0, 0.5, 1.0, 0.0]))
    x, y = c.x_new.copy(), c.y.copy()
    x[c.atoms[:, [0, 3]]] = c.x_ref[c.atoms[:, [0, 3]]]
    y[c.atoms[:, [0, 3]]] = 0.0
    assert positions(c.solver(), x, c.x_ref, c.flat).converged
    assert tangents(c.solver(), c.x_ref, y).converged
    np.testing.assert_array_equal(x[c.atoms[:, [0, 3]]], c.x_ref[c.atoms[:, [0, 3]]])
    np.testing.assert_array_equal(y[c.atoms[:, [0, 3]]], 0.0)
    assert np.abs(c.lengths_of(x) / c.lengths - 1).max() <= 1e-14


def test_far_from_the_origin():
    c = Clusters(CONNECTIONS["star3"], 9, offset=1e6)
    x = c.x_new.copy()
    assert positions(c.solver(), x, c.x_ref, c.flat).converged
    assert np.abs(c.lengths_of(x) - c.lengths).max() <= 2 * 2.3e-16 * 2 * 1.8e6


@pytest.mark.parametrize("damage", ["far", "nan", "flat reference", "flipped"])
@pytest.mark.parametrize("name", ["bond", "star3", "tetrahedron"])
def test_failure_changes_nothing_and_names_the_cluster(damage, name):
    c = Clusters(CONNECTIONS[name], 21)
    broken = 18
    i, j = c.atoms[broken, :2]
    if damage == "far":
        c.x_new[i] += 50.0 * np.cross(c.x_ref[i] - c.x_ref[j], [0.3, 0.5, 0.8])
    elif damage == "nan":
        c.x_new[i, 1] = np.nan
    elif damage == "flipped":
        c.x_new[c.atoms[broken]] = -c.x_ref[c.atoms[broken]]
    else:
        c.x_ref[i] = c.x_ref[j]
    x, velocities = c.x_new.copy(), c.velocities.copy()
    outcome = positions(c.solver(), x, c.x_ref, c.flat, None, velocities, 500.0)
    assert not outcome.converged
    assert outcome.worst_row // len(c.pairs) == broken
    np.testing.assert_array_equal(x, c.x_new)
    np.testing.assert_array_equal(velocities, c.velocities)


@pytest.mark.parametrize("damage", ["nan", "coincident"])
def test_failed_tangents_change_nothing(damage):
    c = Clusters(CONNECTIONS["star2"], 21)
    i, j = c.atoms[20, :2]
    if damage == "nan":
        c.y[i, 2] = np.nan
    else:
        c.x_ref[i] = c.x_ref[j]
    y = c.y.copy()
    outcome = tangents(c.solver(), c.x_ref, y)
    assert not outcome.converged
    assert outcome.worst_row // 2 == 20
    np.testing.assert_array_equal(y, c.y)


def test_lengths_may_change_from_call_to_call():
    c = Clusters(CONNECTIONS["star2"], 12)
    stretched = c.flat * np.linspace(0.99, 1.02, c.rows.size)
    x = c.x_new.copy()
    assert positions(c.solver(), x, c.x_ref, stretched).converged
    np.testing.assert_allclose(c.lengths_of(x).reshape(-1), stretched, rtol=1e-14)


def test_too_large_a_cluster_is_refused():
    pairs = [(k, k + 1) for k in range(7)]
    with pytest.raises(ValueError, match="1 to 6"):
        SmallClusters(np.arange(7), np.arange(8)[None], pairs, np.ones((1, 7)), np.ones(8))
