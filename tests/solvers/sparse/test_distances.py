"""Sparse distance rows against a dense Newton iteration."""

import numpy as np
import pytest

from kcons.solvers.sparse.distances import SparseDistances
from tests.solvers.test_small_clusters import CELLS, dense_positions, dense_tangents, jacobian, lattice_of
from tests.systems.solver_calls import positions, tangents

GRAPHS = {
    "comb": [(k, k + 1) for k in range(6)] + [(k, 7 + k) for k in range(7)],
    "methylene": [e for k in range(5) for e in ((3 * k, 3 * k + 1), (3 * k, 3 * k + 2), (3 * k, 3 * k + 3))],
    "methane": [(0, 1), (2, 0), (0, 3), (0, 4), (4, 5), (4, 6), (4, 7)],
    "ring": [(k, (k + 1) % 9) for k in range(9)] + [(0, 9), (10, 4)],
    "fused": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (3, 6), (6, 7), (7, 8), (8, 2), (1, 9)],
}


class Molecules:
    """Molecules of one shape with shuffled atoms among bystanders."""

    def __init__(self, name, n_molecules=3, seed=0, offset=0.0):
        rng = np.random.default_rng(seed)
        local = np.array(GRAPHS[name])
        size = local.max() + 1
        self.n_atoms = n_molecules * size + 4
        self.atoms = rng.permutation(self.n_atoms)[: n_molecules * size].reshape(-1, size)
        self.pairs = np.concatenate([atoms[local] for atoms in self.atoms])
        self.x_ref = 1.5 * rng.normal(size=(self.n_atoms, 3)) + offset
        self.x_new = self.x_ref + 0.01 * rng.normal(size=self.x_ref.shape)
        self.y, self.velocities = rng.normal(size=(2, self.n_atoms, 3))
        self.inv_mass = 1 / rng.uniform(1, 16, self.n_atoms)
        self.lengths = self.lengths_of(self.x_ref)
        self.rows = np.arange(len(self.pairs))

    def lengths_of(self, x):
        return np.linalg.norm(x[self.pairs[:, 0]] - x[self.pairs[:, 1]], axis=1)

    def solver(self):
        return SparseDistances(self.rows, self.pairs, self.lengths, self.inv_mass)

    def positions(self, x, reference=None, lattice=None, velocities=None, multipliers=None):
        solver = self.solver()
        reference = self.x_ref if reference is None else reference
        lengths = np.ascontiguousarray(self.lengths[solver.rows])
        return solver, positions(solver, x, reference, lengths, lattice, velocities, 500.0, multipliers)

    def tangents(self, x, y, rates=None, lattice=None, multipliers=None):
        solver = self.solver()
        return solver, tangents(solver, x, y, None if rates is None else rates[solver.rows], lattice, multipliers)


@pytest.mark.parametrize("name", GRAPHS)
def test_matches_dense_newton(name):
    c = Molecules(name)
    x, velocities, found = c.x_new.copy(), c.velocities.copy(), np.full(len(c.rows), np.nan)
    solver, outcome = c.positions(x, velocities=velocities, multipliers=found)
    assert outcome.converged
    assert outcome.residual <= 4e-15
    expected, multipliers = dense_positions(c.x_new, c.x_ref, c.pairs, c.lengths, c.inv_mass)
    np.testing.assert_allclose(x, expected, atol=1e-11)
    np.testing.assert_allclose(found, multipliers[solver.rows], atol=1e-10)
    np.testing.assert_allclose(velocities, c.velocities + 500 * (expected - c.x_new), atol=1e-8)
    bystanders = np.setdiff1d(np.arange(c.n_atoms), c.atoms)
    np.testing.assert_array_equal(x[bystanders], c.x_new[bystanders])
    assert np.abs(c.lengths_of(x) / c.lengths - 1).max() <= 1e-14


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("driven", [False, True])
def test_tangents_match_dense_solve(name, driven):
    c = Molecules(name, seed=1)
    rates = np.random.default_rng(2).normal(size=len(c.rows)) if driven else None
    y, found = c.y.copy(), np.full(len(c.rows), np.nan)
    solver, outcome = c.tangents(c.x_ref, y, rates, multipliers=found)
    assert outcome.converged
    wanted = rates if driven else np.zeros(len(c.rows))
    expected, multipliers = dense_tangents(c.x_ref, c.y, c.pairs, wanted, c.inv_mass)
    np.testing.assert_allclose(y, expected, atol=1e-11)
    np.testing.assert_allclose(found, multipliers[solver.rows], atol=1e-10)
    assert np.abs(jacobian(c.x_ref, c.pairs) @ y.ravel() - wanted).max() <= 2e-14


@pytest.mark.parametrize("cell", ["orthorhombic", "triclinic"])
@pytest.mark.parametrize("name", ["comb", "fused"])
def test_periodic_equals_unwrapped(cell, name):
    c = Molecules(name, seed=3)
    matrix = 2 * CELLS[cell]
    x, y = c.x_new.copy(), c.y.copy()
    assert c.positions(x)[1].converged
    assert c.tangents(c.x_ref, y)[1].converged
    jumps = np.random.default_rng(4).integers(-2, 3, size=(2, c.n_atoms, 3)) @ matrix
    wrapped, z, lattice = c.x_new + jumps[0], c.y.copy(), lattice_of(matrix)
    assert c.positions(wrapped, c.x_ref + jumps[1], lattice)[1].converged
    assert c.tangents(c.x_ref + jumps[1], z, None, lattice)[1].converged
    np.testing.assert_allclose(wrapped - jumps[0], x, atol=1e-12)
    np.testing.assert_allclose(z, y, atol=1e-12)


def test_pinned_atoms_stay_and_part_clusters():
    c = Molecules("comb", seed=5)
    pinned = c.atoms[:, 3]
    c.inv_mass[pinned] = 0.0
    x, y = c.x_new.copy(), c.y.copy()
    x[pinned], y[pinned] = c.x_ref[pinned], 0.0
    assert c.positions(x)[1].converged
    assert c.tangents(c.x_ref, y)[1].converged
    np.testing.assert_array_equal(x[pinned], c.x_ref[pinned])
    np.testing.assert_array_equal(y[pinned], 0.0)
    assert np.abs(c.lengths_of(x) / c.lengths - 1).max() <= 1e-14
    assert np.abs(jacobian(c.x_ref, c.pairs) @ y.ravel()).max() <= 2e-14


@pytest.mark.parametrize("damage", ["nan", "flat reference", "flipped", "impossible"])
def test_failure_changes_nothing_and_names_the_cluster(damage):
    c = Molecules("methane", 5, seed=6)
    broken = c.atoms[3]
    if damage == "nan":
        c.x_new[broken[4], 1] = np.nan
    elif damage == "flat reference":
        c.x_ref[broken[0]] = c.x_ref[broken[1]]
    elif damage == "flipped":
        c.x_new[broken] = -c.x_ref[broken]
    else:
        c.lengths[3 * 7] = np.nan
    x, velocities = c.x_new.copy(), c.velocities.copy()
    solver, outcome = c.positions(x, velocities=velocities)
    assert not outcome.converged
    assert c.rows[solver.rows[outcome.worst_row]] // 7 == 3
    np.testing.assert_array_equal(x, c.x_new)
    np.testing.assert_array_equal(velocities, c.velocities)
    # What a failure leaves in the work arrays must not reach the next call.
    good = Molecules("methane", 5, seed=6)
    again = good.x_new.copy()
    lengths = np.ascontiguousarray(good.lengths[solver.rows])
    assert positions(solver, again, good.x_ref, lengths, None, None, 0.0, None).converged
    assert np.abs(good.lengths_of(again) / good.lengths - 1).max() <= 1e-14


@pytest.mark.parametrize("damage", ["nan", "coincident"])
def test_failed_tangents_change_nothing(damage):
    c = Molecules("ring", seed=7)
    if damage == "nan":
        c.y[c.atoms[2, 5], 2] = np.nan
    else:
        c.x_ref[c.atoms[2, 1]] = c.x_ref[c.atoms[2, 2]]
    y = c.y.copy()
    solver, outcome = c.tangents(c.x_ref, y)
    assert not outcome.converged
    assert solver.rows[outcome.worst_row] // len(GRAPHS["ring"]) == 2
    np.testing.assert_array_equal(y, c.y)


def test_dependent_rows_are_dropped():
    """Five points in space joined in all ten ways: nine rows are independent."""
    pairs = np.array([(i, j) for i in range(5) for j in range(i)])
    rng = np.random.default_rng(8)
    x_ref = rng.normal(size=(5, 3))
    lengths = np.linalg.norm(x_ref[pairs[:, 0]] - x_ref[pairs[:, 1]], axis=1)
    solver = SparseDistances(np.arange(10), pairs, lengths, np.ones(5))
    assert solver.rank(x_ref, None) == 9
    x = x_ref + 0.01 * rng.normal(size=x_ref.shape)
    assert positions(solver, x, x_ref, lengths[solver.rows], None, None, 0.0, None).converged
    np.testing.assert_allclose(np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1), lengths, rtol=1e-13)
    y = rng.normal(size=x_ref.shape)
    assert tangents(solver, x_ref, y, None, None, None).converged
    assert np.abs(jacobian(x_ref, pairs) @ y.ravel()).max() <= 1e-13


def test_far_from_the_origin():
    c = Molecules("methylene", offset=1e6)
    x = c.x_new.copy()
    assert c.positions(x)[1].converged
    assert np.abs(c.lengths_of(x) - c.lengths).max() <= 2 * 2.3e-16 * 2 * 1.8e6
