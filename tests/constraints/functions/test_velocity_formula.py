"""Formulas that are linear in the velocities: against the families of kcons, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Distance, Formula, KnifeEdge, Plane, Rolling, VelocityFormula, from_dict
from kcons.errors import InputError, SingularGeometryError

BLADE = "((x2 - x1)*vy1 - (y2 - y1)*vx1)/sqrt((x2 - x1)**2 + (y2 - y1)**2)"
WHEEL = "vx1 - R*((z2 - z1)*(vx2 - vx1) - (x2 - x1)*(vz2 - vz1))/((x2 - x1)**2 + (z2 - z1)**2)"
UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("formula", "family"),
    [
        (VelocityFormula(BLADE, [0, 1]), KnifeEdge(0, 1, UP)),
        (VelocityFormula(WHEEL, [0, 1], {"R": 0.7}), Rolling(0, 1, 0.7, [1.0, 0.0, 0.0])),
    ],
    ids=["blade", "wheel"],
)
def test_formulas_move_as_the_families_do(formula, family):
    x = np.array([[0.3, -0.2, 0.0], [0.9, 0.4, 0.3]])
    v = np.array([[0.5, 0.2, 0.0], [-0.4, 1.0, 0.3]])
    ends = []
    for row in (formula, family):
        motion = Motion(ConstraintSet([Distance([0, 1]), Plane([0], UP), row], x, [1.0, 2.0]), x)
        assert motion.plan.kinds[0].solver == "SparseRows"
        start = State(x, motion.project_velocities(x, v))
        ends.append(run(System(motion, lambda x, t: np.sin(3 * x)), start, 0.02, 20))
    np.testing.assert_allclose(ends[0].positions, ends[1].positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(ends[0].velocities, ends[1].velocities, rtol=0, atol=1e-12)
    assert formula.translation_invariant and not formula.holonomic and not formula.moving


def test_written_to_files_and_read_again():
    spiral = VelocityFormula("x1*vy1 - y1*vx1 - c*(x1*vx1 + y1*vy1)", [0, 4], {"c": [1.0, 2.0]}, [0.1, 0.2])
    again = from_dict(spiral.todict())
    assert isinstance(again, VelocityFormula) and again.todict() == spiral.todict()


@pytest.mark.parametrize(
    ("formula", "message", "item"),
    [
        ("vx1**2 - y1", "is not a sum of velocities times functions", "formula"),
        ("vx1*vy1", "is not a sum of velocities times functions", "formula"),
        ("vx1 - x1*t", r"-t\*x1 is left without velocities; what the sum is held at is the target", "formula"),
        ("x1 - y1", "does not change with the velocities: it has none of them", "formula"),
        ("vx1 - a*vy1", "'a' in 'vx1 - a\\*vy1' is not known; known are x1, y1, z1, x2, ..., vx1, vy1, ...,", "a"),
    ],
)
def test_what_is_not_linear_in_the_velocities_is_refused(formula, message, item):
    with pytest.raises(InputError, match=message) as caught:
        VelocityFormula(formula, 0)
    assert caught.value.item == item


def test_velocities_are_not_for_positions():
    with pytest.raises(InputError, match=r"'vx1' in 'x1 - vx1' is a velocity; .* is held by VelocityFormula") as caught:
        Formula("x1 - vx1", 0)
    assert caught.value.item == "vx1"


def test_coefficients_that_vanish_or_do_not_exist():
    with pytest.raises(SingularGeometryError, match="its gradient is zero at the start"):
        ConstraintSet(VelocityFormula("x1*vy1 - y1*vx1", 0), np.zeros((1, 3)), [1.0])
    with pytest.raises(SingularGeometryError, match="1 / x1 is inf"):
        ConstraintSet(VelocityFormula("vy1/x1", 0), np.zeros((1, 3)), [1.0])
