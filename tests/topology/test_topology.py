"""What is read out of names, numbers and distances: elements, residues, decimals, bonds; molecules made whole."""

from __future__ import annotations

import numpy as np
import pytest
from snapshots import WATER, held_rows, rotations, snapshot

from kcons.errors import InputError
from kcons.topology.topology import (
    Snapshot,
    as_written,
    elements_of,
    guess_bonds,
    require_standard_form,
    split_residues,
    whole_groups,
    whole_numbers,
)

IN_MOLECULES = [
    ("CA", "ALA", "C"), ("HG", "SER", "H"), ("HG21", "ILE", "H"), ("1HB", "ALA", "H"), ("NE", "ARG", "N"),
    ("CD1", "LEU", "C"), ("OW", "SOL", "O"), ("MW", "SOL", ""), ("EPW", "WAT", ""), ("CL1", "LIG", "Cl"),
    ("SE", "MSE", "Se"), ("FE", "HEM", "Fe"), ("NA", "HEM", "N"), ("SD", "MET", "S"), ("D1", "DOD", "H"),
]  # fmt: skip
ALONE = [
    ("CA", "CA", "Ca"), ("NA", "NA", "Na"), ("NA+", "NA+", "Na"), ("SOD", "SOD", "Na"), ("CLA", "CLA", "Cl"),
    ("CL", "CL-", "Cl"), ("CA", "GLY", "C"), ("OW", "SOL", "O"), ("O", "HOH", "O"), ("ZN", "ZN", "Zn"), ("K", "K", "K"),
]  # fmt: skip


@pytest.mark.parametrize("others", [(), ("XX1", "XX2")], ids=["alone", "in a molecule"])
def test_elements_of_atoms(others):
    for name, residue, element in IN_MOLECULES if others else ALONE:
        names = np.array([name, *others])
        found = elements_of(names, np.zeros(len(names), int), np.array([residue]), None)
        assert found[0] == element, (name, residue)


def test_elements_by_names_and_masses():
    for names, masses, elements in (
        # Masses that were read decide; hydrogens made heavier stay hydrogens.
        ("CLA X7 H1 MW CA", [35.45, 15.999, 3.024, 0.0, 12.011], "Cl O H - C"),
        # Names, where hydrogens took mass: amide N weighs as much as C, hydroxyl O as N, CH as Be.
        (
            "CB HB1 OG HG N HN CA HA OH2",
            [7.98, 3.024, 13.983, 3.024, 11.991, 3.024, 8.987, 4.0, 12],
            "C H O H N H C H O",
        ),
        # Without names, what is lighter than helium is hydrogen.
        ("1 2 3 4 5 6", [15.999, 1.008, 2.014, 3.024, 4.0026, 0.4], "O H H H - -"),
    ):
        found = elements_of(np.array(names.split()), np.zeros(len(masses), int), np.array(["LIG"]), np.array(masses))
        assert [element or "-" for element in found] == elements.split()


def test_residues_end_where_a_name_comes_again():
    names = np.array(["O", "H1", "H2"] * 3 + ["N"])
    called = np.array(["HOH"] * 9 + ["ALA"])
    residues, first = split_residues(names, called, np.array([1, 1, 1, 1, 1, 1, 2, 2, 2, 2]))
    assert residues.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3]
    assert first.tolist() == [0, 3, 6, 9]
    turned = split_residues(np.array(["O", "H1", "H2", "O", "H2", "H1"]), np.array(["HOH"] * 6), np.ones(6, int))
    assert turned[0].tolist() == [0, 0, 0, 1, 1, 1]
    ions = split_residues(np.array(["NA"] * 3 + ["SOD"] * 2), np.array(["NA+"] * 3 + ["SOD"] * 2), np.ones(5, int))
    assert ions[0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("names", ["C C O H H H H H H", "H H", "O H H O H H", "N CA CB CA CB", "C " * 60])
def test_names_that_come_again_otherwise_are_of_one_residue(names):
    names = np.array(names.split())
    residues, first = split_residues(names, np.array(["MOL"] * len(names)), np.ones(len(names), int))
    assert residues.tolist() == [0] * len(names) and first.tolist() == [0]


def test_single_precision_gives_back_the_decimals_of_a_file():
    rng = np.random.default_rng(1)
    for decimals in (3, 4):
        written = np.round(rng.uniform(-90, 90, size=(500, 3)), decimals)
        np.testing.assert_array_equal(as_written(written.astype(np.float32)), written)
    # What a simulation left in single precision stays what it is, up to its rounding.
    x = rng.uniform(-90, 90, size=(500, 3)).astype(np.float32)
    assert np.abs(as_written(x) - x).max() <= np.spacing(np.float32(90))
    y = rng.uniform(-90, 90, size=(5, 3))
    np.testing.assert_array_equal(as_written(y), y)


def test_units_and_numbers_of_atoms():
    made = snapshot(["O", "H", "H"], WATER, cell=WATER, velocities=WATER)
    there = made.in_unit(0.1)
    np.testing.assert_allclose([there.positions, there.cell, there.velocities], [WATER / 10] * 3)
    with pytest.raises(InputError, match="3 atoms in the topology, but positions have shape"):
        Snapshot(made.topology, WATER[:2])


def test_numbers_of_residues_that_have_letters():
    assert whole_numbers(np.array(["12", "12A", "-3", "B", ""])).tolist() == [12, 12, -3, 0, 0]
    assert whole_numbers(np.zeros(0, "U1")).tolist() == []


def test_cells_that_would_have_to_be_turned():
    lower = np.array([[7.0, 0, 0], [2.0, 8.0, 0], [-1.0, 3.0, 9.0]])
    require_standard_form(lower, "OpenMM", positive=True)
    for cell, positive in ((lower[[1, 0, 2]], False), (lower * [1, 1, -1], True)):
        with pytest.raises(InputError, match="OpenMM wants the first cell vector along x"):
            require_standard_form(cell, "OpenMM", positive=positive)
    require_standard_form(np.diag([7.0, 8.0, 0.0]), "MDAnalysis")


# -- molecules across the faces of a cell --------------------------------------------------------------


def test_groups_lie_where_the_bonds_of_their_molecule_say():
    """Ends of a chain of 29 angstrom in a cell of 40: their nearest images are 11 angstrom apart."""
    n, side = 24, 40.0
    x = np.array([[1.25 * i, 0.9 * (i % 2), 0.3 * np.sin(i)] for i in range(n)])
    bonds = [(i, i + 1) for i in range(n - 1)]
    atoms = np.array([[0, 1, 22, 23], [0, 22, 1, 23]])
    for positions in (x, (x + 25.0) % side):
        chain = snapshot(["C"] * n, positions, bonds, cell=side * np.eye(3))
        r = whole_groups(chain, atoms)
        np.testing.assert_allclose(r - r[:, :1], x[atoms] - x[atoms][:, :1], atol=1e-10)
        # Rows take nearest images, so that such a body cannot be held.
        with pytest.raises(InputError, match="not shorter than half the box"):
            held_rows(chain, "none", rigid_water=False, rigid_bodies=[[0, 1, 22, 23]])
        assert held_rows(chain, "none", rigid_water=False, rigid_bodies=[list(range(5))])


def test_atoms_of_endless_molecules_are_lined_up():
    """A chain that ends in its own image has no place where it begins."""
    x = np.array([[1.5 * i, 0.0, 0.0] for i in range(8)])
    chain = snapshot(["C"] * 8, x, [(i, (i + 1) % 8) for i in range(8)], cell=12.0 * np.eye(3))
    r = whole_groups(chain, np.array([[0, 7, 6], [3, 4, 5]]))
    np.testing.assert_allclose(r[:, 1:] - r[:, :1], [[[-1.5, 0, 0], [-3, 0, 0]], [[1.5, 0, 0], [3, 0, 0]]], atol=1e-12)


# -- bonds by distance ------------------------------------------------------------------------------


SHORT = [[0, 0, 0], [1.05, 0, 0], [2.2, 0, 0]]  # a hydrogen bond: 1.05 and 1.15 angstrom to two oxygens
FAR = [[0, 0, 0], [2.0, 0, 0], [0, 1.95, 0]]


@pytest.mark.parametrize(
    ("elements", "x", "expected"),
    [
        ("O H H", WATER, [[0, 1], [0, 2]]),
        ("O H O", SHORT, [[0, 1]]),  # a hydrogen keeps its nearest neighbor
        ("H H", [[0, 0, 0], [0.74, 0, 0]], [[0, 1]]),
        ("H H", [[0, 0, 0], [1.0, 0, 0]], []),
        ("C Zn C", FAR, []),  # a metal, and 1.95 angstrom
        ("C Zn C", [*FAR[:2], [0, 1.85, 0]], [[0, 2]]),
    ],
)
def test_what_is_bonded(elements, x, expected):
    x = np.array(x, dtype=float)
    assert guess_bonds(snapshot(elements.split(), x)).tolist() == expected
    assert guess_bonds(snapshot(elements.split(), x / 10, angstrom=0.1)).tolist() == expected


def test_only_bonds_of_marked_atoms():
    x = np.concatenate([WATER, WATER + 5.0])
    marked = np.array([False] * 4 + [True, False])
    assert guess_bonds(snapshot(["O", "H", "H"] * 2, x), marked).tolist() == [[3, 4]]
    # The nearest neighbor of the hydrogen, which is not marked, may have its bonds already.
    assert guess_bonds(snapshot(["O", "H", "O"], SHORT), np.array([False, False, True])).tolist() == []


@pytest.mark.parametrize(
    "cell",
    [np.diag([9.0, 8.0, 10.0]), np.array([[9.0, 0, 0], [3.0, 8.0, 0], [-2.0, 2.5, 7.0]]), np.diag([3.2, 3.4, 3.3])],
    ids=["right-angled", "triclinic", "narrow"],
)
def test_bonds_across_the_cell_are_those_of_whole_molecules(cell):
    volume = abs(np.linalg.det(cell))
    count = max(1, int(volume / 60))
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)[:count] / 3
    x = ((grid + 0.05) @ cell)[:, None] + WATER @ rotations(count, 3)
    wrapped = x.reshape(-1, 3) @ np.linalg.inv(cell)
    wrapped = (wrapped - np.floor(wrapped)) @ cell
    # Any image will do, also those outside of the cell.
    wrapped += rng.integers(-2, 3, size=(3 * count, 3)) @ cell
    bonds = guess_bonds(snapshot(["O", "H", "H"] * count, wrapped, cell=cell))
    first = 3 * np.arange(count)
    expected = np.concatenate([np.stack([first, first + k], 1) for k in (1, 2)])
    assert sorted(map(tuple, bonds.tolist())) == sorted(map(tuple, expected.tolist()))


def test_what_cannot_be_guessed_is_refused():
    with pytest.raises(InputError, match="no elements"):
        guess_bonds(snapshot(["", ""], [[0, 0, 0], [1, 0, 0]]))
    with pytest.raises(InputError, match=r"C of MOL 1 \(atom 0\) and C of MOL 1 \(atom 1\) are 0.1 angstrom apart"):
        guess_bonds(snapshot(["C", "C"], [[0, 0, 0], [0.1, 0, 0]]))
    with pytest.raises(InputError, match="not finite"):
        guess_bonds(snapshot(["C", "C"], [[0, 0, 0], [np.nan, 0, 0]]))
