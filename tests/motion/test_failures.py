"""What is said where a solve fails."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import constraints as held
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, SingularGeometryError
from kcons.motion import Motion
from kcons.motion.solver_sequence import Failures
from kcons.solvers.cluster_solver import Outcome, Request


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
    told = Failures(motion.constraint_set, motion.plan, numbers)
    error = told.positions(request, Outcome(False, 0.25, 7, 0), motion.plan.solvers[0])
    assert isinstance(error, ConvergenceError) and "smaller time step" in str(error)
    names = "1, 2, 3" if numbers is None else "11, 12, 13"
    assert (f"Atoms {names} of row #3 Dihedral" in str(error)) == named
    assert np.array_equal(request.changed, folded(after)) and np.array_equal(x, folded(before))
