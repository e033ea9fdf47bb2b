"""Linear rows and fixed atoms."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import MASSES, scattered

from kcons.constraints import FixedAtoms, LinearCombination, LinearRelation, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError


def test_relation_is_three_rows_an_atom():
    x = scattered(0)
    w = [0.25, 0.75]
    item = LinearRelation([0, 3], [[1, 2], [4, 5]], w)
    held = ConstraintSet([item], x, MASSES)
    expected = [x[0] - w[0] * x[1] - w[1] * x[2], x[3] - w[0] * x[4] - w[1] * x[5]]
    assert held.value(x) == pytest.approx(np.ravel(expected), abs=1e-14)
    assert held.target().tolist() == [0.0] * 6


def test_planar_group_of_three_bases_fills_the_compiled_row():
    item = LinearRelation(3, [0, 1, 2], [0.2, 0.3, 0.5])
    assert item.kind is RowKind.LINEAR
    assert item.parameters()[1].tolist() == [0, 1, 0, 0, -0.2, 0, 0, -0.3, 0, 0, -0.5, 0]


def test_minimum_image_of_a_relation():
    x = np.array([[0.1, 0.0, 0.0], [9.7, 0.0, 0.0], [0.5, 0.0, 0.0]])
    item = LinearRelation(0, [1, 2], [0.5, 0.5])
    assert ConstraintSet([item], x, np.ones(3), cell=[10.0] * 3).value(x) == pytest.approx([0, 0, 0], abs=1e-14)


def test_weights_that_do_not_sum_to_one_depend_on_the_origin():
    assert LinearRelation(0, [1, 2], [0.5, 0.5]).translation_invariant
    assert not LinearRelation(0, [1, 2], [0.5, 0.6]).translation_invariant
    assert LinearCombination([0, 1], [[0, 0, 1], [0, 0, -1]]).translation_invariant
    assert not LinearCombination([0, 1], [[0, 0, 1], [0, 0, 1]]).translation_invariant


def test_selected_rows_keep_the_images_of_the_whole_object():
    mixed = LinearCombination([[0, 1], [2, 3]], [[[0, 0, 1], [0, 0, -1]], [[0, 0, 1], [0, 0, 1]]])
    assert not mixed.translation_invariant
    assert not mixed.select([0]).translation_invariant


def test_fixed_atoms_stay_where_they_start_or_are_put():
    x = scattered(1)
    assert np.array_equal(ConstraintSet([FixedAtoms([5, 2])], x, MASSES).target(), x[[5, 2]].ravel())
    places = np.arange(6.0).reshape(2, 3)
    assert FixedAtoms([5, 2], places).target.tolist() == list(range(6))
    assert FixedAtoms([5, 2], [1.0, 2.0, 3.0]).target.tolist() == [1, 2, 3, 1, 2, 3]
    assert FixedAtoms(5).atoms.tolist() == [[5], [5], [5]]


def test_fixed_atoms_follow_a_path():
    item = FixedAtoms([0], lambda t: [[np.cos(t), np.sin(t), 0.0]])
    held = ConstraintSet([item], [[1.0, 0.0, 0.0]], np.ones(1))
    x = [[1.0, 0.0, 0.0]]
    assert held.velocity_target(x, 0.3) == pytest.approx([-np.sin(0.3), np.cos(0.3), 0.0], abs=1e-12)
    assert held.acceleration_target(x, x, 0.3) == pytest.approx([-np.cos(0.3), -np.sin(0.3), 0.0], abs=1e-10)


def test_fixed_atoms_may_have_no_mass():
    x = scattered(0)
    masses = MASSES.copy()
    masses[2] = 0.0
    held = ConstraintSet([FixedAtoms([2]), LinearCombination([2, 3], [[1, 0, 0], [-1, 0, 0]])], x, masses)
    assert held.n_rows == 4
    with pytest.raises(InputError, match="atom 2 has mass 0; constrained atoms need positive mass"):
        ConstraintSet([LinearCombination([2, 3], [[1, 0, 0], [-1, 0, 0]])], x, masses)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FixedAtoms([1, 4, 1]), "names atom 1 twice"),
        (lambda: FixedAtoms([1, 4], np.zeros((3, 3))), r"target has shape \(3, 3\)"),
        (
            lambda: LinearCombination([[0, 1], [2, 3]], [[[0, 0, 1.0]] * 2, [[0, 0, 0]] * 2]),
            "coefficients of row 1 are",
        ),
        (lambda: LinearCombination([0, 1], [1.0, 2.0]), "coefficients has shape"),
        (lambda: LinearCombination([0, 1], [[0, 0, np.nan], [0, 0, 1]]), "coefficients of row 0 is not finite"),
        (lambda: LinearRelation(0, [1, 2], [0.5, 0.3, 0.2]), "do not fit"),
        (lambda: LinearRelation(0, [0, 2], [0.5, 0.5]), "names an atom twice"),
        (lambda: LinearRelation(0.5, [1, 2], [0.5, 0.5]), "must be integers"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_masks_are_no_numbers_of_atoms():
    for mask in ([True, False, False], np.array([True, False, True])):
        with pytest.raises(InputError, match=r"FixedAtoms: .*integers, not bool; of a mask give np\.flatnonzero"):
            FixedAtoms(mask)
    with pytest.raises(InputError, match="names atom 5 twice"):
        FixedAtoms([5, 2, 5], [0.0, 0.0, 0.0])
