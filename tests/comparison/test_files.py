"""Molecules from files: what is held, what forces act, and what is said where a file does not do."""

from __future__ import annotations

import re

import ase.io
import numpy as np
import pytest
from ase.build import molecule
from host_systems import ALANINE, VILLIN, quietly, read_universe
from openmm import app, unit

from kcons.cli import main
from kcons.comparison import compare, test_systems
from kcons.comparison.test_systems import files
from kcons.constraints import LinearRelation
from kcons.errors import InputError, UnsupportedError

from_file = test_systems.from_file


@pytest.fixture(scope="module")
def alanine():
    return test_systems.build("alanine")


@pytest.fixture
def bare(tmp_path):
    """Alanine dipeptide without its hydrogens."""
    pdb = app.PDBFile(str(ALANINE))
    modeller = app.Modeller(pdb.topology, pdb.positions)
    modeller.delete([a for a in modeller.topology.atoms() if a.element.symbol == "H"])
    return written(tmp_path / "bare.pdb", modeller.topology, modeller.positions)


@pytest.fixture
def gro(tmp_path):
    """Alanine dipeptide as GRO: no bonds, no elements."""
    universe = read_universe(ALANINE)
    universe.dimensions = None
    quietly(universe.atoms.write, tmp_path / "alanine.gro")
    return tmp_path / "alanine.gro"


@pytest.fixture
def ethanol(tmp_path):
    """An XYZ file: elements and positions, nothing else."""
    ase.io.write(tmp_path / "ethanol.xyz", molecule("CH3CH2OH"), format="xyz")
    return tmp_path / "ethanol.xyz"


def written(path, topology, positions):
    with path.open("w") as file:
        app.PDBFile.writeFile(topology, positions, file, keepIds=True)
    return path


def with_text(path, text):
    path.write_text(text)
    return path


def water(path, edge=2.0, model="tip3pfb"):
    """One molecule in a box, edge in nm."""
    modeller = app.Modeller(app.Topology(), unit.Quantity([], unit.nanometer))
    four = model == "tip4pew"
    modeller.addSolvent(app.ForceField(f"amber14/{model}.xml"), numAdded=1, model=model if four else "tip3p")
    modeller.topology.setPeriodicBoxVectors(np.eye(3) * edge * unit.nanometer)
    return written(path, modeller.topology, modeller.positions)


def hetatm(number, name, residue, chain, element="", x=0.0):
    return f"HETATM{number:5d} {name:^4} {residue} {chain}   7    {x:8.3f}   0.000   0.000  1.00  0.00{element:>12}\n"


def plan(*arguments, capsys):
    status = main.main(["plan", *map(str, arguments)])
    told = capsys.readouterr()
    return status, told.out, told.err


# -- PDB files ----------------------------------------------------------------------------------------


def test_alanine_dipeptide_and_what_is_held_of_it(alanine):
    assert (alanine.n_atoms, alanine.constraint_set.n_rows, alanine.motion.rank) == (22, 21, 21)
    assert "alanine dipeptide in vacuum, 22 atoms, allbonds: 21 Distance; 21 rows on 22 atoms, 300 K" in alanine.title
    assert alanine.openmm.home and alanine.openmm.platform == "Reference" and alanine.symbols[:2] == ["H", "C"]
    assert alanine.horizon / alanine.units.time_unit == pytest.approx(48)
    assert max(alanine.residuals(alanine.positions, alanine.velocities)) < 1e-13
    assert alanine.reference().error < 1e-9
    same = from_file(ALANINE, constrain="allbonds")
    np.testing.assert_array_equal(same.positions, alanine.positions)
    np.testing.assert_array_equal(same.velocities, alanine.velocities)
    assert same.name == ALANINE.stem and from_file(ALANINE, quick=True).horizon == pytest.approx(alanine.horizon / 2)
    for constrain, rows in (({}, 12), ({"constrain": "hangles"}, 30)):
        system = from_file(ALANINE, **constrain)
        assert system.constraint_set.n_rows == system.openmm.system.getNumConstraints() == rows
    assert test_systems.build("alanine", constrain="hbonds").constraint_set.n_rows == 12


@pytest.mark.parametrize(
    ("name", "atoms", "rows"),
    [
        ("dhfr", 2489, 2523),
        pytest.param("villin", 8867, 8576, marks=pytest.mark.validation),
        pytest.param("dhfr-water", 23558, 22290, marks=pytest.mark.validation),
    ],
)
def test_proteins(name, atoms, rows):
    system = test_systems.build(name, platform="CPU")
    assert (system.n_atoms, system.constraint_set.n_rows, system.motion.rank) == (atoms, rows, rows)
    assert system.residuals(system.positions, system.velocities)[0] < 1e-12
    assert (system.cell is None) == (name == "dhfr")
    if name != "dhfr":  # forces in single precision, smooth enough at the cutoff to tell methods apart
        assert system.reference().error < 1e-5


def test_hydrogens_are_added_and_do_not_depend_on_the_platforms_of_the_machine(bare, monkeypatch):
    seen, add = [], app.Modeller.addHydrogens

    def recorded(self, *args, platform=None, **options):
        seen.append(platform and platform.getName())
        return add(self, *args, platform=platform, **options)

    monkeypatch.setattr(app.Modeller, "addHydrogens", recorded)
    system = from_file(bare, add_hydrogens=True)
    assert (system.n_atoms, system.constraint_set.n_rows, seen) == (22, 12, ["CPU"])


def test_box_decides_about_the_forces(tmp_path, alanine):
    system = from_file(water(tmp_path / "water.pdb"))
    assert system.openmm.system.usesPeriodicBoundaryConditions() and system.constraint_set.n_rows == 3
    np.testing.assert_allclose(system.cell, 20 * np.eye(3), atol=1e-9)
    # Lengths are those that SETTLE holds, in single precision.
    found = compare(system.with_time_steps([1.0]), methods=["openmm-verlet", "openmm-kcons-rattle"])
    assert list(found.status) == ["ok", "ok"] and (found.sigma < 1e-12).all()
    placeholder = "CRYST1    1.000    1.000    1.000  90.00  90.00  90.00 P 1           1\n"
    system = from_file(with_text(tmp_path / "nmr.pdb", placeholder + ALANINE.read_text()))
    assert system.cell is None is alanine.cell and not system.openmm.system.usesPeriodicBoundaryConditions()


ION = hetatm(1, "NA", "NA ", "A", "NA")
#: OpenMM finds these ions similar to an amino acid that lacks 5 H atoms, 3 C atoms and more.
SODIUM = hetatm(1, "SOD", "SOD", "A", x=50.0)
ODD = hetatm(1, "C1", "XYZ", "B", "C") + hetatm(2, "C2", "XYZ", "B", "C", 1.5)
WHOLE = ALANINE.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (SODIUM + ODD, {"constrain": "allbonds"}, r"missing 5 H atoms, 3 C atoms.*give a force field that has it"),
        (ODD, {"constrain": "allbonds"}, r"residue XYZ 7 of chain B: .*--forcefield"),
        (ODD, {"add_hydrogens": True}, r"residue XYZ 7 of chain B: .*--forcefield"),
        (ION, {}, "odd.pdb: .*nothing|odd.pdb: .*no "),
        ("nonsense\n", {}, "does it hold molecules"),
        ("END\n", {}, "does it hold molecules"),
        (WHOLE.replace("2.000   2.090", "  nan   2.090"), {}, "finite"),
        (WHOLE, {"constrain": "everything"}, "hbonds"),
        (WHOLE, {"force_field": ["nowhere.xml"]}, "force field nowhere.xml: .*--forcefield amber14-all.xml"),
        (WHOLE, {"platform": "Abacus"}, "no platform 'Abacus' here; there are Reference"),
    ],
    ids=lambda value: str(value)[:30],
)
def test_files_that_do_not_do(text, options, words, tmp_path):
    with pytest.raises(InputError, match=words):
        quietly(from_file, with_text(tmp_path / "odd.pdb", text), **options)


def test_hydrogens_boxes_sites_and_cut_molecules(bare, tmp_path):
    with pytest.raises(InputError, match=r"residue ACE 1 of chain .*missing 3 H atoms.*--add-hydrogens"):
        from_file(bare, constrain="allbonds")
    with pytest.raises(InputError, match="no file"):
        from_file(tmp_path / "none.pdb")
    with pytest.raises(InputError, match=r"the box is 0\.8 nm wide, too narrow"):
        from_file(water(tmp_path / "water.pdb", edge=0.8))
    with pytest.raises(UnsupportedError, match="1 virtual sites"):
        from_file(water(tmp_path / "water.pdb", model="tip4pew"), force_field=["amber14/tip4pew.xml"])
    # A hydrogen of the first residue far away.
    pdb = app.PDBFile(str(ALANINE))
    x = np.array(pdb.getPositions(asNumpy=True)._value)
    x[0] += [2.5, 0, 0]
    with pytest.raises(InputError, match="whole") as caught:
        from_file(written(tmp_path / "cut.pdb", pdb.topology, x * unit.nanometer))
    assert sorted(caught.value.atoms) == [0, 1]


def test_openmm_is_needed(monkeypatch):
    monkeypatch.setattr(files, "find_spec", lambda name: None)
    with pytest.raises(UnsupportedError, match="pip install openmm"):
        test_systems.build("alanine")
    with pytest.raises(UnsupportedError, match=r"kcons\[mdanalysis\]"):
        from_file(ALANINE)


# -- any file with MDAnalysis -----------------------------------------------------------------------


def test_plans_of_files(ethanol, gro, tmp_path, capsys):
    status, out, err = plan(ethanol, "--constrain", "hangles", capsys=capsys)
    assert (status, err) == (0, "")
    assert "ethanol.xyz, 9 atoms, hangles: 8 Distance, 5 Angle; 13 rows on 9 atoms" in out
    assert "8 bonds were guessed" in out and "guess_bonds" not in out and "rank 13, degrees of freedom 14" in out
    cut = with_text(tmp_path / "cut.xyz", "3\n\nO 0 0 0\nH 0.96 0 0\nH 11.76 0.93 0\n")
    for words, said in (
        ([cut], "no bond was guessed for 1 hydrogens"),
        ([gro, "--select", "resname ALA", "--constrain", "allbonds"], "9 rows on 10 atoms"),
        ([ALANINE, "--select", "all"], "hbonds: 12 Distance"),
    ):
        status, out, _ = plan(*words, capsys=capsys)
        assert status == 0 and said in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("alanine.gro --select=resname:ALAX", "alanine.gro.*no resname ALAX \\(did you mean 'ALA'\\?\\)"),
        ("alanine.gro --coordinates ethanol.xyz", "ethanol.xyz has 9 atoms.*alanine.gro has 22"),
        ("alanine.gro --forces emt", "a plan needs no forces; leave --forces out"),
        ("empty.xyz", "empty.xyz is empty"),
    ],
)
def test_errors_name_the_file_and_the_item(words, said, gro, ethanol, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.xyz").touch()
    status, _, err = plan(*(word.replace(":", " ") for word in words.split()), capsys=capsys)
    assert status == 2 and re.search(said, err, re.DOTALL), err


def test_system_with_a_calculator_of_ase(ethanol):
    system = quietly(from_file, ethanol, forces="emt", constrain="hangles")
    assert system.constraint_set.n_rows == len(system.bonds) == 13
    assert system.openmm is None and "ASE's emt" in system.title
    assert max(system.residuals(system.positions, system.velocities)) < 1e-12


def test_system_with_a_force_field_is_the_one_of_openmm(gro):
    by_openmm, system = test_systems.build("alanine", constrain="hbonds"), quietly(from_file, gro)
    assert system.openmm.home and system.openmm.system.getNumConstraints() == 12
    assert {tuple(sorted(p)) for p in system.bonds.tolist()} == {tuple(sorted(p)) for p in by_openmm.bonds.tolist()}
    x = by_openmm.positions
    assert system.potential.energy(x) == pytest.approx(by_openmm.potential.energy(x), abs=1e-9)


@pytest.mark.parametrize(
    ("file", "options", "words"),
    [
        ("ethanol", {"forces": "emtt"}, "no forces 'emtt'; there are openmm, emt"),
        ("ethanol", {}, "residue"),  # no template
        ("ethanol", {"forces": "tip3p.xml"}, "residue"),
        ("villin", {"forces": "amber14-all", "force_field": ["tip3p.xml"]}, "--forcefield out"),
        ("villin", {"select": "all", "forces": "amber14-all"}, "residue Cl 36"),
        ("villin", {"select": "all", "forces": "amber14-all,nosuch"}, r"nosuch\.xml"),
    ],
)
def test_forces_that_do_not_fit(file, options, words, ethanol):
    with pytest.raises(InputError, match=words):
        quietly(from_file, ethanol if file == "ethanol" else VILLIN, **options)
    with pytest.raises(UnsupportedError, match="holds distances only"):
        files._openmm_engine(None, [LinearRelation(0, [1, 2], [0.5, 0.5])], files.FORCE_FIELD, "Reference")


def test_virtual_sites_have_a_plan_and_no_system(tmp_path):
    atoms = ("OW", 0.0, 0.0), ("HW1", 0.096, 0.0), ("HW2", -0.024, 0.093), ("MW", 0.009, 0.012)
    lines = ["water", "    4", *(f"{1:5d}{'SOL':<5}{name:>5}{1:5d}{x:8.3f}{y:8.3f}{0:8.3f}" for name, x, y in atoms)]
    path = with_text(tmp_path / "tip4p.gro", "\n".join([*lines, "   0.00000   0.00000   0.00000", ""]))
    found = test_systems.plan(path, constrain="none")
    assert len(found.rows.virtual_sites) == 1 and found.motion.degrees_of_freedom == 6
    with pytest.raises(UnsupportedError, match="1 virtual sites"):
        quietly(from_file, path)
