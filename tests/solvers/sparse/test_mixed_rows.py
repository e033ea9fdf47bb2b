"""Mixed rows against a dense Newton iteration with the constraint classes."""

import numpy as np
import pytest

from kcons.constraints import Angle, Cylinder, Dihedral, Distance, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.solvers.cluster_solver import Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.sparse.mixed_rows import SparseRows, miss

CONSTRAINTS = [
    Distance([[0, 1], [1, 2], [2, 3], [3, 4], [6, 7]]),
    Angle([[0, 1, 2], [2, 3, 4]]),
    Dihedral([[0, 1, 2, 3], [1, 2, 3, 4]]),
    Plane([4], [0.0, 0.6, 0.8]),
    Sphere([6], [5.0, 5.0, 5.0]),
    Cylinder([7], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]),
]


class Rows:
    def __init__(self, cell=None, seed=0):
        rng = np.random.default_rng(seed)
        self.x_ref = 1.5 * rng.normal(size=(10, 3))
        self.masses = rng.uniform(1, 16, 10)
        self.set = ConstraintSet(CONSTRAINTS, self.x_ref, self.masses, cell=cell)
        self.inv_mass = 1 / self.masses
        self.x_new = self.x_ref + 0.01 * rng.normal(size=(10, 3))
        self.y, self.velocities = rng.normal(size=(2, 10, 3))
        self.lattice = None if cell is None else self.set.lattice

    def solver(self):
        return SparseRows(self.set, np.arange(self.set.n_rows), self.inv_mass)


@pytest.mark.parametrize("damage", ["nan", "flipped", "coincident"])
def test_failure_changes_nothing(damage):
    c = Rows(seed=5)
    if damage == "nan":
        c.x_new[7, 2] = np.nan
    elif damage == "flipped":
        c.x_new[:5] = -c.x_ref[:5]
    else:
        c.x_ref[6] = c.x_ref[7]
    x, velocities = c.x_new.copy(), c.velocities.copy()
    solver = c.solver()
    outcome = solver.positions(Request(x, c.x_ref, velocities=velocities, inv_dt=500.0))
    assert not outcome.converged
    row = solver.rows[outcome.worst_row]
    assert (set(c.set.row_atoms(int(row))) <= {6, 7}) == (damage != "flipped")
    np.testing.assert_array_equal(x, c.x_new)
    np.testing.assert_array_equal(velocities, c.velocities)
    c.y[3, 1] = np.nan
    y = c.y.copy()
    assert not solver.tangents(Request(y, c.x_ref)).converged
    np.testing.assert_array_equal(y, c.y)


def test_a_molecule_turned_through_a_point_is_no_solution_though_its_rows_hold():
    """Lengths and angles are those of the mirror image: only gradients say that the step was half a turn."""
    c = Rows(seed=5)
    held = ConstraintSet(CONSTRAINTS[:2], c.x_ref, c.masses)
    solver = SparseRows(held, np.arange(held.n_rows), c.inv_mass)
    x = -c.x_ref
    assert np.all(np.abs(held.value(x)) <= held.tolerance(x))
    outcome = solver.positions(Request(x, c.x_ref))
    assert not outcome.converged
    np.testing.assert_array_equal(x, -c.x_ref)


def test_dependent_rows_are_dropped():
    """Three sides of a triangle leave nothing for its angle; of many, rounding leaves something to most."""
    rng, n = np.random.default_rng(7), 12
    x, masses = rng.normal(size=(3 * n, 3)), rng.uniform(1, 16, 3 * n)
    corners = np.arange(3 * n).reshape(n, 3)
    sides = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    given = ConstraintSet([Distance(sides), Angle(corners)], x, masses)
    solver = SparseRows(given, np.arange(4 * n), 1 / masses)
    assert solver.rank(x, None) == 3 * n
    y = rng.normal(size=x.shape)
    assert solver.tangents(Request(y, x)).converged
    # As far as the worst of these triangles is from a line.
    rows = given.jacobian(x).toarray() / np.sqrt(np.repeat(masses, 3))
    s = np.linalg.svd(rows / np.linalg.norm(rows, axis=1)[:, None], compute_uv=False)
    assert np.abs(given.jacobian(x) @ y.ravel()).max() <= 1e-14 * s[0] / s[3 * n - 1]


@pytest.mark.parametrize(("apart", "converged"), [(0.0, True), (3e-14, True), (1e-12, False)])
def test_dependent_rows_may_miss_by_some_roundings(apart, converged):
    """The last of three rows of one angle wants another value by this much; more than the sum of roundings fails."""
    x = np.array([[1.0, 0.1, 0.0], [0.0, 0.0, 0.0], [0.2, 0.9, 0.3]])
    angle = Angle([[0, 1, 2]])
    target = float(ConstraintSet(angle, x, np.ones(3)).target(0.0)[0])
    rows = [Distance([[0, 1]]), Angle([[0, 1, 2]], target), Angle([[2, 1, 0]], target * (1 + apart))]
    whole = ConstraintSet(rows, x, np.ones(3))
    eliminate_last = np.array([False, False, True])
    moved = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    before = moved.copy()
    outcome = SparseRows(whole, np.arange(3), np.ones(3), eliminate_last).positions(Request(moved, x))
    assert outcome.converged == converged
    if converged:
        assert np.all(np.abs(whole.value(moved)) <= 4 * np.sqrt(3) * whole.tolerance(moved))
    else:
        np.testing.assert_array_equal(moved, before)


@pytest.mark.parametrize("seed", [12, 22, 166, 1459])
def test_a_dihedral_that_turns_over_has_no_solution_far_away(seed):
    """Bent to the other side it is off by pi; hundreds of displacements away it is flat, and would be right again."""
    rng = np.random.default_rng(seed)
    legs = rng.normal(size=(3, 3)) * 10 ** rng.uniform(-1.5, 0.3, (3, 1))
    side = np.cross(legs[1], rng.normal(size=3))
    side *= 0.01 * np.linalg.norm(legs[2]) / np.linalg.norm(side)
    legs[2] = legs[1] + side
    x = np.vstack([np.zeros(3), np.cumsum(legs, axis=0)])
    x_new = x.copy()
    x_new[3] -= 2 * side
    inv_mass = 10 ** rng.uniform(0, 1, 4)
    held = ConstraintSet([Distance([[0, 1]]), Dihedral([[0, 1, 2, 3]])], x, 1 / inv_mass)
    rows = np.arange(2)
    for solver in (SparseRows(held, rows, inv_mass), GeneralClusters(held, rows, 0 * rows, inv_mass)):
        changed = x_new.copy()
        assert not solver.positions(Request(changed, x)).converged
        assert np.array_equal(changed, x_new)


def test_rows_with_a_period_miss_by_the_shorter_way():
    turn = 2 * np.pi
    assert miss(3.1, -3.1, turn) == pytest.approx(2 * np.pi - 6.2)
    # More than a quarter of a turn is nothing to go round for.
    assert miss(-1.0, 1.9, turn) == pytest.approx(2.9)
    assert miss(1.0, -1.9, turn) == pytest.approx(-2.9)
    assert miss(-1.0, 2.4, turn) == pytest.approx(3.4 - 2 * np.pi)
    assert miss(3.1, 0.1, 0.0) == pytest.approx(-3.0)
