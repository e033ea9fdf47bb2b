"""The model Hessian: its coordinates, its symmetries, and what it is worth."""

from __future__ import annotations

import numpy as np
import pytest
from ase.build import molecule

from kcons.constraints.periodic.one_piece import lattice_of
from kcons.free_energy.scans.relaxation import Internals


def hessian(internals, x):
    table = internals.jacobian(x)
    return table.T @ (internals.constants[:, None] * table)


@pytest.mark.parametrize("name", ["CH3CH2OH", "C2H2", "CH3SiH3", "2-butyne", "H2O"])
def test_gradients_are_those_of_the_values(name):
    atoms = molecule(name)
    rng = np.random.default_rng(1)
    x, d = atoms.positions, rng.normal(size=atoms.positions.shape)
    internals = Internals(atoms.numbers, x)
    h = 1e-5
    slope = internals.change(internals.values(x + h * d), internals.values(x - h * d)) / (2 * h)
    np.testing.assert_allclose(internals.jacobian(x) @ d.ravel(), slope, atol=1e-7)
    assert len(internals.terms) == len(internals.constants) == len(slope)


@pytest.mark.parametrize(("name", "free"), [("CH3CH2OH", 6), ("C2H2", 5), ("2-butyne", 7), ("H2O", 6)])
def test_only_shifts_and_turns_cost_nothing(name, free):
    """And the turn of butyne's ends against each other, between which a straight line leaves no dihedral."""
    atoms = molecule(name)
    x = atoms.positions
    curvature = np.linalg.eigvalsh(hessian(Internals(atoms.numbers, x), x))
    assert np.sum(np.abs(curvature) < 1e-8 * curvature.max()) == free
    assert curvature.min() > -1e-10 * curvature.max()


def test_a_cell_changes_nothing():
    atoms = molecule("CH3OH")
    x = atoms.positions
    cell = np.diag([8.0, 9.0, 10.0])
    moved = x + 4.2
    wrapped = moved - np.floor(moved / np.diag(cell)) * np.diag(cell)
    whole = hessian(Internals(atoms.numbers, x), x)
    cut = hessian(Internals(atoms.numbers, wrapped, lattice_of(cell, True)), wrapped)
    np.testing.assert_allclose(cut, whole, atol=1e-9)


def test_terms_keep_their_images():
    """Two atoms half a cell apart: the other image is as near, and nearer after a small move."""
    x = np.array([[0.0, 0, 0], [1.25, 0, 0]])
    internals = Internals([6, 6], x, lattice_of(np.diag([2.5, 9.0, 9.0]), True))
    for d in (-1e-3, 1e-3):
        change = internals.change(internals.values(x + np.array([[0, 0, 0], [d, 0, 0]])), internals.values(x))
        assert abs(change) == pytest.approx([1e-3])
        assert np.sign(change) == np.sign(d) * np.sign(internals.jacobian(x)[0, 3])


def test_data_go_from_terms_to_terms():
    x = molecule("H2O2").positions
    numbers = [8, 8, 1, 1]
    first = Internals(numbers, x)
    data = np.arange(2.0 * len(first.terms)).reshape(2, -1)
    assert np.array_equal(first.remapped(data, first.terms), data)
    shuffled = first.terms[::-1]
    assert np.array_equal(first.remapped(data[:, ::-1], shuffled), data)
    assert not first.remapped(data[:, :1], [(7, 8)]).any()


def test_a_dihedral_changes_by_the_shorter_way():
    internals = Internals([8, 8, 1, 1], molecule("H2O2").positions)
    turn = len(internals.terms) - 1
    assert len(internals.terms[turn]) == 4
    after, before = np.zeros(turn + 1), np.zeros(turn + 1)
    after[turn], before[turn] = -3.1, 3.1
    assert internals.change(after, before)[turn] == pytest.approx(2 * np.pi - 6.2)


def test_single_atoms_have_no_terms():
    apart = Internals([2, 2], np.array([[0.0, 0, 0], [0, 0, 30.0]]))
    assert apart.terms == [] and len(apart.constants) == 0
