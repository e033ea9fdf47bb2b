"""Rows that are formulas against hand-written families, their data, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import TIME

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import (
    Formula,
    KnifeEdge,
    Rolling,
    Sphere,
    VelocityFormula,
    from_dict,
)
from kcons.errors import InputError, SingularGeometryError


def test_a_moving_formula_is_followed():
    """A bead on a wave that runs; its height and its speed are those of the wave."""
    wave = Formula("z1 - a*sin(k*x1 - t)", 0, {"a": 0.1, "k": 2.0})
    x = np.array([[0.3, 0.0, 0.1 * np.sin(0.6)]])
    motion = Motion(ConstraintSet(wave, x, [1.0]), x)
    v = motion.project_velocities(x, np.array([[0.2, 0.1, 0.0]]))
    end = run(System(motion, lambda x, t: np.array([[0.0, 0.0, -1.0]])), State(x, v), 0.01, 100)
    (px, _, pz), (vx, _, vz) = end.positions[0], end.velocities[0]
    phase = 2 * px - end.time
    assert pz == pytest.approx(0.1 * np.sin(phase), abs=1e-14)
    assert vz == pytest.approx(0.1 * np.cos(phase) * (2 * vx - 1), abs=1e-13)


def test_a_period_goes_the_shorter_way():
    row = Formula("atan2(y1, x1)", 0, target=3.1, period=2 * np.pi)
    x = np.array([[-1.0, -0.03, 0.0]])
    motion = Motion(ConstraintSet(row, x, [1.0]), x)
    y = motion.project_positions(x, x)
    assert np.arctan2(y[0, 1], y[0, 0]) == pytest.approx(3.1) and np.abs(y - x).max() < 0.1


def test_files_keep_formulas():
    row = Formula("a*x1 - z2", [[0, 1], [2, 3]], {"a": [1.0, 2.0]}, target=[0.5, 0.25], period=7.0)
    again = from_dict(row.todict())
    assert again.todict() == row.todict()
    assert from_dict(Formula("x1", [0, 1]).todict()).n_rows == 2
    with pytest.raises(InputError, match=r"\['values'\] are missing"):
        from_dict({key: value for key, value in row.todict().items() if key != "values"})
    for wrong in ([1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]], None):
        with pytest.raises(InputError, match="values"):
            from_dict({**row.todict(), "values": wrong})


@pytest.mark.parametrize(
    ("make", "item", "message"),
    [
        (lambda: Formula("x1 - x2", [[0, 1, 2]]), "atoms", "a row has 2 atoms, but"),
        (lambda: Formula("x1 - y1", [[0, 1]]), "atoms", "a row has 1 atom, but"),
        (lambda: Formula("a*x1", [0, 1], 2.0), "parameters", "parameters is 2.0; give numbers by name"),
        (lambda: Formula("a*x1", [0, 1], {"a": [1.0, 2.0, 3.0]}), "a", r"Formula: a has shape \(3,\); give one number"),
        (lambda: Formula("x1", 0, {"x7": 1.0}), "x7", "cannot be the name"),
        (lambda: Formula("x1", 0, {"sin": 1.0}), "sin", "cannot be the name"),
        (lambda: Formula("x1", 0, {"lambda": 1.0}), "lambda", "cannot be the name"),
        (lambda: Formula("abs(x1)*copysign", 0, {"copysign": 1.0}), "copysign", "cannot be the name"),
        (lambda: Formula("x1", 0, {3: 1.0}), "parameters", "3 cannot be the name of a parameter; give text"),
    ],
)
def test_bad_arguments_are_named(make, item, message):
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert caught.value.item == item


@pytest.mark.parametrize(
    ("formula", "x1", "message"),
    [
        ("sqrt(1 - x1**2) - z1", 2.0, r"sqrt\(1 - x1 \*\* 2\) is nan where 1 - x1 \*\* 2 = -3 at the start"),
        ("log(x1)", 0.0, r"log\(x1\) is -inf where x1 = 0"),
        ("a/x1 + y1", 0.0, r"a / x1 is inf"),
        ("x1**2", 0.0, "its gradient is zero"),
        ("sqrt(x1) + y1", 0.0, "its gradient is not finite"),
    ],
)
def test_what_is_undefined_at_the_start_is_named(formula, x1, message):
    row = Formula(formula, 1, {"a": 1.0}, target=None)
    x = np.array([[0.0, 0.0, 0.0], [x1, 0.0, 0.0]])
    with pytest.raises((SingularGeometryError, InputError), match=message) as caught:
        ConstraintSet([Sphere(0, [1.0, 0, 0]), row], x, np.ones(2), time=TIME)
    assert caught.value.atoms in ((1,), ())


# -- linear in the velocities ------------------------------------------------------------------------------

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
def test_formulas_are_what_the_families_are(formula, family):
    x, v = np.array([[0.3, -0.2, 0.0], [0.9, 0.4, 0.3]]), np.array([[0.5, 0.2, 0.0], [-0.4, 1.0, 0.3]])
    one, other = (ConstraintSet(row, x, [1.0, 2.0]) for row in (formula, family))
    np.testing.assert_allclose(one.jacobian(x).toarray(), other.jacobian(x).toarray(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.acceleration_target(x, v), other.acceleration_target(x, v), rtol=1e-12)
    assert formula.translation_invariant and not formula.holonomic and not formula.moving


@pytest.mark.parametrize(
    ("formula", "message", "item"),
    [
        ("vx1**2 - y1", "is not a sum of velocities times functions", "formula"),
        ("vx1 - x1*t", "at rest it is not 0: what the sum is held at is the target", "formula"),
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
