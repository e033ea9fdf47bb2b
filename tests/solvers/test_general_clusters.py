"""Damped Newton with dense algebra, batches of interpreted rows; what counts as dependent: angles between rows."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.solvers.cluster_solver import Request
from kcons.solvers.general_clusters import GeneralClusters
from kcons.solvers.rank_revealing import rank
from kcons.solvers.tolerances import MANY_ITERATIONS


def solver_of(rows, x, masses=None, labels=None) -> tuple[GeneralClusters, ConstraintSet]:
    whole = ConstraintSet(rows, x, np.ones(len(x)) if masses is None else masses)
    n = whole.n_rows
    labels = np.zeros(n, dtype=np.int64) if labels is None else np.asarray(labels)
    return GeneralClusters(whole, np.arange(n), labels, 1.0 / whole.masses), whole


def positions(solver, x_new, x_ref, velocities=None, inv_dt=0.0, multipliers=None):
    return solver.positions(Request(x_new, x_ref, velocities=velocities, inv_dt=inv_dt), multipliers)


def weighted_square(weights: np.ndarray) -> held.Custom:
    return held.Custom(
        np.arange(len(weights)),
        lambda r: np.sum(weights * r * r, axis=(-1, -2)),
        lambda r: 2 * weights * r,
    )


def ellipsoid(atoms: np.ndarray) -> held.Formula:
    return held.Formula("x1**2 + 2*y1**2 + 3*z1**2", atoms, target=None)


def test_batches_are_cluster_by_cluster() -> None:
    """Clusters of several sizes in one call give what each gives alone."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(12, 3)) * 2
    rows = [
        held.RadiusOfGyration([[0, 1, 2], [3, 4, 5]]),
        held.CenterDistance([[6, 7]], [[8]]),
        held.Distance([(0, 1), (3, 4), (10, 11)]),
    ]
    masses = rng.uniform(1, 9, 12)
    solver, whole = solver_of(rows, x, masses, labels=[0, 1, 2, 0, 1, 3])
    assert sorted(len(b.rows) for b in solver._batches) == [1, 1, 2]
    new = x + 0.05 * rng.normal(size=x.shape)
    together, lam = new.copy(), np.empty(6)
    assert positions(solver, together, x, multipliers=lam).converged
    for rows_of_one in ([0, 3], [1, 4], [2], [5]):
        alone = GeneralClusters(whole, np.array(rows_of_one), np.zeros(len(rows_of_one), int), 1 / masses)
        single, part = new.copy(), np.empty(len(rows_of_one))
        assert positions(alone, single, x, multipliers=part).converged
        np.testing.assert_allclose(part, lam[rows_of_one], rtol=1e-11)
        np.testing.assert_allclose(single[alone.atoms], together[alone.atoms], rtol=0, atol=1e-14)


@pytest.mark.parametrize("exponent", range(2, 8))
def test_rows_that_are_nearly_parallel(exponent: int) -> None:
    """Newton has the condition of the rows and not its square: independent rows are all held."""
    rng = np.random.default_rng(exponent)
    x = rng.normal(size=(4, 3))
    w = rng.uniform(0.5, 2, (4, 3))
    rows = [weighted_square(w), weighted_square(w + 10.0**-exponent * rng.normal(size=(4, 3)))]
    solver, whole = solver_of(rows, x)
    assert solver.rank(x, 0.0) == 2
    # A step that two such rows can answer: along the surface, and off it to second order.
    v = Motion(whole, x).project_velocities(x, rng.normal(size=x.shape))
    new = x + 1e-2 * np.sqrt(10.0**-exponent) * v
    lam = np.empty(2)
    y = new.copy()
    outcome = positions(solver, y, x, multipliers=lam)
    assert outcome.converged, outcome
    assert np.all(np.abs(whole.value(y)) <= whole.tolerance(y))
    from_lam = (whole.jacobian(x).T @ lam).reshape(-1, 3)
    np.testing.assert_allclose(from_lam, y - new, rtol=0, atol=1e-13 + 1e-16 * np.abs(lam).max())


def test_atoms_of_infinite_mass_move_as_prescribed() -> None:
    """The others follow them."""
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(2, 3, 3))
    whole = ConstraintSet(held.Distance([[0, 1], [1, 2]]), x, np.ones(3))
    solver = GeneralClusters(whole, np.arange(2), np.zeros(2, dtype=np.int64), np.array([0.0, 1.0, 0.5]))
    driving, rates = y[0].copy(), np.array([0.3, -0.2])
    assert solver.tangents(Request(y, x, rates)).converged
    np.testing.assert_array_equal(y[0], driving)
    assert whole.jacobian(x) @ y.ravel() == pytest.approx(rates, abs=1e-14)


@pytest.mark.parametrize(("apart", "converged"), [(1e-14, True), (1e-9, False)])
def test_velocities_that_cannot_be_tangent_are_refused(apart: float, converged: bool) -> None:
    """Two rows of one bond with rates that differ: by rounding, or by more than that."""
    x = np.array([[0.1, 0.2, 0.3], [1.2, 0.1, -0.2]])
    solver, whole = solver_of(held.Distance([[0, 1], [0, 1]]), x)
    y = np.array([[0.3, -0.2, 0.5], [0.1, 0.4, -0.2]])
    before = y.copy()
    rates = np.array([0.7, 0.7 * (1 + apart)])
    outcome = solver.tangents(Request(y, x, rates))
    assert outcome.converged == converged
    if converged:
        assert whole.jacobian(x) @ y.ravel() == pytest.approx(rates, rel=1e-13)
    else:
        np.testing.assert_array_equal(y, before)


@pytest.mark.parametrize(
    ("offset", "apart", "converged"),
    [(0.0, 4e-15, True), (0.0, 8e-14, True), (0.0, 1e-11, False), (1e3, 1e-13, True), (1e3, 1e-10, False)],
)
def test_no_more_is_left_than_rounding(offset: float, apart: float, converged: bool) -> None:
    """Two rows of one bond whose targets part with time: by what positions resolve, or by more than that."""
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]]) + offset
    rows = [held.Distance([0, 1], lambda t: 1.0 + 0.0 * t), held.Distance([0, 1], lambda t: 1.0 + apart * t)]
    solver, whole = solver_of(rows, x)
    moved = x + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    before = moved.copy()
    outcome = solver.positions(Request(moved, x, time=1.0))
    assert outcome.converged == converged
    if converged:
        assert np.all(np.abs(whole.value(moved, 1.0)) <= max(1.0, 0.6e14 * apart) * whole.tolerance(moved, 1.0))
    else:
        np.testing.assert_array_equal(moved, before)


def test_a_step_too_far_is_refused_and_changes_nothing() -> None:
    """A sphere cannot be reached along a direction that passes it by."""
    x = np.array([[1.0, 0, 0], [5.0, 0, 0]])
    solver, _ = solver_of([ellipsoid(np.array([0, 1]))], x, labels=[0, 1])
    new = x + np.array([[0.0, 3.0, 0], [0.01, 0, 0]])
    kept, v = new.copy(), np.ones((2, 3))
    outcome = positions(solver, new, x, velocities=v, inv_dt=1.0)
    assert not outcome.converged and outcome.worst_row == 0 and outcome.residual > 1e-3
    np.testing.assert_array_equal(new, kept)
    assert (v == 1).all()


def test_the_other_side_is_no_solution() -> None:
    """A gradient that turned by more than 90 degrees means that the wrong root was found."""
    x = np.array([[1.0, 0, 0]])
    solver, _ = solver_of([ellipsoid(np.array([0]))], x)
    new = np.array([[-1.05, 0.0, 0]])
    assert not positions(solver, new, x).converged


def test_what_many_iterations_ask_for_is_asked_of_the_clusters_that_took_them() -> None:
    """The first row has flattened out on its way, after few; the second takes many, and has not."""
    square = held.Custom([0], lambda r: r[0, 0] ** 2, lambda r: np.array([[2 * r[0, 0], 0, 0]]), target=0.005**2)
    arctan = held.Custom(
        [1], lambda r: np.arctan(r[0, 0]), lambda r: np.array([[1 / (1 + r[0, 0] ** 2), 0, 0]]), target=0.0
    )
    x = np.array([[1.0, 0, 0], [0, 0, 0]])
    solver, _ = solver_of([square, arctan], x, labels=[0, 1])
    new = np.array([[0.0051, 0, 0], [30.0, 0, 0]])
    outcome = positions(solver, new, x)
    assert outcome.converged and outcome.iterations > MANY_ITERATIONS
    np.testing.assert_allclose(new[:, 0], [0.005, 0.0], atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0])
def test_places_and_speeds_that_are_not_finite_and_gradients_that_vanish(bad: float) -> None:
    x = np.array([[1.0, 0, 0], [5.0, 0, 0]])
    solver, _ = solver_of([ellipsoid(np.array([0, 1]))], x, labels=[0, 1])
    broken, good = x + 0.01, x.copy()
    broken[1] = bad
    outcomes = [positions(solver, good, broken), solver.tangents(Request(good, broken))]
    if bad:
        outcomes += [positions(solver, broken.copy(), x), solver.tangents(Request(broken, x))]
    assert all(not outcome.converged and outcome.worst_row == 1 for outcome in outcomes)
    np.testing.assert_array_equal(good, x)


# -- rank -------------------------------------------------------------------------------------------


def rows_at(angle, scale=1.0):
    """Two rows of three numbers with an angle between them."""
    return np.array([[1.0, 0.0, 0.0], [scale * np.cos(angle), scale * np.sin(angle), 0.0]])


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e12])
@pytest.mark.parametrize(("angle", "expected"), [(1e-7, 2), (1e-9, 1), (0.0, 1)])
def test_what_counts_is_the_angle(angle, expected, scale):
    assert rank(rows_at(angle, scale)[None]) == expected


def test_stacks_are_counted_in_all_and_rows_of_zeros_do_not_count():
    assert rank(np.stack([rows_at(1.0), rows_at(0.0), np.zeros((2, 3))])) == 3
    assert rank(np.zeros((0, 2, 3))) == 0
