"""Rows that kernels call by address, alone and coupled: families, Numba's functions, Python's, and what these raise."""

from __future__ import annotations

import copy
import pickle
from itertools import product

import numba
import numpy as np
import pytest
from constraint_cases import CASES, MASSES, TIME, scattered

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Angle, Custom, Dihedral, Distance, Ellipsoid, Plane, RowKind, Sphere
from kcons.errors import InputError
from kcons.solvers.cluster_solver import Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.sparse.mixed_rows import SparseRows, miss
from kcons.solvers.sparse.row_functions import CalledRows

FUNCTIONS = [name for name in CASES if CASES[name]().kind == RowKind.FUNCTION]
VELOCITIES = [name for name in CASES if CASES[name]().kind == RowKind.VELOCITY]


@numba.njit
def bend(r):
    return (r[0, 0] - r[1, 0]) ** 2 + np.sin(r[0, 2])


@numba.njit
def bend_gradient(r):
    out = np.zeros((2, 3))
    out[0, 0] = 2 * (r[0, 0] - r[1, 0])
    out[1, 0] = -out[0, 0]
    out[0, 2] = np.cos(r[0, 2])
    return out


#: Bonds, angles and dihedrals of a chain, and surfaces beside them.
COUPLED = [
    Distance([[0, 1], [1, 2], [2, 3], [3, 4], [6, 7]]),
    Angle([[0, 1, 2], [2, 3, 4]]),
    Dihedral([[0, 1, 2, 3], [1, 2, 3, 4]]),
    Plane([4], [0.0, 0.6, 0.8]),
    Sphere([6], [5.0, 5.0, 5.0]),
    Ellipsoid([7], [0.0, 1.0, 0.0], [np.inf, 1.0, 1.0], target=None),
]
CELL = np.array([[40.0, 0, 0], [6, 36, 0], [-4, 8, 44]])


def both(rows, x, time=TIME, solver=SparseRows, cell=None, inverse_masses=1 / MASSES):
    """A solver of kernels and the dense one, which takes rows that share no atom apart."""
    whole = ConstraintSet(rows, x, MASSES, time=time, cell=cell)
    numbers = np.arange(whole.n_rows)
    labels = numbers if solver is SingleRows else 0 * numbers
    fast, dense = solver(whole, numbers, inverse_masses), GeneralClusters(whole, numbers, labels, inverse_masses)
    return fast, dense, whole


WHERE = ["near", "far", "triclinic"]
KERNELS = [*product([SparseRows, SingleRows], FUNCTIONS, WHERE)]
KERNELS += [(SparseRows, "coupled", where) for where in (*WHERE, "infinite mass")]


@pytest.mark.parametrize(("solver", "name", "where"), KERNELS)
def test_kernels_agree_with_the_dense_solver(solver, name, where):
    """In positions, velocities, tangents and multipliers, with targets and rates that are not those of the start."""
    rows = COUPLED if name == "coupled" else [CASES[name](), Distance([[6, 7]])]
    if solver is SingleRows:
        (item, _), one = rows, np.unique(rows[0].atoms, return_counts=True)[1].max() > 1
        rows = [item.select([0]) if one else item]
    anywhere, x = all(item.translation_invariant for item in rows), scattered(1)
    cell, far, inverse_masses = CELL if where == "triclinic" else None, where == "far" and anywhere, 1 / MASSES
    if cell is not None and anywhere:
        x = x + np.random.default_rng(0).integers(-1, 2, (8, 3)) @ cell
    x, rng = x + 50.0 * far, np.random.default_rng(2)
    new, y, w = x + 0.02 * rng.normal(size=x.shape), *rng.normal(size=(2, *x.shape))
    if where == "infinite mass":
        inverse_masses, new[2], y[2] = np.where(np.arange(8) == 2, 0.0, inverse_masses), x[2], 0.0
    fast, dense, whole = both(rows, x, TIME, solver, cell, inverse_masses)
    wanted, rates = whole.target(TIME + 0.01), rng.normal(size=whole.n_rows)
    found = []
    for each in (fast, dense):
        positions, velocities, tangents, multipliers = new.copy(), w.copy(), y.copy(), np.empty((2, whole.n_rows))
        moved = Request(positions, x, wanted, whole.lattice, TIME + 0.01, TIME, velocities, 7.0)
        assert each.positions(moved, multipliers[0]).converged
        assert each.tangents(Request(tangents, x, rates, whole.lattice, TIME), multipliers[1]).converged
        found.append((positions, velocities, tangents, multipliers[:, np.argsort(each.rows)]))
    digits = 2e-11 if "ithout" in name else 2e-12 if cell is not None else 1e-11 if far else 4e-13
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=digits)
    assert np.all(np.abs(whole.value(found[0][0], TIME + 0.01)) <= 2 * whole.tolerance(x, TIME + 0.01))


@pytest.mark.parametrize("damage", ["nan", "flipped", "coincident"])
def test_failure_changes_nothing(damage):
    x, rng = scattered(1), np.random.default_rng(5)
    solver, _, whole = both(COUPLED, x)
    new, v, y = x + 0.01 * rng.normal(size=x.shape), *rng.normal(size=(2, *x.shape))
    if damage == "nan":
        new[7, 2] = np.nan
    elif damage == "flipped":
        new[:5] = -x[:5]
    else:
        x[6] = x[7]
    kept, speeds = new.copy(), v.copy()
    outcome = solver.positions(Request(new, x, velocities=v, inv_dt=500.0))
    assert not outcome.converged
    named = set(whole.row_atoms(int(solver.rows[outcome.worst_row])))
    assert (named <= {6, 7}) == (damage != "flipped")
    np.testing.assert_array_equal(new, kept)
    np.testing.assert_array_equal(v, speeds)
    y[3, 1] = np.nan
    kept = y.copy()
    assert not solver.tangents(Request(y, x)).converged
    np.testing.assert_array_equal(y, kept)


def test_a_molecule_turned_through_a_point_is_no_solution_though_its_rows_hold():
    """Lengths and angles are those of the mirror image: only gradients say that the step was half a turn."""
    x = scattered(1)
    solver, _, whole = both(COUPLED[:2], x)
    turned = -x
    assert np.all(np.abs(whole.value(turned)) <= whole.tolerance(turned))
    assert not solver.positions(Request(turned, x)).converged
    np.testing.assert_array_equal(turned, -x)


def called(solver) -> bool:
    """Whether rows are functions of Python."""
    return any(isinstance(each, CalledRows) for each in solver._given.functions)


@pytest.mark.parametrize("flight", [0.0, 0.1, -0.1], ids=["no flight", "flight", "backwards"])
@pytest.mark.parametrize("name", VELOCITIES)
def test_rows_of_velocities_agree_with_the_dense_solver(name, flight):
    x, later = scattered(1), TIME + flight
    fast, dense, whole = both([CASES[name](), Distance([[6, 7]])], x)
    rng = np.random.default_rng(2)
    new, y = x + 0.02 * rng.normal(size=x.shape), rng.normal(size=x.shape)
    wanted = np.where(whole.holonomic, whole.target(later), flight * whole.target(TIME + 0.5 * flight))
    found = []
    for solver in (fast, dense):
        positions, multipliers = new.copy(), np.empty((2, whole.n_rows))
        outcome = solver.positions(Request(positions, x, wanted, None, later, TIME, flight=flight != 0), multipliers[0])
        # Kernels know how coefficients change on the way: Newton's method, which rows of Python are not.
        assert outcome.converged and (outcome.iterations <= 5 or solver is dense or called(fast))
        tangents = y.copy()
        assert solver.tangents(Request(tangents, x, whole.target(TIME), None, TIME), multipliers[1]).converged
        found.append((positions, tangents, multipliers[:, np.argsort(solver.rows)]))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)
    positions, _, (pushes, _) = found[0]
    middle, way = 0.5 * (x + positions), positions - x
    slip = (whole.jacobian(middle, TIME + 0.5 * flight) @ way.ravel() - wanted)[~whole.holonomic]
    assert np.abs(slip).max() <= 1e-14 if flight else np.abs(slip).max() > 1e-3
    assert (np.abs(pushes[~whole.holonomic]) > 0).all() == (flight != 0)


def test_gradients_are_found_once_for_a_place():
    """A step asks where it begins, at each iteration, and twice where it ends: three gradients."""
    values, slopes = [], []
    quartic = lambda r: values.append(r) or float(np.sum(r**4))  # noqa: E731
    slope = lambda r: slopes.append(r.tobytes()) or 4.0 * r**3  # noqa: E731
    x = np.array([[1.0, 0.2, 0.5]])
    motion = Motion(ConstraintSet(Custom([0], quartic, slope), x, [1.0]), x)
    system = System(motion, None)
    state = run(system, State(x, motion.project_velocities(x, [[0.2, 1.0, 0.5]])), 0.003, 2)
    values.clear()
    slopes.clear()
    run(system, state, 0.003, 10)
    assert len(slopes) == len(set(slopes)) and len(slopes) <= 31 and len(values) <= 31 + 2 * 10
    assert all(not r.flags.writeable and r.shape == (1, 3) for r in values)


def test_a_gradient_is_found_again_where_the_value_has_changed():
    """At one place and time: of what the function reads besides nothing is known."""
    radius = [1.0]
    item = Custom([0], lambda r: np.linalg.norm(r * radius), lambda r: r * radius[0] ** 2 / np.linalg.norm(r * radius))
    x = np.array([[3.0, 0.0, 4.0]])
    motion = Motion(ConstraintSet(item, x, [1.0]), x)
    for scale in (1.0, 2.0, 0.5):
        radius[0] = scale
        multipliers = np.zeros(1)
        motion.project_velocities(x, np.array([[0.6, 0.0, 0.8]]), multipliers=multipliers)
        assert multipliers[0] == pytest.approx(1.0 / scale, rel=1e-12)
    found = motion.project_positions(x, x)
    np.testing.assert_allclose(np.linalg.norm(found * scale), 5.0, rtol=1e-14)


def test_functions_of_numba_are_called_without_python():
    x, atoms = scattered(4), [[0, 1], [5, 2]]
    fast, _, _ = both([Custom(atoms, bend, bend_gradient)], x)
    slow, _, _ = both([Custom(atoms, bend.py_func, bend_gradient.py_func)], x)
    assert not called(fast) and called(slow)
    ends = []
    for solver in (fast, slow):
        y = x + 0.01
        assert solver.positions(Request(y, x, None, None, TIME, TIME)).converged
        ends.append(y)
    np.testing.assert_allclose(*ends, rtol=1e-14, atol=1e-15)


class Fickle:
    """A distance that breaks when told to."""

    broken: object = None

    def __call__(self, r):
        if isinstance(self.broken, Exception):
            raise self.broken
        return np.linalg.norm(r[0] - r[1]) if self.broken is None else self.broken

    @staticmethod
    def gradient(r):
        u = (r[0] - r[1]) / np.linalg.norm(r[0] - r[1])
        return np.array([u, -u])


@pytest.mark.parametrize(
    ("broken", "error", "message"),
    [
        (ZeroDivisionError("of its own"), ZeroDivisionError, "of its own"),
        (np.zeros(2), InputError, r"function returned shape \(2,\) for row [01]; it must return one number"),
        ("many", InputError, "no array of numbers"),
    ],
)
def test_what_python_raises_comes_out_and_nothing_has_changed(broken, error, message):
    function = Fickle()
    x = scattered(0)
    motion = Motion(ConstraintSet(Custom([[0, 1], [2, 3]], function, function.gradient), x, MASSES), x)
    new, v = x + 0.01, np.ones_like(x)
    kept = new.copy()
    function.broken = broken
    with pytest.raises(error, match=message):
        motion.project_positions(new, x, velocities=v, dt=0.1, out=new)
    assert np.array_equal(new, kept) and np.array_equal(v, np.ones_like(x))
    function.broken = None
    assert motion.project_positions(new, x, out=new) is new


def test_a_function_may_keep_what_it_sees():
    seen = []

    def height(r):
        seen.append((r, r.copy()))
        return float(r[0, 2])

    x = scattered(0)
    motion = Motion(ConstraintSet(Custom([0], height, lambda r: np.array([[0, 0, 1.0]])), x, MASSES), x)
    del seen[:]
    motion.project_positions(x + 0.1, x)
    assert len({then.tobytes() for _, then in seen}) > 1
    assert all(np.array_equal(now, then) for now, then in seen)
    with pytest.raises(ValueError, match="read-only"):
        seen[-1][0][0, 0] = 1.0


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))], ids=["copy", "pickle"])
def test_copies_have_addresses_of_their_own(duplicate):
    x = scattered(1)
    solver, _, whole = both([CASES["Torus"](), Custom([0, 3], bend, bend_gradient)], x)
    other = duplicate(solver)
    del solver
    y = x + 0.01
    assert other.positions(Request(y, x)).converged
    assert np.all(np.abs(whole.value(y)) <= whole.tolerance(y))


def test_rows_that_elimination_takes_for_dependent_go_to_the_dense_solver():
    x = scattered(0)
    weights = np.random.default_rng(0).uniform(0.5, 2, (2, 3))

    def square(w):
        return Custom([0, 1], lambda r: np.sum(w * r * r), lambda r: 2 * w * r)

    motion = Motion(
        ConstraintSet([square(weights), square(weights + np.array([[1e-6, 0, 0], [0, 0, 0]]))], x, MASSES), x
    )
    assert motion.rank == 2 and isinstance(motion.plan.solvers[0], GeneralClusters)


# -- rows of mixed kinds ----------------------------------------------------------------------------


def test_dependent_rows_are_dropped():
    """Three sides of a triangle leave nothing for its angle; of many, rounding leaves something to most."""
    rng, n = np.random.default_rng(7), 12
    x, masses = rng.normal(size=(3 * n, 3)), rng.uniform(1, 16, 3 * n)
    corners = np.arange(3 * n).reshape(n, 3)
    sides = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    given = ConstraintSet([Distance(sides), Angle(corners)], x, masses)
    solver = SparseRows(given, np.arange(4 * n), 1 / masses)
    assert solver.rank(Request(0 * x, x)) == 3 * n
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
