"""Open chains against a dense Newton iteration, and long ones by their residuals."""

import numpy as np
import pytest

from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.chains.strips import SHORT
from tests.systems.solver_calls import positions, tangents


def steps(shape, n, rng):
    """Unit bonds of a chain."""
    angle = {"straight": 0.0, "zigzag": 34.5, "bent": 2.5}.get(shape)
    if angle is None:
        bonds = rng.normal(size=(n, 3))
        return bonds / np.linalg.norm(bonds, axis=1)[:, None]
    bonds = np.zeros((n, 3))
    bonds[:, 0] = np.cos(np.deg2rad(angle))
    bonds[:, 1] = np.sin(np.deg2rad(angle)) * (-1) ** np.arange(n)
    return bonds


def jacobian(x):
    n = len(x) - 1
    rows = np.zeros((n, n + 1, 3))
    for k in range(n):
        u = (x[k] - x[k + 1]) / np.linalg.norm(x[k] - x[k + 1])
        rows[k, k], rows[k, k + 1] = u, -u
    return rows.reshape(n, -1)


def dense_positions(x_new, x_ref, lengths, inv_mass):
    pull = np.repeat(inv_mass, 3)[:, None] * jacobian(x_ref).T
    multipliers, x = np.zeros(len(lengths)), x_new.copy()
    for _ in range(20):
        sigma = np.linalg.norm(x[:-1] - x[1:], axis=1) - lengths
        multipliers -= np.linalg.solve(jacobian(x) @ pull, sigma)
        x = x_new + (pull @ multipliers).reshape(-1, 3)
    return x, multipliers


class Bundle:
    """Chains of shuffled atoms with mixed masses, and five bystanders."""

    def __init__(self, sizes, shape="free", seed=0, offset=0.0):
        rng = np.random.default_rng(seed)
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        n = self.offsets[-1]
        self.n_atoms = n + 5
        self.atoms = rng.permutation(self.n_atoms)[:n]
        self.inv_mass = 1 / rng.uniform(1, 16, n)
        self.x_ref = rng.normal(size=(self.n_atoms, 3))
        self.lengths = rng.uniform(1.0, 1.6, n - len(sizes))
        self.spans = []
        for c, size in enumerate(sizes):
            atoms = self.atoms[self.offsets[c] : self.offsets[c + 1]]
            rows = slice(self.offsets[c] - c, self.offsets[c + 1] - c - 1)
            bonds = steps(shape, size - 1, rng) * self.lengths[rows, None]
            self.x_ref[atoms] = np.vstack([np.zeros(3), np.cumsum(bonds, axis=0)]) + offset
            self.spans.append((atoms, rows, slice(self.offsets[c], self.offsets[c + 1])))
        self.x_new = self.x_ref + 0.03 * rng.normal(size=self.x_ref.shape)
        self.y = rng.normal(size=self.x_ref.shape)
        self.velocities = rng.normal(size=self.x_ref.shape)

    def solver(self):
        rows = np.arange(len(self.lengths))[::-1]
        return Chains(rows, self.offsets, self.atoms, self.lengths, self.inv_mass)

    def sigma(self, x):
        return np.concatenate(
            [np.linalg.norm(np.diff(x[a], axis=0), axis=1) - self.lengths[r] for a, r, _ in self.spans]
        )


BUNDLES = {
    "one bond": [2],
    "short": [3, 7, 5],
    "nine short": [2, 9, 4, 4, 31, 12, 3, 3, 17],
    "limit": [SHORT, SHORT + 1],
    "no multiple": [37, 45, 100],
    "mixed": [64, 5, 72, 2, 33],
}


@pytest.mark.parametrize("shape", ["free", "zigzag", "straight"])
@pytest.mark.parametrize("name", BUNDLES)
def test_matches_dense_newton(name, shape):
    b = Bundle(BUNDLES[name], shape)
    solver = b.solver()
    x, velocities = b.x_new.copy(), b.velocities.copy()
    multipliers = np.full(len(b.lengths), np.nan)
    outcome = positions(solver, x, b.x_ref, b.lengths, None, velocities, 500.0, multipliers)
    assert outcome.converged
    assert outcome.residual <= 4e-15
    assert 0 <= outcome.worst_row < len(b.lengths)
    expected = b.x_new.copy()
    for atoms, rows, place in b.spans:
        expected[atoms], m = dense_positions(b.x_new[atoms], b.x_ref[atoms], b.lengths[rows], b.inv_mass[place])
        np.testing.assert_allclose(multipliers[rows], m, atol=1e-10)
    np.testing.assert_allclose(x, expected, atol=1e-11)
    np.testing.assert_allclose(velocities, b.velocities + 500 * (expected - b.x_new), atol=1e-8)
    size = np.abs(x[b.atoms]).max()
    assert np.abs(b.sigma(x)).max() <= max(1e-14, 4 * 2.3e-16 * size * np.sqrt(3))
    bystanders = np.setdiff1d(np.arange(b.n_atoms), b.atoms)
    np.testing.assert_array_equal(x[bystanders], b.x_new[bystanders])


@pytest.mark.parametrize("shape", ["free", "straight"])
@pytest.mark.parametrize("driven", [False, True])
@pytest.mark.parametrize("name", BUNDLES)
def test_tangents_match_dense_solve(name, driven, shape):
    b = Bundle(BUNDLES[name], shape, seed=1)
    rates = np.random.default_rng(2).normal(size=len(b.lengths)) if driven else None
    y, multipliers = b.y.copy(), np.full(len(b.lengths), np.nan)
    assert tangents(b.solver(), b.x_ref, y, rates, None, multipliers).converged
    for atoms, rows, place in b.spans:
        a = jacobian(b.x_ref[atoms])
        pull = np.repeat(b.inv_mass[place], 3)[:, None] * a.T
        wanted = rates[rows] if driven else np.zeros(len(a))
        m = np.linalg.solve(a @ pull, a @ b.y[atoms].reshape(-1) - wanted)
        np.testing.assert_allclose(multipliers[rows], m, atol=1e-9)
        np.testing.assert_allclose(y[atoms], b.y[atoms] - (pull @ m).reshape(-1, 3), atol=1e-10)
        assert np.abs(a @ y[atoms].reshape(-1) - wanted).max() <= 5e-15 * np.sqrt(3)


@pytest.mark.parametrize(
    "cell",
    [np.diag([9.0, 8.0, 10.0]), np.array([[9.0, 0, 0], [2.0, 8.0, 0], [-1.5, 2.5, 10.0]])],
    ids=["orthorhombic", "triclinic"],
)
def test_periodic_equals_unwrapped(cell):
    b = Bundle(BUNDLES["mixed"])
    x, y, z = b.x_new.copy(), b.y.copy(), b.y.copy()
    assert positions(b.solver(), x, b.x_ref, b.lengths).converged
    assert tangents(b.solver(), b.x_ref, y).converged
    jumps = np.random.default_rng(4).integers(-2, 3, size=(2, b.n_atoms, 3)) @ cell
    lattice = np.array([cell, np.linalg.inv(cell)])
    wrapped = b.x_new + jumps[0]
    assert positions(b.solver(), wrapped, b.x_ref + jumps[1], b.lengths, lattice).converged
    assert tangents(b.solver(), b.x_ref + jumps[1], z, None, lattice).converged
    np.testing.assert_allclose(wrapped - jumps[0], x, atol=1e-12)
    np.testing.assert_allclose(z, y, atol=1e-12)


@pytest.mark.parametrize("size", [12, 50])
def test_pinned_atoms_stay(size):
    b = Bundle([size])
    pinned = [0, 5, 6, size - 1]
    b.inv_mass[pinned] = 0.0
    held = b.atoms[pinned]
    b.x_new[held] = b.x_ref[held]
    b.y[held] = 0.0
    x, y = b.x_new.copy(), b.y.copy()
    assert positions(b.solver(), x, b.x_ref, b.lengths).converged
    assert tangents(b.solver(), b.x_ref, y).converged
    np.testing.assert_array_equal(x[held], b.x_ref[held])
    np.testing.assert_array_equal(y[held], 0.0)
    assert np.abs(b.sigma(x)).max() <= 1e-13


@pytest.mark.parametrize("shape", ["free", "zigzag", "bent", "straight"])
def test_ten_thousand_bonds(shape):
    b = Bundle([10_001], shape)
    b.inv_mass[:] = 1 / 14
    # A long chain that is nearly straight resists all but tangent displacements.
    velocities, y = b.y.copy(), b.y.copy()
    assert tangents(b.solver(), b.x_ref, velocities).converged
    x = b.x_ref + 0.01 * velocities
    outcome = positions(b.solver(), x, b.x_ref, b.lengths)
    assert outcome.converged
    assert outcome.residual <= 4e-15
    assert tangents(b.solver(), b.x_ref, y).converged
    path = x[b.atoms]
    reach = np.abs(path[1:]).sum(axis=1) + np.abs(path[:-1]).sum(axis=1)
    assert (np.abs(b.sigma(x)) <= np.maximum(1e-14, 2 * 2.3e-16 * reach)).all()
    bonds = np.diff(b.x_ref[b.atoms], axis=0)
    speed = (bonds * np.diff(y[b.atoms], axis=0)).sum(axis=1) / np.linalg.norm(bonds, axis=1)
    assert np.abs(speed).max() <= 5e-15 * np.sqrt(3)


def test_far_from_the_origin():
    b = Bundle([50, 8], offset=1e6)
    x = b.x_new.copy()
    assert positions(b.solver(), x, b.x_ref, b.lengths + np.zeros(1)).converged
    assert np.abs(b.sigma(x)).max() <= 4 * 2.3e-16 * np.sqrt(3) * 1e6


@pytest.mark.parametrize("damage", ["far", "nan", "coincident"])
@pytest.mark.parametrize("broken", [0, 1, 2, 3])
def test_failure_changes_nothing_and_names_the_row(damage, broken):
    b = Bundle([80, 6, 40, 9])
    atoms, rows, _ = b.spans[broken]
    if damage == "far":
        b.x_new[atoms[3]] += 60.0
    elif damage == "nan":
        b.x_new[atoms[3], 1] = np.nan
    else:
        b.x_ref[atoms[3]] = b.x_ref[atoms[4]]
    x, velocities = b.x_new.copy(), b.velocities.copy()
    outcome = positions(b.solver(), x, b.x_ref, b.lengths, None, velocities, 500.0)
    assert not outcome.converged
    assert rows.start <= outcome.worst_row < rows.stop
    if damage != "far":
        assert outcome.worst_row - rows.start in (2, 3)
    np.testing.assert_array_equal(x, b.x_new)
    np.testing.assert_array_equal(velocities, b.velocities)


@pytest.mark.parametrize("damage", ["nan", "coincident"])
@pytest.mark.parametrize("broken", [0, 1, 2, 3])
def test_failed_tangents_change_nothing(damage, broken):
    b = Bundle([80, 6, 40, 9])
    atoms, rows, _ = b.spans[broken]
    if damage == "nan":
        b.y[atoms[4], 1] = np.nan
    else:
        b.x_ref[atoms[3]] = b.x_ref[atoms[4]]
    y = b.y.copy()
    outcome = tangents(b.solver(), b.x_ref, y)
    assert not outcome.converged
    assert outcome.worst_row - rows.start in (3, 4)
    np.testing.assert_array_equal(y, b.y)


def test_a_chain_needs_a_bond():
    with pytest.raises(ValueError, match="at least two"):
        Chains([0], [0, 2, 3], [0, 1, 2], [1.0], [1.0, 1.0, 1.0])
