"""Atoms as molecules with names, residues, bonds and elements, and back; what is water, and what only looks like it."""

from __future__ import annotations

import warnings

import ase.io
import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk, molecule

from kcons.ase import constrain, constraints_of, repartition_hydrogen_mass, rigid_water
from kcons.ase.topology import atoms_of, bonds_of, repair_elements, snapshot_of, velocities_of
from kcons.constraints import Dihedral
from kcons.errors import InputError


def peptide():
    """A residue with names, as ASE reads them from a PDB file: mercury for HG, calcium for CA."""
    atoms = Atoms("NCaCHg", positions=[[0, 0, 0], [1.45, 0, 0], [2.0, 1.4, 0], [1.8, -1.0, 0.3]])
    atoms.new_array("atomtypes", np.array(["N", "CA", "C", "HG"]))
    atoms.new_array("residuenames", np.array(["SER"] * 4))
    atoms.new_array("residuenumbers", np.array([4] * 4))
    return atoms


def test_bonds_are_guessed_where_none_are_given():
    assert bonds_of(molecule("CH3CH2OH")).shape == (8, 2)
    atoms = molecule("H2O")
    atoms.info["bonds"] = [[0, 2]]
    assert bonds_of(atoms).tolist() == [[0, 2]]
    assert bonds_of(Atoms("X2", positions=[[0, 0, 0], [1, 0, 0]])).shape == (0, 2)
    both = atoms + molecule("CH3OH")  # info of a sum is that of the first
    both.positions[3:] += 8.0
    assert bonds_of(both).tolist() == [[0, 2], [3, 4], [3, 5], [3, 7], [3, 8], [4, 6]]
    constrain(both, Dihedral([[5, 3, 4, 6]], 1.0), project=True)
    assert both.get_distance(4, 6) == pytest.approx(molecule("CH3OH").get_distance(1, 3), abs=1e-9)
    atoms.info["bonds"] = [[0, 3]]
    for asked in (bonds_of, constraints_of):
        with pytest.raises(InputError, match=r"atoms\.info\['bonds'\].* atom 3"):
            asked(atoms)


def test_a_molecule_that_ase_wrote_to_a_pdb_file_keeps_its_bonds(tmp_path):
    """ASE writes symbols for names, so that a name comes again and again in one residue."""
    atoms = molecule("CH3CH2OH")
    ase.io.write(tmp_path / "ethanol.pdb", atoms)
    back = ase.io.read(tmp_path / "ethanol.pdb")
    for held in ("hbonds", "allbonds"):
        rows, wanted = (constraints_of(each, held, guess_bonds=True) for each in (back, atoms))
        assert rows[0].atoms.tolist() == wanted[0].atoms.tolist()
        with pytest.warns(UserWarning, match="8 bonds were guessed"):
            assert constraints_of(back, held)[0].n_rows == rows[0].n_rows


def test_names_say_what_elements_are():
    atoms = peptide()
    with pytest.warns(UserWarning, match="2 atoms have elements that their names contradict, such as CA of SER"):
        topology = snapshot_of(atoms).topology
    assert topology.elements.tolist() == ["N", "C", "C", "H"]
    assert topology.masses[1] == pytest.approx(12.011) and topology.masses[3] == pytest.approx(1.008)
    assert atoms.symbols[1] == "Ca"  # until they are mended
    assert repair_elements(atoms) == 2 and str(atoms.symbols) == "NC2H"
    with warnings.catch_warnings(action="error"):
        assert repair_elements(atoms) == 0
    other = peptide()
    other.set_masses([14.0, 99.0, 12.0, 98.0])
    with pytest.warns(UserWarning):
        assert snapshot_of(other).topology.masses.tolist() == [14.0, 99.0, 12.0, 98.0]


def test_metals_of_a_file_with_elements_stay():
    """Cobalt is no carbon where CA is one; a mercury is a hydrogen still."""
    atoms = peptide()
    atoms.symbols = "NCCoHg"
    atoms.arrays["atomtypes"][2] = "CO"
    with pytest.warns(UserWarning, match="1 elements are not what names suggest, such as Co of CO") as told:
        assert repair_elements(atoms) == 1
    assert str(atoms.symbols) == "NCCoH" and len(told) == 1
    with pytest.warns(UserWarning, match="they are left"):
        assert snapshot_of(atoms).topology.elements[2] == "Co"
    atoms.symbols[1] = "Ca"  # nothing says that elements were in a file
    assert repair_elements(atoms) == 2 and str(atoms.symbols) == "NC2H"


def test_there_and_back():
    atoms = peptide()
    repair_elements(atoms)
    atoms.new_array("chainids", np.array(["B"] * 4))
    atoms.info["bonds"] = np.array([[0, 1], [1, 2]])
    atoms.set_initial_charges([0.1, 0.2, -0.3, 0.0])
    atoms.set_cell([10.0, 11.0, 12.0])
    atoms.pbc = [True, False, True]
    atoms.set_velocities(np.random.default_rng(1).normal(size=(4, 3)))
    back = atoms_of(snapshot_of(atoms))
    assert str(back.symbols) == str(atoms.symbols) and back.pbc.tolist() == [True, False, True]
    for name in ("atomtypes", "residuenames", "residuenumbers", "chainids"):
        assert back.arrays[name].tolist() == atoms.arrays[name].tolist()
    read = Atoms.get_positions, Atoms.get_cell, Atoms.get_velocities, Atoms.get_initial_charges, Atoms.get_masses
    for of in (*read, lambda each: each.info["bonds"]):
        np.testing.assert_allclose(of(back), of(atoms), rtol=1e-14)


def test_velocities_of_atoms_without_mass():
    """0 where they are at rest, where ASE divides 0 by 0; ASE's own for all others, and infinite where it is."""
    atoms = Atoms("ArXAr", np.zeros((3, 3)), momenta=[[1.0, -0.0, 3.0], [0.0, 0.0, 0.0], [0.3, 0.2, 0.1]])
    atoms.set_masses([40.0, 0.0, 3.0])
    v = velocities_of(atoms)
    assert np.array_equal(v[1], np.zeros(3)) and np.array_equal(v[::2], atoms[::2].get_velocities())
    assert np.isfinite(snapshot_of(atoms).velocities).all()
    atoms.arrays["momenta"][1, 2] = 1.0
    with pytest.warns(RuntimeWarning, match="divide by zero"):
        assert np.isinf(velocities_of(atoms)[1, 2])


def test_held_by_name():
    atoms = molecule("CH3CH2OH")
    with pytest.warns(UserWarning, match=r"8 bonds were guessed.*put pairs .*atoms.info\['bonds'\]") as caught:
        held = constrain(atoms, "hbonds")
    assert [warning.filename for warning in caught] == [__file__]
    assert sum(item.n_rows for item in held.constraints) == 6
    assert atoms.get_number_of_degrees_of_freedom() == 27 - 6
    atoms.info["bonds"] = bonds_of(atoms)
    with warnings.catch_warnings(action="error"):
        assert [item.n_rows for item in constraints_of(atoms, "allbonds")] == [8]
    atoms.info["bonds"] = [[0, 1], [1, 8]]
    with pytest.raises(InputError, match="another order of atoms"):
        constraints_of(atoms, "allbonds")


# -- heavy hydrogens ---------------------------------------------------------------------------------------


def test_hydrogens_take_mass_from_the_atoms_that_they_are_bonded_to():
    """As the loop over bonds does it, and OpenMM; also with bonds that are given, and a second time."""
    atoms = molecule("CH3CH2OH")
    before = atoms.get_masses()
    expected = before.copy()
    for hydrogen in np.flatnonzero(atoms.numbers == 1):
        heavy = min(range(3), key=lambda k: atoms.get_distance(hydrogen, k))
        expected[heavy] -= 3 - before[hydrogen]
        expected[hydrogen] = 3
    assert repartition_hydrogen_mass(atoms) == 6
    assert atoms.get_masses() == pytest.approx(expected, abs=1e-12)
    assert atoms.get_masses().sum() == pytest.approx(before.sum(), abs=1e-12)
    assert repartition_hydrogen_mass(atoms, 3) == 6
    assert atoms.get_masses() == pytest.approx(expected, abs=1e-12)
    assert "bonds" not in atoms.info
    given = molecule("CH3CH2OH")
    given.info["bonds"] = [[0, 1], [8, 0]]
    assert repartition_hydrogen_mass(given, 2) == 1
    assert (given.get_masses() - before)[[0, 8]] == pytest.approx([before[8] - 2, 2 - before[8]])
    assert np.count_nonzero(given.get_masses() != before) == 2
    bridge = Atoms("CHC", np.eye(3), info={"bonds": [[0, 1], [1, 2]]})
    assert repartition_hydrogen_mass(bridge, 2.0) == 1
    assert bridge.get_masses() == pytest.approx([12.011 + 1.008 - 2, 2, 12.011])  # from the first of the two
    wet = molecule("H2O") + molecule("CH3OH")  # water keeps its masses
    wet.positions[3:] += 8.0
    light = wet.get_masses()
    assert repartition_hydrogen_mass(wet) == 4
    assert np.array_equal(wet.get_masses()[:3], light[:3])


# -- rigid water -----------------------------------------------------------------------------------


def test_rigid_water_finds_water_only():
    """In any order of its atoms, whatever it is called."""
    atoms = molecule("H2O") + molecule("CH3CH2OH") + molecule("OH") + bulk("Cu") + molecule("H2O")[[1, 0, 2]]
    n = len(atoms)
    atoms.positions[:3] += 20
    atoms.positions[n - 3 :] -= 20
    atoms.new_array("residuenames", np.array(["MOL"] * n))  # as in PDB files of ASE
    rows = rigid_water(atoms).atoms
    assert np.array_equal(rows, [[0, 1], [0, 2], [1, 2], [n - 2, n - 3], [n - 2, n - 1], [n - 3, n - 1]])


def test_rigid_water_has_a_geometry_and_may_lie_across_a_boundary():
    atoms = molecule("H2O")
    atoms.cell, atoms.pbc = [8, 8, 8], True
    atoms.positions -= atoms.positions[0]
    atoms.wrap()
    assert rigid_water(atoms, "spc").target[:2] == pytest.approx([1.0, 1.0])
    assert rigid_water(atoms, (1.0, 90.0)).target == pytest.approx([1.0, 1.0, np.sqrt(2)])
    assert rigid_water(atoms).target == pytest.approx(molecule("H2O").get_all_distances()[[0, 0, 1], [1, 2, 2]])
    water = molecule("H2O")
    water.positions *= 0.1  # nm
    with pytest.raises(InputError, match=r"0\.097 angstrom apart"):
        rigid_water(water, "tip3p")


def test_rigid_water_tells_of_stretched_water():
    atoms = molecule("CH3OH") + molecule("H2O") + molecule("H2O")
    atoms.positions[6:9] += 5.0
    atoms.positions[9:] -= 5.0
    assert len(rigid_water(atoms).atoms) == 6
    atoms.set_distance(9, 11, 1.3, fix=0)
    with pytest.warns(UserWarning, match="1 hydrogens have no bond, the first of which is 11: "):
        rigid_water(atoms)
