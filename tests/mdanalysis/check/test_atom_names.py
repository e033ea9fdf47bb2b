"""What atoms are called where a topology has names, and where it has none."""

import MDAnalysis
import numpy as np
import pytest

from kcons.mdanalysis.check.targets import AtomNames


@pytest.fixture
def universe():
    made = MDAnalysis.Universe.empty(7, n_residues=2, atom_resindex=[0, 0, 0, 1, 1, 1, 1], trajectory=True)
    return made


def test_names_of_atoms_and_rows(universe):
    universe.add_TopologyAttr("names", ["OW", "HW1", "HW2", "CA", "1HB", "'X", ""])
    universe.add_TopologyAttr("resnames", ["SOL", "ALA"])
    universe.add_TopologyAttr("resids", [12, 3])
    names = AtomNames(universe)
    assert names.atom(0) == "SOL12:OW" and names.atom(6) == "atom 6"
    assert names.row([0, 1]) == "SOL12:OW–HW1"
    assert names.row(np.array([2, 3, 4])) == "SOL12:HW2–ALA3:CA–1HB"
    assert names.row([6, 5]) == "atom 6–ALA3:'X"
    assert names.row(range(6)) == "SOL12:OW–HW1–HW2–ALA3:CA–…" and names.row([0, 1, 2], most=2) == "SOL12:OW–HW1–…"
    # No elements: the first letters of the names.
    assert names.elements.tolist() == ["O", "H", "H", "C", "H", "X", ""]


def test_elements_are_those_of_the_topology(universe):
    universe.add_TopologyAttr("names", ["CA"] * 7)
    universe.add_TopologyAttr("elements", ["Ca", "", "C", "C", "C", "C", "C"])
    assert AtomNames(universe).elements.tolist() == ["Ca", "C", "C", "C", "C", "C", "C"]


def test_elements_of_two_letters_are_told_by_names_and_masses(universe):
    """As everywhere: a rule for C-C is none for C-Cl."""
    universe.add_TopologyAttr("names", ["C1", "CL1", "7", "BR", "CA", "OW", "HW1"])
    universe.add_TopologyAttr("masses", [12.011, 35.45, 28.085, 79.904, 12.011, 15.999, 1.008])
    assert AtomNames(universe).elements.tolist() == ["C", "Cl", "Si", "Br", "C", "O", "H"]


def test_a_topology_that_says_nothing(universe):
    names = AtomNames(universe)
    assert names.atom(4) == "atom 4" and names.row([0, 4]) == "atom 0–atom 4"
    assert names.residues.tolist() == [""] * 7
