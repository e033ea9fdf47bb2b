"""Coordinates given by Python functions: checks of what was given, accuracy of what was not."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import MASSES, TIME, saddle, scattered, spread

from kcons.constraints import Custom, Dihedral, Distance, Formula, ImplicitSurface
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, SingularGeometryError
from kcons.motion import Motion


def gap(r):
    return float(np.linalg.norm(r[0] - r[1]))


def gap_gradient(r):
    u = (r[0] - r[1]) / gap(r)
    return np.array([u, -u])


#: The same coordinates as formulas, which are differentiated exactly.
SQUARES = "((x{0} - x{1})**2 + (y{0} - y{1})**2 + (z{0} - z{1})**2)"
SADDLE = "z1 - (x1**2 - y1**2)/4 - x1**3/9"
SPREAD = f"exp(-{SQUARES.format(1, 2)}/8) + {SQUARES.format(2, 3)}/5*cos(t)"


@pytest.mark.parametrize(
    ("make", "formula", "atoms"),
    [(saddle, SADDLE, [0, 3, 5]), (spread, SPREAD, [[0, 1, 2], [5, 3, 4]])],
    ids=["surface", "custom"],
)
def test_differenced_curvature_has_ten_digits(make, formula, atoms):
    x, v = scattered(0), 10 * scattered(1)
    exact, differenced = Formula(formula, atoms), make(atoms)
    r, u = x[exact.atoms], v[exact.atoms]
    found = differenced.curvature(r, u, TIME)
    expected = exact.curvature(r, u, TIME)
    assert np.abs(found - expected).max() < 1e-10 * np.einsum("kai,kai->k", u, u).max()


def test_differenced_curvature_does_not_depend_on_the_unit_of_time():
    item = spread([[0, 1, 2]])
    r, v = scattered(0)[item.atoms], scattered(1)[item.atoms]
    slow, fast = item.curvature(r, 1e-6 * v, TIME), item.curvature(r, 1e6 * v, TIME)
    assert slow * 1e24 == pytest.approx(fast, rel=1e-9)
    assert item.curvature(r, 0 * v, TIME).tolist() == [0.0]


def test_a_wrong_gradient_is_found_before_it_moves_anything():
    with pytest.raises(InputError, match=r"row 1, Custom\(0, 1\): gradient gives .* but differences .* give"):
        ConstraintSet([Distance([2, 3]), Custom([0, 1], gap, lambda r: 2 * gap_gradient(r))], scattered(0), MASSES)
    with pytest.raises(InputError, match=r"row 0, ImplicitSurface\(0\): gradient gives"):
        ConstraintSet(
            [ImplicitSurface(0, lambda r: r[:, 2] + r[:, 0] ** 2, lambda r: np.eye(3)[[2] * len(r)])],
            scattered(0),
            MASSES,
        )


def test_a_gradient_that_vanishes_is_refused():
    flat = ImplicitSurface([0, 1], lambda r: r[:, 0] ** 2, lambda r: 2 * r * [1.0, 0.0, 0.0], target=None)
    x = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(SingularGeometryError, match=r"row 1, ImplicitSurface\(1\): .*the gradient not zero"):
        ConstraintSet([flat], x, np.ones(2))


def test_results_of_the_wrong_shape_are_named():
    x = scattered(0)
    with pytest.raises(InputError, match=r"Custom: gradient returned shape \(3,\) for row 0; it must return \(2, 3\)"):
        ConstraintSet([Custom([0, 1], gap, lambda r: gap_gradient(r)[0])], x, MASSES)
    with pytest.raises(
        InputError, match=r"Custom: function returned shape \(3,\) for row 0; it must return one number"
    ):
        ConstraintSet([Custom([0, 1], lambda r: r[0], gap_gradient)], x, MASSES)
    with pytest.raises(InputError, match=r"ImplicitSurface: function returned shape \(\).*it must return \(2,\)"):
        ConstraintSet([ImplicitSurface([0, 1], lambda r: 1.0, lambda r: r)], x, MASSES)


TRANS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, -1.0, 0.0]])


def _torsion(r):
    return float(Dihedral([0, 1, 2, 3]).measure(r[None], 0.0)[0])


@pytest.mark.parametrize("gradient", [None, lambda r: Dihedral([0, 1, 2, 3]).gradient(r[None], 0.0)[0]])
def test_differences_where_the_value_jumps_by_its_period(gradient):
    v = scattered(2)[:4]
    ours = ConstraintSet([Custom([0, 1, 2, 3], _torsion, gradient, period=2 * np.pi)], TRANS, np.ones(4))
    theirs = ConstraintSet([Dihedral([0, 1, 2, 3])], TRANS, np.ones(4))
    assert ours.jacobian(TRANS).toarray() == pytest.approx(theirs.jacobian(TRANS).toarray(), abs=1e-10)
    assert ours.acceleration_target(TRANS, v) == pytest.approx(theirs.acceleration_target(TRANS, v), rel=1e-8)
    kept = Motion(ours, TRANS).project_positions(TRANS + 0.01 * v, TRANS)
    assert kept == pytest.approx(Motion(theirs, TRANS).project_positions(TRANS + 0.01 * v, TRANS), abs=1e-9)


@pytest.mark.parametrize("period", [0.0, np.nan])
def test_a_period_that_is_none_is_refused(period):
    """The residual of a formula counted as 0, and nothing was held."""
    with pytest.raises(InputError, match=r"Formula: period is .*; give a positive number"):
        Formula("x1", 0, period=period)


@pytest.mark.parametrize("make", [ImplicitSurface, Custom])
def test_a_gradient_that_vanishes_is_refused_when_it_is_differenced(make) -> None:
    """Differences leave rounding of it, in whose direction the atom was held."""
    row = make([0], lambda r: (np.sum(r * r, axis=-1 if make is ImplicitSurface else None) - 1) ** 2, target=0.0)
    with pytest.raises(SingularGeometryError, match="it vanishes, or the function varies faster"):
        ConstraintSet([row], np.array([[0.6, 0.0, 0.8]]), np.ones(1))


CUT = np.array([[0.2, 0.3, 0.4], [4.8, 0.1, 0.6], [0.5, 1.0, 0.2]])


@pytest.mark.parametrize("gradient", [None, gap_gradient])
def test_atoms_cut_by_a_face_of_the_cell_are_refused_unless_it_is_said_what_is_meant(gradient):
    """Their value was taken where they lie, and another one held than the nearest images have."""
    cell, masses = np.diag([5.0, 6.0, 6.0]), np.ones(3)
    with pytest.raises(InputError, match=r"row 0.* cut by a face .* differs by -4\.\d+ .* translation_invariant=True"):
        ConstraintSet(Custom([0, 1], gap, gradient), CUT, masses, cell=cell)
    held = ConstraintSet(Custom([0, 1], gap, gradient, translation_invariant=True), CUT, masses, cell=cell)
    assert held.value(CUT)[0] == 0 and held.constraints[0].target[0] == pytest.approx(np.sqrt(0.4**2 + 0.2**2 + 0.2**2))


def test_functions_that_know_their_images_or_a_place_may_be_cut():
    cell, masses = np.diag([5.0, 6.0, 6.0]), np.ones(3)

    def nearest(r):
        d = r[0] - r[1]
        return float(np.linalg.norm(d - np.diag(cell) * np.round(d / np.diag(cell))))

    for function, atoms in ((nearest, [0, 1]), (lambda r: float(r[0] @ r[1]), [0, 1]), (gap, [0, 2])):
        assert ConstraintSet(Custom(atoms, function), CUT, masses, cell=cell).value(CUT)[0] == 0
