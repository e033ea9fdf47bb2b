"""Rigid triangles against a dense Newton iteration."""

import numpy as np
import pytest

from kcons.solvers.rigid_triangles import PAIRS, RigidTriangles
from tests.systems.solver_calls import positions, tangents

I, J = np.array(PAIRS).T


def jacobian(x):
    rows = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate(PAIRS):
        u = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j])
        rows[k, i], rows[k, j] = u, -u
    return rows.reshape(3, 9)


def dense_positions(x_new, x_ref, lengths, inv_mass):
    pull = np.repeat(inv_mass, 3)[:, None] * jacobian(x_ref).T
    multipliers, x = np.zeros(3), x_new.copy()
    for _ in range(20):
        sigma = np.linalg.norm(x[I] - x[J], axis=1) - lengths
        multipliers -= np.linalg.solve(jacobian(x) @ pull, sigma)
        x = x_new + (pull @ multipliers).reshape(3, 3)
    return x, multipliers


class Water:
    """Molecules of shuffled atoms, moved thermally for 2 fs, and five bystanders."""

    def __init__(self, n, seed=0, inv_mass=(1 / 15.9994, 1 / 1.008, 1 / 1.008), offset=0.0):
        rng = np.random.default_rng(seed)
        self.n_atoms = 3 * n + 5
        self.atoms = rng.permutation(self.n_atoms)[: 3 * n].reshape(n, 3)
        bond, angle = 0.9572, np.deg2rad(104.52)
        shape = bond * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]])
        turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
        self.x_ref = rng.normal(size=(self.n_atoms, 3))
        centres = rng.uniform(0, 20, size=(n, 1, 3)) + offset
        self.x_ref[self.atoms] = np.einsum("nij,aj->nai", turns, shape) + centres
        self.lengths = np.tile(np.linalg.norm(shape[I] - shape[J], axis=1), n)
        self.inv_mass = np.array(inv_mass)
        self.x_new = self.x_ref + 0.03 * rng.normal(size=self.x_ref.shape)
        self.y = rng.normal(size=self.x_ref.shape)
        self.velocities = rng.normal(size=self.x_ref.shape)
        self.rows = rng.permutation(3 * n).reshape(n, 3)
        self.solver = RigidTriangles(self.rows, self.atoms, self.lengths.reshape(n, 3), self.inv_mass)

    def bonds(self, x):
        return (x[self.atoms[:, I]] - x[self.atoms[:, J]]).reshape(-1, 3)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 64])
def test_matches_dense_newton(n):
    w = Water(n)
    x, velocities = w.x_new.copy(), w.velocities.copy()
    multipliers = np.full(3 * n, np.nan)
    outcome = positions(w.solver, x, w.x_ref, w.lengths, None, velocities, 500.0, multipliers)
    assert outcome.converged
    assert 0 <= outcome.worst_row < 3 * n
    expected = w.x_new.copy()
    for k, atoms in enumerate(w.atoms):
        lengths = w.lengths[3 * k : 3 * k + 3]
        expected[atoms], m = dense_positions(w.x_new[atoms], w.x_ref[atoms], lengths, w.inv_mass)
        np.testing.assert_allclose(multipliers[3 * k : 3 * k + 3], m, atol=1e-13)
    np.testing.assert_allclose(x, expected, atol=1e-13)
    np.testing.assert_allclose(velocities, w.velocities + 500 * (expected - w.x_new), atol=1e-10)
    assert np.abs(np.linalg.norm(w.bonds(x), axis=1) / w.lengths - 1).max() <= 2e-14
    np.testing.assert_array_equal(w.solver.rows, w.rows.reshape(-1))


@pytest.mark.parametrize("driven", [False, True])
def test_tangents_match_dense_solve(driven):
    w = Water(13)
    rates = np.random.default_rng(5).normal(size=39) if driven else None
    y, multipliers = w.y.copy(), np.full(39, np.nan)
    assert tangents(w.solver, w.x_ref, y, rates, None, multipliers).converged
    for k, atoms in enumerate(w.atoms):
        a = jacobian(w.x_ref[atoms])
        wanted = rates[3 * k : 3 * k + 3] if driven else np.zeros(3)
        pull = np.repeat(w.inv_mass, 3)[:, None] * a.T
        m = np.linalg.solve(a @ pull, a @ w.y[atoms].reshape(-1) - wanted)
        np.testing.assert_allclose(multipliers[3 * k : 3 * k + 3], m, atol=1e-12)
        np.testing.assert_allclose(y[atoms], w.y[atoms] - (pull @ m).reshape(3, 3), atol=1e-12)
        assert np.abs(a @ y[atoms].reshape(-1) - wanted).max() <= 5e-15 * np.sqrt(3)


@pytest.mark.parametrize(
    "cell",
    [np.diag([9.0, 8.0, 10.0]), np.array([[9.0, 0, 0], [2.0, 8.0, 0], [-1.5, 2.5, 10.0]])],
    ids=["orthorhombic", "triclinic"],
)
def test_periodic_equals_unwrapped(cell):
    w = Water(11)
    x, y, z = w.x_new.copy(), w.y.copy(), w.y.copy()
    assert positions(w.solver, x, w.x_ref, w.lengths).converged
    assert tangents(w.solver, w.x_ref, y).converged
    jumps = np.random.default_rng(4).integers(-2, 3, size=(2, w.n_atoms, 3)) @ cell
    lattice = np.array([cell, np.linalg.inv(cell)])
    wrapped = w.x_new + jumps[0]
    assert positions(w.solver, wrapped, w.x_ref + jumps[1], w.lengths, lattice).converged
    assert tangents(w.solver, w.x_ref + jumps[1], z, None, lattice).converged
    np.testing.assert_allclose(wrapped - jumps[0], x, atol=1e-13)
    np.testing.assert_allclose(z, y, atol=1e-13)


def test_pinned_atom_stays():
    w = Water(10, inv_mass=(0.0, 1.0, 0.5))
    pinned = w.atoms[:, 0]
    w.x_new[pinned] = w.x_ref[pinned]
    x = w.x_new.copy()
    assert positions(w.solver, x, w.x_ref, w.lengths).converged
    np.testing.assert_array_equal(x[pinned], w.x_ref[pinned])
    assert np.abs(np.linalg.norm(w.bonds(x), axis=1) / w.lengths - 1).max() <= 2e-14


def test_far_from_the_origin():
    w = Water(10, offset=1e6)
    x, y = w.x_new.copy(), w.y.copy()
    assert positions(w.solver, x, w.x_ref, w.lengths).converged
    assert tangents(w.solver, w.x_ref, y).converged
    sigma = np.linalg.norm(w.bonds(x), axis=1) - w.lengths
    assert np.abs(sigma).max() <= 2 * 2.3e-16 * 2 * np.sqrt(3) * 1e6


@pytest.mark.parametrize("damage", ["far", "nan", "coincident", "turned"])
def test_failure_changes_nothing_and_names_the_triangle(damage):
    w = Water(29)
    atoms = w.atoms[26]
    if damage == "far":
        w.x_new[atoms[1]] += 40.0
    elif damage == "nan":
        w.x_new[atoms[2], 0] = np.nan
    elif damage == "coincident":
        w.x_ref[atoms[1]] = w.x_ref[atoms[0]]
    else:
        w.x_new[atoms] = -w.x_ref[atoms]
    x, velocities = w.x_new.copy(), w.velocities.copy()
    outcome = positions(w.solver, x, w.x_ref, w.lengths, None, velocities, 500.0)
    assert not outcome.converged
    assert outcome.worst_row // 3 == 26
    np.testing.assert_array_equal(x, w.x_new)
    np.testing.assert_array_equal(velocities, w.velocities)


def test_newton_and_a_chord_step_gain_together():
    """Of order three, a factor for both: from three hundredths of a length to rounding in five steps."""
    for seed in range(3):
        w = Water(64, seed)
        outcome = positions(w.solver, w.x_new.copy(), w.x_ref, w.lengths)
        assert outcome.converged
        assert outcome.iterations <= 6


def test_a_third_side_that_turned_round_is_no_solution():
    """The ends of a narrow triangle change places: all lengths are right, and two of the sides hardly turn."""
    w = Water(9)
    narrow = np.array([[0.0, 0, 0], [1.0, 0.3, 0], [1.0, -0.3, 0]])
    w.x_ref[w.atoms] = narrow
    w.lengths[:] = np.tile(np.linalg.norm(narrow[I] - narrow[J], axis=1), 9)
    w.x_new[:] = w.x_ref
    assert positions(w.solver, w.x_new.copy(), w.x_ref, w.lengths).converged
    _, b, c = w.atoms[4]
    w.x_new[[b, c]] = w.x_new[[c, b]]
    x = w.x_new.copy()
    outcome = positions(w.solver, x, w.x_ref, w.lengths)
    assert not outcome.converged
    assert outcome.worst_row == 3 * 4 + PAIRS.index((1, 2))
    np.testing.assert_array_equal(x, w.x_new)


@pytest.mark.parametrize("damage", ["nan", "coincident", "collinear"])
def test_failed_tangents_change_nothing(damage):
    w = Water(29)
    a, b, c = w.atoms[28]
    if damage == "nan":
        w.y[b, 0] = np.nan
    elif damage == "coincident":
        w.x_ref[b] = w.x_ref[a]
    else:
        w.x_ref[[a, b, c]] = [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]
    y = w.y.copy()
    outcome = tangents(w.solver, w.x_ref, y)
    assert not outcome.converged
    assert outcome.worst_row // 3 == 28
    np.testing.assert_array_equal(y, w.y)


def test_infeasible_triangle_is_refused():
    w = Water(8)
    lengths = w.lengths.copy()
    lengths[9:12] = 1.0, 1.0, 3.0
    outcome = positions(w.solver, w.x_new.copy(), w.x_ref, lengths)
    assert not outcome.converged
    assert outcome.worst_row // 3 == 3
