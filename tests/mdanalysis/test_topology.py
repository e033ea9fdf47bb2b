"""Universes: selections, real topologies, four-site water, and a million atoms' worth of arrays."""

from __future__ import annotations

import warnings
from io import StringIO

import ase
import MDAnalysis as mda
import numpy as np
import pytest
from host_systems import VILLIN, quietly, read_universe

from kcons.constraints import CenterDistance, CenterOfMass, Sphere
from kcons.errors import InputError
from kcons.mdanalysis import ConstraintCheck, constraints_of, selected, snapshot_of, to_ase


@pytest.fixture(scope="module")
def villin():
    return read_universe(VILLIN)


def waters(count, names=("OW", "HW1", "HW2"), **attributes):
    """A Universe of water without coordinates that mean anything."""
    width = len(names)
    universe = mda.Universe.empty(
        count * width, n_residues=count, atom_resindex=np.repeat(np.arange(count), width), trajectory=True
    )
    given = {"names": list(names) * count, "resnames": ["SOL"] * count, "resids": np.arange(count) + 1}
    for name, values in (given | attributes).items():
        universe.add_TopologyAttr(name, values)
    rng = np.random.default_rng(0)
    angle = np.radians(109.47)
    shape = np.array([[0, 0, 0], [1, 0, 0], [np.cos(angle), np.sin(angle), 0], [0.1, 0.15, 0]])[:width]
    universe.atoms.positions = (shape + rng.uniform(0, 90, size=(count, 1, 3))).reshape(-1, 3)
    return universe


def without_elements(atoms):
    """A Universe of a PDB file that has no column of elements, of (name, residue, number); one atom each 3 angstrom."""
    lines = [
        f"ATOM  {k + 1:5d} {name:>4s} {residue:4s}A{number:4d}    {3.0 * k:8.3f}   0.000   0.000  1.00  0.00"
        for k, (name, residue, number) in enumerate(atoms)
    ]
    with warnings.catch_warnings(action="ignore"):
        return mda.Universe(StringIO("\n".join([*lines, "END\n"])), format="PDB")


def test_guessed_masses_are_those_of_the_elements():
    """MDAnalysis takes the nitrogen NA of a porphyrin for sodium, selenium for sulfur, calcium for carbon."""
    atoms = [(name, "HEM", 1) for name in ("NA", "SE", "CD", "EPW", "D1", "HG")]
    universe = without_elements([*atoms, ("CA", "CA", 2), ("LI", "LI", 3), ("SOD", "SOD", 4)])
    topology = snapshot_of(universe).topology
    assert topology.elements.tolist() == ["N", "Se", "C", "", "H", "H", "Ca", "Li", "Na"]
    standard = [14.007, 78.97, 12.011, 0.0, 2.014, 1.008, 40.08, 6.94, 22.99]
    np.testing.assert_allclose(topology.masses, standard, atol=0.01)
    # Those that somebody set stay.
    universe = without_elements([(name, "SER", 1) for name in ("NA", "HG", "CD")])
    universe.atoms.masses = [9.0, 3.024, 12.0]
    assert snapshot_of(universe).topology.masses.tolist() == [9.0, 3.024, 12.0]


def test_selections_in_words(villin):
    protein = villin.select_atoms("protein")
    np.testing.assert_array_equal(selected(villin, "protein"), protein.indices)
    rows = quietly(constraints_of, villin, "none", rigid_water=False, on={
        "protein": CenterOfMass,
        "name CA and resid 1:3": lambda atoms: Sphere(atoms, [0.0, 0.0, 0.0]),
        "resid 1": lambda atoms: CenterDistance(atoms, selected(villin, "protein and resid 30")),
    })  # fmt: skip
    masses = protein.masses[:, None]
    np.testing.assert_allclose(rows[0].target, (masses * protein.positions).sum(0) / masses.sum(), atol=1e-4)
    assert [item.family for item in rows] == ["CenterOfMass", "Sphere", "CenterDistance"]
    assert rows[1].n_rows == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("resname HIX", r"matches nothing: no resname HIX \(did you mean 'HI"),
        ("name CAA", "matches nothing: no name CAA"),
        ("resid 9999", "matches nothing; residues are numbered 1 to"),
        ("resname and and", "cannot be read"),
        ("name N and name O", "matches nothing; names are those of the topology"),
    ],
)
def test_selections_that_match_nothing_say_what_there_is(villin, words, said):
    with pytest.raises(InputError, match=said):
        selected(villin, words)
    with pytest.raises(InputError, match=said):
        constraints_of(villin, "hbonds", select=words)


def test_a_universe_without_coordinates_or_masses():
    bare = mda.Universe.empty(3, n_residues=1, atom_resindex=[0, 0, 0])
    bare.add_TopologyAttr("names", ["OW", "HW1", "HW2"])
    bare.add_TopologyAttr("resnames", ["SOL"])
    with pytest.raises(InputError, match="has no coordinates"):
        constraints_of(bare)
    with pytest.raises(InputError, match=r"OW of SOL 1 \(atom 0\) has no mass"):
        constraints_of(waters(2), "none")


@pytest.mark.parametrize("call", [constraints_of, snapshot_of, to_ase])
def test_what_is_no_universe_and_an_atom_that_is_twice_in_a_group_are_refused(villin, call):
    for given in ([villin], None, villin.atoms[0], ase.Atoms("H2")):
        said = f"must be a Universe or AtomGroup, .* not {type(given).__name__}"
        with pytest.raises(InputError, match=said) as caught:
            call(given)
        assert caught.value.item == "universe"
    part = villin.residues[:2]
    assert snapshot_of(part).topology.n_atoms == len(part.atoms)
    made = waters(2, masses=[15.9994, 1.008, 1.008] * 2)
    with pytest.raises(InputError, match=r"atom 1 of its Universe twice, .* in place 3; take group.unique"):
        call(made.atoms[[0, 1, 2, 1, 3, 4, 5]])
    assert constraints_of(made.atoms[[5, 0, 1, 2, 4, 3]], "none").constraint_set.n_rows == 6


def test_alternate_locations_of_one_atom_are_refused():
    """A second hydrogen, 0.5 angstrom from the first, was another atom and took its row."""
    atoms = [("O", " ", 0.0, 0.0), ("H1", "A", 0.957, 0.0), ("H1", "B", 0.8, 0.5), ("H2", " ", -0.24, 0.927)]
    lines = [
        f"ATOM  {k:5d}  {name:<3s}{place}HOH A   1    {x:8.3f}{y:8.3f}{0.0:8.3f}  1.00  0.00           {name[0]}  "
        for k, (name, place, x, y) in enumerate(atoms, 1)
    ]
    universe = mda.Universe(StringIO("\n".join([*lines, "END"])), format="PDB")
    with pytest.raises(InputError, match=r"H1 of HOH 1 .*A and B: give one .*select_atoms\('not altloc B'\)") as caught:
        constraints_of(universe)
    assert caught.value.atoms == (1, 2)
    assert constraints_of(universe.select_atoms("not altloc B")).constraint_set.n_rows == 3


def test_sites_without_mass_are_found_by_mass_and_name():
    masses = np.array([15.9994, 1.008, 1.008, 0.0] * 3)
    rows = constraints_of(waters(3, ("OW", "HW1", "HW2", "MW"), masses=masses), "hbonds")
    assert rows.virtual_sites.sites.tolist() == [3, 7, 11]
    assert rows.constraint_set.n_rows == 9


def test_topologies_of_adenylate_kinase():
    files = pytest.importorskip("MDAnalysisTests.datafiles")
    for topology, coordinates in ((files.PSF, files.CRD), (files.PDB_small, None)):
        universe = read_universe(topology, *([coordinates] if coordinates else []))
        rows = quietly(constraints_of, universe, "hangles")
        # Counted in the PSF: 3365 bonds; 1685 of them with hydrogen.
        assert [item.n_rows for item in rows] == [3365, 817]
        assert quietly(constraints_of, universe, "hbonds").constraint_set.n_rows == 1685
    universe = read_universe(files.TPR, files.GRO)
    rows = constraints_of(universe, "hbonds")
    assert rows.bonds_guessed == 0
    assert len(rows.virtual_sites) == 11084
    np.testing.assert_allclose(rows.virtual_sites.coefficients[0], [0.128, 0.128, 0.0], atol=2e-3)
    guessed = quietly(constraints_of, read_universe(files.GRO), "hbonds")
    for one, two in zip(rows, guessed, strict=True):
        np.testing.assert_array_equal(one.atoms, two.atoms)
        np.testing.assert_allclose(one.target, two.target, rtol=0, atol=1e-10)


def test_selections_may_be_groups(villin):
    protein = villin.select_atoms("protein")
    few = protein[10:60]
    for holder in (villin, protein):
        by_words = quietly(constraints_of, holder, select="index 10:59", on={"index 10:59": CenterOfMass})
        by_group = quietly(constraints_of, holder, select=few, on=[(few, CenterOfMass)])
        assert repr(by_words) == repr(by_group)
        for one, two in zip(by_words, by_group, strict=True):
            np.testing.assert_array_equal(one.atoms, two.atoms)
        bodies = [quietly(constraints_of, holder, "none", rigid_bodies=b) for b in ("index 10:59", [few])]
        np.testing.assert_array_equal(bodies[0][0].atoms, bodies[1][0].atoms)


def test_selections_that_are_neither_words_nor_groups_of_these_atoms(villin):
    protein = villin.select_atoms("protein")
    for wrong in ([0, 1, 2], np.arange(len(protein)) < 50, (0, 1)):
        with pytest.raises(InputError, match=r"give words of MDAnalysis, .*or an AtomGroup") as caught:
            quietly(constraints_of, protein, select=wrong)
        assert caught.value.item == "select" and len(str(caught.value)) < 200
    for group in (villin.atoms[-3:], protein[:0], read_universe(VILLIN).atoms[:3]):
        with pytest.raises(InputError, match="give some of the atoms of <AtomGroup with 582 atoms>"):
            quietly(constraints_of, protein, select=group)


def test_coordinates_left_in_nanometres_are_refused(tmp_path):
    """Rows would hold O-H at 0.1 angstrom."""
    path = tmp_path / "w.gro"
    made = waters(3)
    made.dimensions = [90.0] * 6
    quietly(made.atoms.write, str(path))
    universes = [quietly(mda.Universe, str(path), convert_units=convert) for convert in (True, False)]
    rows = constraints_of(universes[0])
    with pytest.raises(InputError, match=r"positions are in nm, .* convert_units=False; make it without"):
        constraints_of(universes[1])
    with pytest.raises(InputError, match="positions are in nm"):
        ConstraintCheck(universes[1], list(rows))
