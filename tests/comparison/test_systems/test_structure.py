"""Molecules from files: what is held, what forces act, and what is said where a file does not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from openmm import app, unit

from kcons.comparison import compare, test_systems
from kcons.comparison.test_systems import structure
from kcons.errors import InputError, UnsupportedError

ALANINE = Path(__file__).parents[2] / "data" / "alanine-dipeptide-implicit.pdb"


@pytest.fixture(scope="module")
def alanine():
    return test_systems.build("alanine")


@pytest.fixture
def bare(tmp_path):
    """Alanine dipeptide without its hydrogens."""
    pdb = app.PDBFile(str(ALANINE))
    modeller = app.Modeller(pdb.topology, pdb.positions)
    modeller.delete([a for a in modeller.topology.atoms() if a.element.symbol == "H"])
    return written(tmp_path / "bare.pdb", modeller)


def written(path, modeller):
    with path.open("w") as file:
        app.PDBFile.writeFile(modeller.topology, modeller.positions, file, keepIds=True)
    return path


def changed(path, *, replace=None, head=""):
    text = ALANINE.read_text()
    if replace:
        assert replace[0] in text
        text = text.replace(*replace)
    path.write_text(head + text)
    return path


def water(path, edge=2.0, model="tip3pfb"):
    """One molecule in a box, edge in nm."""
    field = app.ForceField(f"amber14/{model}.xml")
    modeller = app.Modeller(app.Topology(), unit.Quantity([], unit.nanometer))
    modeller.addSolvent(field, numAdded=1, model="tip4pew" if model == "tip4pew" else "tip3p")
    modeller.topology.setPeriodicBoxVectors(np.eye(3) * edge * unit.nanometer)
    return written(path, modeller)


# -- what is built ----------------------------------------------------------------------------------


def test_alanine_dipeptide(alanine):
    assert alanine.n_atoms == 22
    assert alanine.constraint_set.n_rows == alanine.motion.rank == 21
    assert "alanine dipeptide in vacuum, 22 atoms, AllBonds: 21 distances, 300 K" in alanine.title
    assert alanine.openmm.home
    assert alanine.openmm.platform == "Reference"
    assert alanine.symbols[:2] == ["H", "C"]
    assert alanine.horizon / alanine.units.time_unit == pytest.approx(48)
    sigma, tangency = alanine.residuals(alanine.positions, alanine.velocities)
    assert max(sigma, tangency) < 1e-13


@pytest.mark.parametrize(("constrain", "rows"), [("hbonds", 12), ("hangles", 30)])
def test_what_is_held_can_be_chosen(constrain, rows):
    system = test_systems.build("alanine", constrain=constrain)
    assert system.constraint_set.n_rows == rows
    assert system.openmm.system.getNumConstraints() == rows


def test_reference_is_converged_in_double_precision(alanine):
    assert alanine.reference().error < 1e-9


def test_protein_of_2489_atoms():
    system = structure.build(structure="dhfr", platform="CPU")
    assert (system.n_atoms, system.constraint_set.n_rows, system.motion.rank) == (2489, 2523, 2523)
    assert system.openmm.platform == "CPU"
    assert system.residuals(system.positions, system.velocities)[0] < 1e-12


@pytest.mark.validation
@pytest.mark.parametrize(("name", "atoms", "rows"), [("villin", 8867, 8576), ("dhfr-water", 23558, 22290)])
def test_proteins_in_water(name, atoms, rows):
    system = test_systems.build(name)
    assert (system.n_atoms, system.constraint_set.n_rows) == (atoms, rows)
    assert "PME" in system.title
    assert system.residuals(system.positions, system.velocities)[0] < 1e-12
    # Forces in single precision, and enough of a cutoff's smoothness to tell methods apart.
    assert system.reference().error < 1e-5


def test_file_is_the_same_molecule(alanine):
    system = test_systems.from_file(ALANINE, constrain="allbonds")
    np.testing.assert_array_equal(system.positions, alanine.positions)
    np.testing.assert_array_equal(system.velocities, alanine.velocities)
    assert system.name == ALANINE.stem
    assert test_systems.from_file(ALANINE, quick=True).horizon == pytest.approx(alanine.horizon / 2)


def test_bonds_with_hydrogen_are_held_by_default():
    assert test_systems.from_file(ALANINE).constraint_set.n_rows == 12


def test_start_is_relaxed():
    energies = [s.potential.energy(s.positions) for s in (test_systems.from_file(ALANINE, relax=k) for k in (0, 100))]
    assert energies[1] < energies[0]


def test_hydrogens_are_added(bare):
    system = test_systems.from_file(bare, add_hydrogens=True)
    assert system.n_atoms == 22
    assert system.constraint_set.n_rows == 12


def test_hydrogens_do_not_depend_on_the_platforms_of_the_machine(bare, monkeypatch):
    """OpenMM would take its fastest, of whatever precision."""
    seen = []
    add = app.Modeller.addHydrogens

    def recorded(self, *args, platform=None, **options):
        seen.append(platform and platform.getName())
        return add(self, *args, platform=platform, **options)

    monkeypatch.setattr(app.Modeller, "addHydrogens", recorded)
    test_systems.from_file(bare, add_hydrogens=True)
    assert seen == ["CPU"]


def test_box_decides_about_the_forces(tmp_path, alanine):
    system = test_systems.from_file(water(tmp_path / "water.pdb"))
    assert "PME" in system.title
    assert system.constraint_set.n_rows == 3
    np.testing.assert_allclose(system.cell, 20 * np.eye(3), atol=1e-9)
    # Lengths are those that SETTLE holds, in single precision.
    found = compare(system.with_time_steps([1.0]), methods=["openmm-verlet", "openmm-kcons-rattle"])
    assert list(found.status) == ["ok", "ok"]
    assert (found.sigma < 1e-12).all()
    placeholder = "CRYST1    1.000    1.000    1.000  90.00  90.00  90.00 P 1           1\n"
    system = test_systems.from_file(changed(tmp_path / "nmr.pdb", head=placeholder))
    assert system.cell is None
    assert "PME" not in system.title
    assert alanine.cell is None


# -- what is said -----------------------------------------------------------------------------------


def test_missing_hydrogens(bare):
    with pytest.raises(InputError, match=r"residue ACE 1 of chain .*missing 3 H atoms.*--add-hydrogens"):
        test_systems.from_file(bare)


def test_ions_need_no_hydrogens(tmp_path):
    """OpenMM finds them similar to an amino acid that lacks 5 H atoms, 3 C atoms and more."""
    path = tmp_path / "ion.pdb"
    path.write_text("HETATM    1 SOD  SOD A   1       0.000   0.000   0.000  1.00  0.00\nEND\n")
    with pytest.raises(InputError, match=r"missing 5 H atoms, 3 C atoms.*give a force field that has it"):
        test_systems.from_file(path)


def test_unknown_residue(tmp_path):
    path = tmp_path / "odd.pdb"
    path.write_text(
        "HETATM    1  C1  XYZ B   7       0.000   0.000   0.000  1.00  0.00           C  \n"
        "HETATM    2  C2  XYZ B   7       1.500   0.000   0.000  1.00  0.00           C  \nEND\n"
    )
    for options in ({}, {"add_hydrogens": True}):
        with pytest.raises(InputError, match=r"residue XYZ 7 of chain B: .*--forcefield"):
            test_systems.from_file(path, **options)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"constrain": "everything"}, "there are hbonds, allbonds, hangles"),
        ({"force_field": ["nowhere.xml"]}, "force field nowhere.xml: .*--forcefield amber14-all.xml"),
        ({"platform": "Abacus"}, "no platform 'Abacus' here; there are Reference"),
    ],
)
def test_bad_choices(options, text):
    with pytest.raises(InputError, match=text):
        test_systems.from_file(ALANINE, **options)


def test_bad_files(tmp_path):
    with pytest.raises(InputError, match="no file"):
        test_systems.from_file(tmp_path / "none.pdb")
    for text, message in (("nonsense\n", "cannot be read|no atoms"), ("END\n", "cannot be read|no atoms")):
        path = tmp_path / "bad.pdb"
        path.write_text(text)
        with pytest.raises(InputError, match=message) as caught:
            test_systems.from_file(path)
        assert "does it hold molecules" in str(caught.value) or "no atoms" in str(caught.value)
    text = ALANINE.read_text(encoding="utf-8").replace("2.000   2.090", "  nan   2.090")
    path.write_text(text)
    with pytest.raises(InputError, match=r"the position of CH3 of ACE 1 is not finite; mend the file"):
        test_systems.from_file(path)


def test_molecule_that_is_cut(tmp_path):
    # A hydrogen of the first residue on the other side of a box.
    pdb = app.PDBFile(str(ALANINE))
    x = np.array(pdb.getPositions(asNumpy=True)._value)
    x[0] += [2.5, 0, 0]
    path = tmp_path / "cut.pdb"
    with path.open("w") as file:
        app.PDBFile.writeFile(pdb.topology, x * unit.nanometer, file)
    with pytest.raises(InputError, match=r"CH3 of ACE 1 and H1 of ACE 1 are 2\.5 nm apart") as caught:
        test_systems.from_file(path)
    assert "make molecules whole" in str(caught.value)
    assert sorted(caught.value.atoms) == [0, 1]


def test_narrow_box(tmp_path):
    with pytest.raises(InputError, match=r"the box is 0\.8 nm wide, too narrow"):
        test_systems.from_file(water(tmp_path / "water.pdb", edge=0.8))


def test_virtual_sites(tmp_path):
    with pytest.raises(UnsupportedError, match="virtual sites into residue HOH"):
        test_systems.from_file(water(tmp_path / "water.pdb", model="tip4pew"), force_field=["amber14/tip4pew.xml"])


def test_nothing_to_hold(bare, tmp_path):
    path = tmp_path / "ion.pdb"
    path.write_text("HETATM    1 NA    NA A   1       0.000   0.000   0.000  1.00  0.00          NA  \nEND\n")
    with pytest.raises(InputError, match="nothing is held"):
        test_systems.from_file(path)


def test_options_of_molecules_are_refused_elsewhere():
    with pytest.raises(InputError, match="for alanine, dhfr, dhfr-water, villin and PDB files, not for 'chain'"):
        test_systems.build("chain", constrain="hbonds")
    with pytest.raises(InputError, match="cannot be built at size 2"):
        test_systems.build("alanine", 2)


def test_openmm_is_needed(monkeypatch):
    monkeypatch.setattr(structure, "find_spec", lambda name: None)
    for build in (lambda: test_systems.build("alanine"), lambda: test_systems.from_file(ALANINE)):
        with pytest.raises(UnsupportedError, match="pip install openmm"):
            build()


def test_names_of_files():
    assert test_systems.is_file("my.pdb")
    assert test_systems.is_file("a/b.CIF")
    assert not test_systems.is_file("alanine")
    assert not test_systems.is_file("chain-175")
