"""Rows by name: what is held, in which order, what is said where a topology does not do, and the options."""

from __future__ import annotations

import inspect
import warnings
from dataclasses import fields, replace
from itertools import combinations

import numpy as np
import pytest
from snapshots import WATER, held_rows, snapshot

import kcons.ase
import kcons.mdanalysis
import kcons.openmm
from kcons.constraints import CenterOfMass
from kcons.errors import InputError
from kcons.motion import Motion
from kcons.topology import Holding
from kcons.topology.rows_by_name import Options

# Ethanol, C C O H(O) and five H, and a water.
ETHANOL = np.array(
    [
        [1.1879, -0.3829, 0.0], [0.0, 0.5526, 0.0], [-1.1867, -0.2472, 0.0], [-1.9237, 0.385, 0.0],
        [2.0985, 0.2306, 0.0], [1.1184, -1.0093, 0.8869], [1.1184, -1.0093, -0.8869], [-0.0227, 1.1812, 0.8852],
        [-0.0227, 1.1812, -0.8852],
    ]
)  # fmt: skip
BONDS = [(0, 1), (1, 2), (2, 3), (0, 4), (0, 5), (0, 6), (1, 7), (1, 8)]


def solution(bonds=(*BONDS, (9, 10), (9, 11)), **options):
    return snapshot(
        ["C", "C", "O", "H", "H", "H", "H", "H", "H", "O", "H", "H"],
        np.concatenate([ETHANOL, WATER + 4.0]),
        bonds,
        residues=[0] * 9 + [1] * 3,
        residue_names=["EOH", "HOH"],
        **options,
    )


def counts(rows):
    return {item.family: sum(i.n_rows for i in rows if i.family == item.family) for item in rows}


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("none", {"Distance": 3}),
        ("hbonds", {"Distance": 6 + 3}),
        ("allbonds", {"Distance": 8 + 3}),
        # H-C-H: 3 of the methyl, 1 of the methylene; H-O-C.
        ("hangles", {"Distance": 8 + 3, "Angle": 5}),
        # Five of the six angles of each carbon, C-O-H.
        ("allangles", {"Distance": 8 + 3, "Angle": 5 + 5 + 1}),
    ],
)
def test_what_is_held_by_name(kind, expected):
    assert counts(held_rows(solution(), kind)) == expected


def test_flexible_water_has_bonds_and_an_angle():
    assert counts(held_rows(solution(), "hangles", rigid_water=False)) == {"Distance": 10, "Angle": 6}
    with_third = solution((*BONDS, (9, 10), (9, 11), (10, 11)))  # as CHARMM and Amber list it
    assert counts(held_rows(with_third, "hangles", rigid_water=False)) == {"Distance": 10, "Angle": 6}


def test_missing_bonds_are_guessed_and_said():
    with pytest.warns(UserWarning, match=r"^8 bonds were guessed from distances and covalent radii.*guess_bonds=False"):
        rows = held_rows(solution(()), "hangles")
    assert rows.bonds_guessed == 8
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = held_rows(solution(), "hangles")
    for one, two in zip(rows, expected, strict=True):
        np.testing.assert_array_equal(one.atoms, two.atoms)
    with pytest.warns(UserWarning, match="^1 bonds were guessed"):
        held_rows(solution([*BONDS[:-1]]), "allbonds")
    assert held_rows(solution(), "hbonds", guess_bonds=True).bonds_guessed == 8  # asked for: no warning
    with pytest.raises(InputError, match=r"no bonds of C of EOH 1 \(atom 0\), nor have 8 others; give a topology"):
        held_rows(solution(()), "hbonds", guess_bonds=False)


def test_hydrogens_that_get_no_bond_are_told():
    """Water across a face of a cell that the file does not give."""
    cut = snapshot(["O", "H", "H"], WATER + np.array([[0, 0, 0], [0, 0, 0], [12.0, 0, 0]]))
    cut = replace(cut, topology=replace(cut.topology, residues_known=False))
    with pytest.warns(UserWarning) as caught:
        rows = held_rows(cut, "hbonds", remedy="give bonds")
    texts = [str(w.message) for w in caught]
    assert len(texts) == 2 and texts[1] == (
        "no bond was guessed for 1 hydrogens, the first of which is H (atom 2): nothing holds them; give the cell, at "
        "whose faces molecules may be cut, or give bonds"
    )
    assert rows.loose_hydrogens.tolist() == [2] and counts(rows) == {"Distance": 1}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = replace(cut, cell=np.diag([12.0] * 3), pbc=np.ones(3, dtype=bool))
        assert not len(held_rows(whole, "hbonds", guess_bonds=True).loose_hydrogens)
        # Not among the atoms that are asked for; an ion of its own residue.
        assert not len(held_rows(cut, "hbonds", guess_bonds=True, select=np.array([True, True, False])).loose_hydrogens)
        known = replace(cut.topology, residues=np.array([0, 0, 1]), residue_names=np.array(["OH", "H"]))
        known = replace(known, residue_ids=np.array(["1", "2"]), chains=np.full(2, ""), residues_known=True)
        assert not len(held_rows(replace(cut, topology=known), "hbonds", guess_bonds=True).loose_hydrogens)


def test_without_residues_molecules_are_found():
    made = solution()
    made = replace(made, topology=replace(made.topology, residues_known=False))
    assert counts(held_rows(made, "hbonds")) == {"Distance": 9}
    rows = held_rows(made, "none", rigid_residues=["C2H6O"])
    assert Motion(rows.constraint_set, made.positions).degrees_of_freedom == 12


def test_rigid_residues_and_bodies_replace_bonds_inside():
    rows = held_rows(solution(), "allbonds", rigid_residues=["EOH"])
    motion = Motion(rows.constraint_set, rows.snapshot.positions)
    assert motion.rank == rows.constraint_set.n_rows == 3 * 9 - 6 + 3
    rows = held_rows(solution(), "allbonds", rigid_bodies=[[0, 4, 5, 6]])
    pairs = {tuple(p) for item in rows if item.family == "Distance" for p in item.atoms.tolist()}
    assert set(combinations([0, 4, 5, 6], 2)) <= pairs
    assert len(pairs) == 5 + 6 + 3


def test_rows_on_selections_and_their_names():
    rows = held_rows(solution(), "none", on=[(np.arange(9), CenterOfMass)])
    assert counts(rows) == {"Distance": 3, "CenterOfMass": 3}
    assert rows.row_name(1) == "#1 Distance: O of HOH 2 (atom 9), H of HOH 2 (atom 11)"
    assert rows.summary() == "3 Distance, 3 CenterOfMass; 6 rows on 12 atoms"


def test_virtual_sites_are_no_degrees_of_freedom():
    m = 0.128 * (WATER[1] + WATER[2])
    made = snapshot(["O", "H", "H", ""], np.vstack([WATER, m]), names=["OW", "HW1", "HW2", "MW"], residue_names=["SOL"])
    rows = held_rows(made, "hangles")
    assert len(rows.virtual_sites) == 1
    assert Motion(rows.constraint_set, made.positions).degrees_of_freedom == 6


def test_water_whose_hydrogens_are_listed_as_bonded_is_a_rigid_body():
    """PSF files of TIP3P list H-H; as a bond it would be torn."""
    made = snapshot(["O", "H", "H"], WATER, [(0, 1), (0, 2), (1, 2)], residue_names=("TIP3",))
    rows = held_rows(made, "none", rigid_water=False, rigid_bodies=[[0, 1, 2]])
    assert counts(rows) == {"Distance": 3}


def test_no_masses_no_hydrogens_and_torn_molecules():
    with pytest.raises(InputError, match=r"C of EOH 1 \(atom 0\) has no mass, as 11 other atoms; held atoms need"):
        held_rows(solution(masses=np.zeros(12)), "allbonds")
    with pytest.raises(InputError, match="there are no hydrogens; add them"):
        held_rows(snapshot(["C", "C"], [[0, 0, 0], [1.5, 0, 0]], [(0, 1)]), "hbonds")
    torn = [[0.0, 0, 0], [28.5, 0, 0]]
    with pytest.raises(InputError, match=r"28.5 angstrom apart; give the periodic cell"):
        held_rows(snapshot(["C", "C"], torn, [(0, 1)]), "allbonds")
    whole = held_rows(snapshot(["C", "C"], torn, [(0, 1)], cell=np.eye(3) * 30), "allbonds")
    assert whole[0].target == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("atom", "shift", "said", "options"),
    [
        (
            10,
            26.0,
            r"H of HOH 2 \(atom 10\) are bonded and 27 angstrom apart; give the periodic cell",
            {},
        ),
        (10, 6.0, "give the periodic cell", {"water_geometry": "TIP3P"}),
        (0, 26.0, r"C of EOH 1 \(atom 0\) and C of EOH 1 \(atom 1\)", {"rigid_residues": ["EOH"]}),
        (0, 26.0, r"C of EOH 1 \(atom 0\) and C of EOH 1 \(atom 1\)", {"rigid_bodies": [np.arange(4)]}),
    ],
)
def test_bodies_that_a_missing_cell_tears_are_refused(atom, shift, said, options):
    made = solution()
    x = made.positions.copy()
    x[atom, 0] += shift
    with pytest.raises(InputError, match=said):
        held_rows(replace(made, positions=x), "none", **options)
    held_rows(replace(made, positions=x, cell=np.diag([shift, 40.0, 40.0]), pbc=np.full(3, True)), "none", **options)


# -- the options, the same in every MD engine -------------------------------------------------------


ENGINES = [kcons.ase.constraints_of, kcons.mdanalysis.constraints_of, kcons.openmm.constraints_of]


def test_options_of_the_signature_are_those_of_the_object():
    assert {field.name for field in fields(Holding)} == {"constrain", *Options.__annotations__}


@pytest.mark.parametrize("function", ENGINES, ids=lambda f: f.__module__)
def test_help_shows_every_option_with_its_default(function):
    shown = inspect.signature(function).parameters
    page = inspect.getdoc(function)
    assert "**options" not in page
    for field in fields(Holding):
        assert shown[field.name].default == field.default
        assert page.count(f"\n{field.name} : ") == 1
    # The parameters of the function itself come first, what it returns and raises last.
    assert page.index("rigid_water :") > page.index("Parameters\n")
    assert page.index("guess_bonds :") < page.index("Returns\n") < page.index("Raises\n")


def test_iterables_are_read_once():
    holding = Holding("none", rigid_bodies=iter([[0, 1, 2]]), rigid_residues=iter(["HOH"]), rigid_water=False)
    assert holding.bodies == holding.bodies == ([0, 1, 2],)
    assert holding.residues == holding.residues == ("HOH",)
    assert Holding("none", rigid_residues="HOH").residues == ("HOH",)


def test_geometry_of_water():
    rows = held_rows(solution(), "none", water_geometry="SPC/E")
    np.testing.assert_allclose(rows[0].target, [1.0, 1.0, np.sqrt(8 / 3)])
    assert Holding().geometry() == (None, 0.0)
    assert Holding(water_geometry="TIP4P/2005").geometry() == ((0.9572, 104.52), 0.1546)
    assert Holding(water_geometry=(1, 109)).geometry() == ((1.0, 109.0), 0.0)
    assert Holding(rigid_water=False).waters == frozenset()
    assert "MINE" in Holding(water_names=[" mine "]).waters
