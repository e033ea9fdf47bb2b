"""What is said where a solve fails."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, InputError, SingularGeometryError
from kcons.motion import Motion
from kcons.motion.failures import Failures
from kcons.solvers.cluster_solver import Outcome, Request

WATER = np.array([[0.0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.92662721, 0]])
BOND = Motion(ConstraintSet(held.Distance([0, 1]), WATER, np.ones(3)), WATER)
SOLVER = BOND.plan.solvers[0]


def failures(motion: Motion = BOND, numbers: np.ndarray | None = None) -> Failures:
    return Failures(motion.constraint_set, motion.plan, numbers)


@pytest.mark.parametrize("numbers", [None, np.array([70, 80, 90])])
def test_errors_name_row_array_and_atoms(numbers: np.ndarray | None) -> None:
    told = failures(numbers=numbers)
    names = (0, 1) if numbers is None else (70, 80)
    error = told.positions(Request(WATER, WATER), Outcome(False, 0.25, 7, 0), SOLVER)
    assert isinstance(error, ConvergenceError)
    assert (error.row, error.atoms, error.cluster, error.residual, error.iterations) == (0, names, 0, 0.25, 7)
    assert f"#0 Distance({names[0]}, {names[1]})" in str(error) and "restore_positions" in str(error)
    nameless = told.positions(Request(WATER, WATER), Outcome(False, 0.25, 7, -1), SOLVER)
    assert isinstance(nameless, ConvergenceError) and nameless.row == -1
    assert told.not_finite(x_new=WATER) is None
    broken = WATER.copy()
    broken[2] = np.nan  # no row touches it
    assert told.not_finite(x_new=broken) is None
    broken[1, 0] = np.inf
    error = told.not_finite(x_new=WATER, x_ref=broken)
    assert isinstance(error, InputError) and error.item == "x_ref" and error.atoms == names[1:]
    assert str(error).startswith(f"x_ref of atom {names[1]} is not finite")


def test_coincident_atoms_come_before_all_else() -> None:
    told, same, outcome = failures(), np.zeros((3, 3)), Outcome(False, np.inf, 0, 0)
    for error in (
        told.unusable(0, x_new=WATER, x_ref=same),
        told.tangents(same, WATER, outcome, SOLVER, "velocity"),
        told.undefined(0, velocity=WATER, position=same),
        told.start(WATER, same, 0, np.inf, 0, 0.0),
    ):
        assert isinstance(error, SingularGeometryError)
        assert error.rows == (0,) and error.atoms == (0, 1) and "move them apart" in str(error)
    assert told.unusable(0, x_new=same, x_ref=WATER) is None


def test_curvature_that_is_undefined() -> None:
    x = np.array([[1.0, 0, 0], [0.0, 0, 0], [0.0, 1.0, 0]])
    motion = Motion(ConstraintSet(held.Angle([0, 1, 2]), x, np.ones(3)), x)
    straight = np.array([[1.0, 0, 0], [0.0, 0, 0], [-1.0, 0.0, 0]])
    with pytest.raises(SingularGeometryError) as caught:
        motion.acceleration(straight, x, x)
    assert caught.value.rows == (0,) and caught.value.atoms == (0, 1, 2)


def chain(x: np.ndarray) -> Motion:
    rows = [held.Distance([[0, 1], [1, 2], [2, 3]]), held.Dihedral([[0, 1, 2, 3]])]
    return Motion(ConstraintSet(rows, x, np.ones(len(x))), x)


def folded(degrees: float) -> np.ndarray:
    """Four atoms whose last three are so far from one line, to the one side or to the other, and one elsewhere."""
    bend = np.radians(degrees)
    return np.array([[0, 1.0, 0], [0, 0, 0], [1.0, 0, 0], [1.0 + np.cos(bend), 0, np.sin(bend)], [5.0, 5, 5]])


@pytest.mark.parametrize("numbers", [None, np.array([10, 11, 12, 13, 14])])
@pytest.mark.parametrize(("before", "after", "named"), [(2.0, -2.0, True), (20.0, -20.0, True), (2.0, 20.0, False)])
def test_a_dihedral_that_becomes_straight_is_named(numbers, before, after, named) -> None:
    x = folded(before)
    motion, request = chain(x), Request(folded(after), x)
    error = failures(motion, numbers).positions(request, Outcome(False, 0.25, 7, 0), motion.plan.solvers[0])
    assert isinstance(error, ConvergenceError) and "smaller time step" in str(error)
    names = "1, 2, 3" if numbers is None else "11, 12, 13"
    assert (f"Atoms {names} of row #3 Dihedral" in str(error)) == named
    assert np.array_equal(request.changed, folded(after)) and np.array_equal(x, folded(before))
