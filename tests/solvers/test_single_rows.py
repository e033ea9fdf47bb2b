"""Functions that share no atom, one after the other, against the dense solver."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import CASES, MASSES, TIME, scattered

from kcons import ConstraintSet, Motion
from kcons.constraints import Custom, Dihedral, RowKind, Sphere
from kcons.errors import ConvergenceError
from kcons.solvers.cluster_solver import Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.single_rows import SingleRows

FUNCTIONS = [name for name in CASES if CASES[name]().kind == RowKind.FUNCTION]


def both(item, x, cell=None, time=TIME):
    whole = ConstraintSet(item, x, MASSES, cell=cell, time=time)
    numbers = np.arange(whole.n_rows)
    return SingleRows(whole, numbers, 1 / MASSES), GeneralClusters(whole, numbers, numbers, 1 / MASSES), whole


@pytest.mark.parametrize("cell", [None, np.array([[40.0, 0, 0], [6, 36, 0], [-4, 8, 44]])], ids=["open", "triclinic"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_rows_agree_with_the_dense_solver(name, cell):
    item = CASES[name]()
    used = np.unique(item.atoms, return_counts=True)[1]
    item = item.select([0]) if used.max() > 1 else item
    x = scattered(1)
    if cell is not None and item.translation_invariant:
        x = x + np.random.default_rng(0).integers(-1, 2, (8, 3)) @ cell
    fast, dense, whole = both(item, x, cell)
    rng = np.random.default_rng(2)
    new, y, w = x + 0.02 * rng.normal(size=x.shape), *rng.normal(size=(2, *x.shape))
    wanted, rates = whole.target(TIME + 0.01), rng.normal(size=whole.n_rows)
    found = []
    for solver in (fast, dense):
        positions, velocities, tangents, lam = new.copy(), w.copy(), y.copy(), np.empty((2, whole.n_rows))
        request = Request(positions, x, wanted, whole.lattice, TIME + 0.01, TIME, velocities, 7.0)
        assert solver.positions(request, lam[0]).converged
        assert solver.tangents(Request(tangents, x, rates, whole.lattice, TIME), lam[1]).converged
        found.append((positions, velocities, tangents, lam))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-11 if "ithout" in name else 2e-12 if cell is not None else 2e-13)
    assert np.all(np.abs(whole.value(found[0][0], TIME + 0.01)) <= 2 * whole.tolerance(x, TIME + 0.01))


def test_failure_changes_nothing_and_names_the_row():
    x = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    whole = ConstraintSet(Sphere([0, 1, 2], [0.0, 0, 0]), x, np.ones(3))
    solver = SingleRows(whole, np.arange(3), np.ones(3))
    new, v = x.copy(), np.ones_like(x)
    new[1] = [3.0, -0.2, 0.0]  # out of reach along y
    kept = new.copy()
    outcome = solver.positions(Request(new, x, velocities=v, inv_dt=1.0))
    assert not outcome.converged and outcome.worst_row == 1
    assert np.array_equal(new, kept) and np.all(v == 1.0)
    v[2, 0] = np.inf
    kept = v.copy()
    outcome = solver.tangents(Request(v, x))
    assert not outcome.converged and outcome.worst_row == 2 and np.array_equal(v, kept)
    motion = Motion(whole, x)
    with pytest.raises(ConvergenceError, match=r"#1 Sphere\(1\)"):
        motion.project_positions(new, x)


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
