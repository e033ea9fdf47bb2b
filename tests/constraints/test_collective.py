"""Centres of mass, their distance and the radius of gyration."""

from __future__ import annotations

import numpy as np
import pytest
from constraint_cases import MASSES, scattered

from kcons.constraints import CenterDistance, CenterOfMass, FixedAtoms, RadiusOfGyration, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, SingularGeometryError


def test_center_of_mass_rows_come_group_after_group():
    x = scattered(0)
    groups = np.array([[0, 1, 2], [5, 3, 4]])
    held = ConstraintSet([CenterOfMass(groups, axes=(2, 0))], x, MASSES)
    expected = [(MASSES[g] @ x[g, axis]) / MASSES[g].sum() for g in groups for axis in (2, 0)]
    assert held.target() == pytest.approx(expected)


def test_center_of_mass_moves_as_told_for_each_group_and_axis():
    target = np.arange(6.0).reshape(2, 3)
    item = CenterOfMass([[0, 1], [2, 3]], target=target)
    assert item.target.tolist() == target.ravel().tolist()
    moving = CenterOfMass([[0, 1], [2, 3]], target=lambda t: target * t)
    assert moving.target_at(2.0).tolist() == (2 * target).ravel().tolist()


def test_groups_are_left_to_the_compiled_solvers():
    assert CenterOfMass([[0, 1, 2, 3, 4]]).kind is RowKind.LINEAR
    item = CenterOfMass([[0, 1]], axes=(1,)).with_masses(np.array([[1.0, 3.0]]))
    assert item.parameters().tolist() == [[0.0, 0.25, 0.0, 0.0, 0.75, 0.0]]


def test_center_distance_and_radius_of_gyration_have_their_textbook_values():
    x = scattered(2)
    a, b = [0, 1, 2], [5, 7]
    centres = [MASSES[g] @ x[g] / MASSES[g].sum() for g in (a, b)]
    held = ConstraintSet(
        [CenterDistance(a, b), RadiusOfGyration(a), RadiusOfGyration(a, mass_weighted=False)], x, MASSES
    )
    about = x[a] - centres[0]
    even = x[a] - x[a].mean(axis=0)
    expected = [
        np.linalg.norm(centres[0] - centres[1]),
        np.sqrt(MASSES[a] @ (about**2).sum(axis=1) / MASSES[a].sum()),
        np.sqrt((even**2).sum() / 3),
    ]
    assert held.target() == pytest.approx(expected, rel=1e-14)


def test_values_are_as_good_far_from_the_origin():
    x = np.round(scattered(2) * 64) / 64
    shift = np.array([2.0**20, -(2.0**21), 2.0**20])  # exact in binary
    for item in (CenterDistance([0, 1, 2], [5, 7]), RadiusOfGyration([0, 1, 2])):
        near = ConstraintSet([item], x, MASSES).target()
        assert ConstraintSet([item], x + shift, MASSES).target() == pytest.approx(near, rel=1e-14)


def test_groups_across_the_boundary_are_made_whole():
    x = np.array([[0.1, 5.0, 5.0], [9.8, 5.0, 5.0], [1.3, 5.0, 5.0], [9.1, 5.2, 5.0]])
    whole = x.copy()
    whole[[1, 3], 0] -= 10.0
    for item in (CenterDistance([0, 1], [2, 3]), RadiusOfGyration([0, 1, 2, 3])):
        wrapped = ConstraintSet([item], x, MASSES[:4], cell=[10.0, 10.0, 10.0])
        assert wrapped.target() == pytest.approx(ConstraintSet([item], whole, MASSES[:4]).target(), rel=1e-13)


def test_neighbours_in_a_group_must_be_closer_than_half_the_box():
    x = np.array([[0.0, 0.0, 0.0], [3.9, 3.9, 3.9]])
    with pytest.raises(InputError, match=r"distance .* of atoms 0 and 1 is not shorter than half the box"):
        ConstraintSet([RadiusOfGyration([0, 1])], x, np.ones(2), cell=[8.0, 8.0, 8.0])


def test_a_hundred_thousand_atoms_in_a_row():
    n = 100_000
    x = np.random.default_rng(0).normal(size=(n, 3))
    held = ConstraintSet([CenterOfMass(np.arange(n)), RadiusOfGyration(np.arange(n))], x, np.ones(n))
    assert held.target() == pytest.approx([*x.mean(axis=0), np.sqrt(3 * x.var(axis=0).mean())], rel=1e-10)


def test_masses_are_needed():
    with pytest.raises(InputError, match="needs the masses of its atoms; put it in a ConstraintSet"):
        CenterOfMass([0, 1]).measure(np.zeros((3, 2, 3)), 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CenterOfMass([0, 1], axes=(0, 3)), "axes must be some of 0, 1, 2"),
        (lambda: CenterOfMass([0, 1], axes=0), "axes must be some of 0, 1, 2"),
        (lambda: CenterOfMass([0, 1], axes=(0.0, 1.0)), "axes must be some of 0, 1, 2"),
        (lambda: CenterOfMass([0, 1], axes=(0, 0)), "axes must be some of 0, 1, 2"),
        (lambda: CenterOfMass([[0, 1], [2]]), "different numbers of atoms"),
        (lambda: CenterDistance([0, 1], [1, 2]), "names an atom twice"),
        (lambda: CenterDistance([0, 1], np.zeros((1, 0), int)), "a group has no atoms"),
    ],
)
def test_bad_groups_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_undefined_gradients_are_refused():
    x = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, -1.0, 0]])
    with pytest.raises(SingularGeometryError, match=r"two centers of row 0.*coincide"):
        ConstraintSet([CenterDistance([0, 1], [2, 3])], x, np.ones(5))
    with pytest.raises(SingularGeometryError, match=r"all atoms of row 0.*coincide"):
        ConstraintSet([RadiusOfGyration([3, 4])], x, np.ones(5))
    with pytest.raises(InputError, match="target -1 is not positive"):
        ConstraintSet([RadiusOfGyration([0, 1], -1.0)], x, np.ones(5))


@pytest.mark.parametrize(
    "row", [CenterOfMass([0, 1]), CenterDistance([2], [0, 1]), RadiusOfGyration([0, 1])], ids=lambda row: row.family
)
def test_groups_without_any_mass_are_refused(row):
    x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    with pytest.raises(InputError, match="all atoms of a group have mass 0; give one of them a mass"):
        ConstraintSet([FixedAtoms([0, 1]), row], x, [0.0, 0.0, 1.0])
