"""What is said where a solve fails."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InfeasibleError, InputError, SingularGeometryError
from kcons.motion import Motion, failures
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.steppers import State, System, run

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
METHANE = np.vstack([np.zeros(3), 0.629 * TETRAHEDRON])
TRIANGLE = list(combinations(range(3), 2))


def bond(numbers: np.ndarray | None = None):
    whole = ConstraintSet(held.Distance([0, 1]), WATER, np.ones(3))
    motion = Motion(whole, WATER)
    return whole, motion.plan, motion.plan.solvers[0], numbers


@pytest.mark.parametrize("numbers", [None, np.array([70, 80, 90])])
def test_positions_failed(numbers: np.ndarray | None) -> None:
    whole, plan, solver, _ = bond()
    error = failures.positions_failed(whole, numbers, Request(WATER, WATER), Outcome(False, 0.25, 7, 0), solver, plan)
    names = (0, 1) if numbers is None else (70, 80)
    assert isinstance(error, ConvergenceError)
    assert (error.row, error.atoms, error.cluster, error.residual, error.iterations) == (0, names, 0, 0.25, 7)
    assert f"#0 Distance({names[0]}, {names[1]})" in str(error) and "restore_positions" in str(error)
    nameless = failures.positions_failed(
        whole, numbers, Request(WATER, WATER), Outcome(False, 0.25, 7, -1), solver, plan
    )
    assert isinstance(nameless, ConvergenceError) and nameless.row == -1


@pytest.mark.parametrize("numbers", [None, np.array([70, 80, 90])])
def test_not_finite_names_array_and_atom(numbers: np.ndarray | None) -> None:
    whole, *_ = bond()
    assert failures.not_finite(whole, numbers, {"x_new": WATER}) is None
    broken = WATER.copy()
    broken[2] = np.nan  # no row touches it
    assert failures.not_finite(whole, numbers, {"x_new": broken}) is None
    broken[1, 0] = np.inf
    error = failures.not_finite(whole, numbers, {"x_new": WATER, "x_ref": broken})
    atom = 1 if numbers is None else 80
    assert isinstance(error, InputError) and error.item == "x_ref" and error.atoms == (atom,)
    assert str(error).startswith(f"x_ref of atom {atom} is not finite")


def test_coincident_atoms_come_before_all_else() -> None:
    whole, plan, solver, _ = bond()
    same = np.zeros((3, 3))
    outcome = Outcome(False, np.inf, 0, 0)
    for error in (
        failures.unusable(whole, None, {"x_new": WATER, "x_ref": same}, outcome, solver),
        failures.tangents_failed(whole, None, same, WATER, outcome, solver, "velocity", plan),
        failures.undefined_row(whole, None, {"velocity": WATER, "position": same}, 0),
        failures.restore_failed(whole, None, WATER, same, outcome, solver, 0.0),
    ):
        assert isinstance(error, SingularGeometryError)
        assert error.rows == (0,) and error.atoms == (0, 1) and "move them apart" in str(error)
    assert failures.unusable(whole, None, {"x_new": same, "x_ref": WATER}, outcome, solver) is None


def test_curvature_that_is_undefined() -> None:
    x = np.array([[1.0, 0, 0], [0.0, 0, 0], [0.0, 1.0, 0]])
    motion = Motion(ConstraintSet(held.Angle([0, 1, 2]), x, np.ones(3)), x)
    straight = np.array([[1.0, 0, 0], [0.0, 0, 0], [-1.0, 0.0, 0]])
    with pytest.raises(SingularGeometryError) as caught:
        motion.acceleration(straight, x, x)
    assert caught.value.rows == (0,) and caught.value.atoms == (0, 1, 2)


def test_restore_failed_quotes_the_sum_of_squares() -> None:
    whole, _, solver, _ = bond()
    off = WATER + np.array([[0, 0, 0], [0.5, 0, 0], [0, 0, 0]])
    error = failures.restore_failed(whole, None, off, WATER, Outcome(False, 0.5, 9, 0), solver, 0.0)
    assert isinstance(error, InfeasibleError)
    assert "cannot go below 0.25 (sum of squares)" in str(error) and error.iterations == 9


def test_wide_rows_are_cut_short() -> None:
    x = np.random.default_rng(0).normal(size=(9, 3))
    whole = ConstraintSet(held.RadiusOfGyration([np.arange(9)]), x, np.ones(9))
    motion = Motion(whole, x)
    outcome, plan = Outcome(False, 1.0, 1, 0), motion.plan
    error = failures.positions_failed(whole, None, Request(x, x), outcome, plan.solvers[0], plan)
    assert "RadiusOfGyration(0, 1, 2, 3, 4, 5, ...)" in str(error)
    assert isinstance(error, ConvergenceError) and error.atoms == tuple(range(9))


def folded(degrees: float) -> np.ndarray:
    """Four atoms whose last three are so far from one line, to the one side or to the other, and one elsewhere."""
    bend = np.radians(degrees)
    return np.array([[0, 1.0, 0], [0, 0, 0], [1.0, 0, 0], [1.0 + np.cos(bend), 0, np.sin(bend)], [5.0, 5, 5]])


@pytest.mark.parametrize("numbers", [None, np.array([10, 11, 12, 13, 14])])
@pytest.mark.parametrize(
    ("before", "after", "singular"),
    [(2.0, -2.0, True), (20.0, -20.0, True), (2.0, 1.0, False), (2.0, 20.0, False), (20.0, 10.0, False)],
)
def test_a_dihedral_that_becomes_straight_is_named(numbers, before, after, singular) -> None:
    """No time step goes through the line; where a flight in small parts arrives, the step was too large."""
    x = folded(before)
    whole = ConstraintSet([held.Distance([[0, 1], [1, 2], [2, 3]]), held.Dihedral([[0, 1, 2, 3]])], x, np.ones(5))
    plan = Motion(whole, x).plan
    request = Request(folded(after), x)
    error = failures.positions_failed(whole, numbers, request, Outcome(False, 0.25, 7, 0), plan.solvers[0], plan)
    assert isinstance(error, ConvergenceError) and error.singular == singular
    names = "1, 2, 3" if numbers is None else "11, 12, 13"
    assert (f"Atoms {names} of row #3 Dihedral" in str(error)) == singular
    assert ("smaller time step" in str(error)) != singular
    assert np.array_equal(request.changed, folded(after)) and np.array_equal(x, folded(before))


def test_a_dihedral_that_is_passed_in_small_parts_is_not_named() -> None:
    """Turned by 120 degrees at once, a molecule may have gone through the line; in small parts it turns."""
    x = folded(60.0)
    whole = ConstraintSet([held.Distance([[0, 1], [1, 2], [2, 3]]), held.Dihedral([[0, 1, 2, 3]])], x, np.ones(5))
    plan = Motion(whole, x).plan
    about = np.array([[1.0, 0, 0], [0, np.cos(2.1), -np.sin(2.1)], [0, np.sin(2.1), np.cos(2.1)]])
    outcome = Outcome(False, 0.25, 7, 0)
    error = failures.positions_failed(whole, None, Request(x @ about.T, x), outcome, plan.solvers[0], plan)
    assert isinstance(error, ConvergenceError) and not error.singular and "smaller time step" in str(error)


def test_a_run_that_ends_where_a_dihedral_is_straight_names_no_time_step() -> None:
    """Free flight of a chain whose end folds into the line: it ends at the same time with any step."""
    x = np.array([[0, 1.0, 0], [0, 0, 0], [1.0, 0, 0], [1.8, 0, 0.6]])
    pairs = [[0, 1], [1, 2], [2, 3]]
    motion = Motion(ConstraintSet([held.Distance(pairs), held.Dihedral([[0, 1, 2, 3]])], x, np.ones(4)), x)
    v = motion.project_velocities(x, np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.6, 0, -0.8]]))
    ends = []
    for dt in (0.2, 0.02, 0.005):
        with pytest.raises(ConvergenceError, match="a held dihedral becomes undefined") as info:
            run(System(motion, lambda x, t: np.zeros_like(x)), State(x, v), dt, int(4 / dt))
        assert info.value.singular and "time step too large" not in str(info.value)
        ends.append(info.value.step * dt)
    assert max(ends) - min(ends) < 0.2
