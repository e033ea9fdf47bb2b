"""Rows by name: what is held, what is said where a topology does not do, the options; rigid groups and sites."""

from __future__ import annotations

import inspect
import warnings
from dataclasses import fields, replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from snapshots import WATER, held_rows, rotations, snapshot

import kcons.ase
import kcons.mdanalysis
import kcons.openmm
from kcons.constraints import CenterOfMass
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.motion import Motion
from kcons.topology import Holding
from kcons.topology.rigid_groups import (
    GEOMETRIES,
    body_rows,
    find_waters,
    listed_bodies,
    water_rows,
)
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


def test_missing_bonds_are_guessed_and_said():
    with pytest.warns(UserWarning, match=r"^8 bonds were guessed from distances and covalent radii.*guess_bonds=False"):
        rows = held_rows(solution(()), "hangles")
    assert rows.bonds_guessed == 8
    with warnings.catch_warnings(action="error"):
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
    with warnings.catch_warnings(action="error"):
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
    """Nor are bonds held that a topology lists of them."""
    x, bonds = np.vstack([WATER, 0.128 * (WATER[1] + WATER[2])]), [(0, 1), (0, 2), (0, 3)]
    made = snapshot(["O", "H", "H", ""], x, bonds, names=["OW", "HW1", "HW2", "MW"], residue_names=["SOL"])
    rows = held_rows(made, "hangles")
    assert len(rows.virtual_sites) == 1
    assert Motion(rows.constraint_set, made.positions).degrees_of_freedom == 6
    assert counts(held_rows(made, "hangles", rigid_water=False)) == {"Distance": 2, "Angle": 1}


def test_water_whose_hydrogens_are_listed_as_bonded_is_a_rigid_body():
    """PSF files of TIP3P list H-H; as a bond it would be torn."""
    made = snapshot(["O", "H", "H"], WATER, [(0, 1), (0, 2), (1, 2)], residue_names=("TIP3",))
    assert counts(held_rows(made, "none", rigid_water=False, rigid_bodies=[[0, 1, 2]])) == {"Distance": 3}


def test_no_masses_no_hydrogens_and_torn_molecules():
    with pytest.raises(InputError, match=r"C of EOH 1 \(atom 0\) has no mass, as 11 other atoms; held atoms need"):
        held_rows(solution(masses=np.zeros(12)), "allbonds")
    with pytest.raises(InputError, match="there are no hydrogens; add them"):
        held_rows(snapshot(["C", "C"], [[0, 0, 0], [1.5, 0, 0]], [(0, 1)]), "hbonds")
    with pytest.raises(InputError, match="bonds with a hydrogen are none; give a file that has them"):
        held_rows(snapshot(["H", "C", "C"], np.eye(3), [(1, 2)]), "hbonds")
    torn = [[0.0, 0, 0], [28.5, 0, 0]]
    with pytest.raises(InputError, match=r"28.5 angstrom apart; give the periodic cell"):
        held_rows(snapshot(["C", "C"], torn, [(0, 1)]), "allbonds")
    whole = held_rows(snapshot(["C", "C"], torn, [(0, 1)], cell=np.eye(3) * 30), "allbonds")
    assert whole[0].target == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("atom", "shift", "said", "options"),
    [
        (10, 26.0, r"H of HOH 2 \(atom 10\) are bonded and 27 angstrom apart; give the periodic cell", {}),
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


# -- rigid water, residues and bodies: rank, all distances, flat groups, compositions; sites ----------


RNG = np.random.default_rng(11)
SHAPES = {
    "pair": (np.array([[0.0, 0, 0], [1.1, 0, 0]]), 1),
    "line of three": (np.array([[-1.16, 0, 0], [0, 0, 0], [1.16, 0, 0]]), 3 * 3 - 5),
    "line of five": (np.outer([0, 1.2, 2.5, 3.6, 5.0], [0.6, 0.8, 0.0]), 3 * 5 - 5),
    "bent": (WATER, 3),
    "hexagon": (1.4 * np.array([[np.cos(a), np.sin(a), 0] for a in np.arange(6) * np.pi / 3]), 3 * 6 - 6),
    "square": (np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), 3 * 4 - 6),
    "tetrahedron": (np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), 6),
    "cloud": (2 * RNG.normal(size=(30, 3)), 3 * 30 - 6),
    "large cloud": (4 * RNG.normal(size=(80, 3)), 3 * 80 - 6),
    "sheet with one atom above": (
        np.array([*[[1.4 * i, 1.4 * j, 0.0] for i in range(8) for j in range(7)], [5.0, 4.0, 3.0]]),
        3 * 57 - 6,
    ),
    "pyramid": (np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0.2, 0.1, 0]]), 3 * 6 - 6),
}


def moved(x, count=3, seed=5):
    """Copies turned and apart."""
    return np.concatenate([x @ q + 20 * k for k, q in enumerate(rotations(count, seed))])


@pytest.mark.parametrize("name", list(SHAPES))
def test_rows_hold_all_distances_of_bodies(name):
    shape, rows_each = SHAPES[name]
    n = len(shape)
    x = moved(shape)
    made = snapshot(["C"] * len(x), x)
    groups = [np.arange(len(x)).reshape(3, n)]
    held = ConstraintSet(body_rows(made, groups), x, made.topology.masses)
    assert held.n_rows == 3 * rows_each
    motion = Motion(held, x)
    assert motion.rank == held.n_rows  # regular, also where flat
    assert np.abs(held.value(x)).max(initial=0.0) < 1e-12
    # A rigid motion keeps the rows; and what the rows keep is rigid.
    shaken = motion.project_positions(x + 0.02 * RNG.normal(size=x.shape), x)
    for k in range(3):
        body = slice(k * n, (k + 1) * n)
        np.testing.assert_allclose(pdist(shaken[body]), pdist(x[body]), rtol=0, atol=1e-10)


def test_no_atom_of_a_large_body_takes_part_in_many_rows():
    x = 6 * RNG.normal(size=(300, 3))
    (rows,) = body_rows(snapshot(["C"] * 300, x), [np.arange(300)[None]])
    assert rows.family == "Distance" and rows.n_rows == 3 * 300 - 6
    assert np.bincount(rows.atoms.ravel()).max() <= 60


def test_a_ring_out_of_a_file_is_held_flat():
    ring, rows = SHAPES["hexagon"]
    x = np.round(ring @ rotations(1, 2)[0] + 31.7, 3)
    held = ConstraintSet(body_rows(snapshot(["C"] * 6, x), [np.arange(6)[None]]), x, np.full(6, 12.0))
    assert held.n_rows == rows
    on = Motion(held, x).restore_positions(x)
    assert np.abs(on - x).max() < 2e-3  # the three decimals
    y = on - on.mean(axis=0)
    assert np.linalg.svd(y, compute_uv=False)[2] < 1e-12


def test_bodies_that_share_an_edge_hold_it_once():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.2, 1.0]])
    rows = body_rows(snapshot(["C"] * 4, x), listed_bodies(snapshot(["C"] * 4, x), [[0, 1, 2], [0, 1, 3]]))
    assert sum(r.n_rows for r in rows) == 5


def test_four_site_water_with_its_site_placed():
    m = 0.15 * (WATER[1] + WATER[2]) / np.linalg.norm(WATER[1] + WATER[2])
    molecule = np.vstack([WATER, m])
    x = np.round(moved(molecule), 3)
    made = snapshot(
        ["O", "H", "H", ""] * 3,
        x,
        names=["OW", "HW1", "HW2", "MW"] * 3,
        residues=np.repeat([0, 1, 2], 4),
        residue_names=["SOL"] * 3,
    )
    waters = find_waters(made)
    np.testing.assert_array_equal(waters.triples, [[0, 1, 2], [4, 5, 6], [8, 9, 10]])
    assert waters.sites.sites.tolist() == [3, 7, 11]
    # Published: 0.128012065 for TIP4P, up to the decimals of the file.
    np.testing.assert_allclose(waters.sites.coefficients, [[0.128012065, 0.128012065, 0.0]] * 3, atol=2e-3)
    assert water_rows(waters.triples, None).n_rows == 9


def lone_pairs(mirrored, n=2):
    """Waters of TIP5P; in those that are mirrored the lone pairs have each other's names."""
    behind = -0.35 * (WATER[1] + WATER[2])
    pairs = np.array([[*behind[:2], 0.57], [*behind[:2], -0.57]])
    x = np.concatenate([np.vstack([WATER, pairs[::-1] if k in mirrored else pairs]) + 5.0 * k for k in range(n)])
    names, elements = ["OW", "HW1", "HW2", "LP1", "LP2"] * n, ["O", "H", "H", "", ""] * n
    return snapshot(elements, x, names=names, residues=np.repeat(range(n), 5), residue_names=["SOL"] * n)


@pytest.mark.parametrize("mirrored", [(), (1,), (0, 1, 2), (1, 3)])
def test_lone_pairs_stay_on_their_sides_in_every_molecule(mirrored):
    """A median over molecules of both kinds, whose heights are opposite, would put them into the plane."""
    made = lone_pairs(mirrored, 4)
    placed = find_waters(made).sites.place(made.positions)
    height = abs(placed[3::5, 2] - placed[4::5, 2])
    np.testing.assert_allclose(height, 1.14, atol=1e-12)
    np.testing.assert_allclose(placed, made.positions, atol=1e-12)


@pytest.mark.parametrize("model", ["tip4p", "tip4p2005", "opc"])
def test_the_site_of_a_model_is_where_the_model_has_it_in_its_own_geometry(model):
    m = 0.15 * (WATER[1] + WATER[2]) / np.linalg.norm(WATER[1] + WATER[2])
    made = snapshot(["O", "H", "H", ""], np.vstack([WATER, m]), names=["O", "H1", "H2", "M"], residue_names=["HOH"])
    rows = held_rows(made, "none", water_geometry=model)
    length, angle, away = GEOMETRIES[model]
    half = np.radians(angle / 2)
    sides = length * np.array([[np.sin(half), np.cos(half), 0.0], [-np.sin(half), np.cos(half), 0.0]])
    placed = rows.virtual_sites.place(np.vstack([np.zeros(3), sides, m]))
    np.testing.assert_allclose(placed[3], [0.0, away, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("atom", "place", "what"),
    [
        (1, [0, 0, 0], "no plane"),
        (2, [np.nan] * 3, "no plane"),
        (3, [8, 8, 8], "13.9 angstrom"),
        (4, [np.nan] * 3, "nan"),
    ],
)
def test_sites_that_cannot_be_placed_are_refused(atom, place, what):
    made = lone_pairs((), 1)
    made.positions[atom] = place
    with pytest.raises(InputError, match=what) as caught:
        find_waters(made)
    assert caught.value.item == "positions"


def test_particles_with_mass_are_no_sites():
    """The Drude particle of SWM4 moves by itself; as a site it would be placed on its oxygen for ever."""
    x = [*WATER, [0.14, 0.19, 0.0], [0.01, 0.0, 0.0]]
    names = ["OH2", "H1", "H2", "OM", "DOH2"]
    masses = [15.5994, 1.008, 1.008, 0.0, 0.4]
    made = snapshot(["O", "H", "H", "", ""], x, names=names, residue_names=("SWM4",), masses=masses)
    with pytest.raises(InputError, match="1 oxygens and 2 hydrogens and 1 with mass besides; rename it"):
        find_waters(made, frozenset({"SWM4"}))


def test_oxygens_alone_are_left_and_odd_waters_named():
    assert not len(find_waters(snapshot(["O"], WATER[:1], residue_names=["HOH"])).triples)
    with pytest.raises(InputError, match=r"residue HOH 1 \(atoms 0 to 1\).*1 oxygens and 1 hydrogens; rename it"):
        find_waters(snapshot(["O", "H"], WATER[:2], residue_names=["HOH"]))


def test_sites_in_other_units():
    """Lone pairs as they are: heights are lengths, their coefficients are not."""
    made = lone_pairs(())
    sites, x = find_waters(made).sites, made.positions
    np.testing.assert_allclose(sites.in_unit(0.1).place(x / 10), x / 10, atol=1e-14)
