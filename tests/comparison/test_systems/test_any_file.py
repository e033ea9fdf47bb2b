"""kcons plan and compare on files that MDAnalysis reads."""

from __future__ import annotations

from pathlib import Path

import ase.io
import numpy as np
import openmm.app
import pytest
from ase.build import molecule
from host_systems import ALANINE, quietly, read_universe

from kcons.cli import main
from kcons.comparison import test_systems
from kcons.comparison.test_systems import any_file
from kcons.constraints import LinearRelation
from kcons.errors import InputError, UnsupportedError


@pytest.fixture
def ethanol(tmp_path):
    """An XYZ file: elements and positions, nothing else."""
    path = tmp_path / "ethanol.xyz"
    ase.io.write(path, molecule("CH3CH2OH"), format="xyz")
    return path


@pytest.fixture
def alanine(tmp_path):
    """Alanine dipeptide as GRO: no bonds, no elements."""
    universe = read_universe(ALANINE)
    path = tmp_path / "alanine.gro"
    universe.dimensions = None
    quietly(universe.atoms.write, path)
    return path


def plan(*arguments, capsys):
    status = main.main(["plan", *map(str, arguments)])
    told = capsys.readouterr()
    return status, told.out, told.err


def test_plan_of_an_xyz_file(ethanol, capsys):
    status, out, err = plan(ethanol, "--constrain", "hangles", capsys=capsys)
    assert (status, err) == (0, "")
    assert "ethanol.xyz, 9 atoms, hangles: 8 Distance, 5 Angle; 13 rows on 9 atoms" in out
    assert "8 bonds were guessed" in out
    assert "rank 13, degrees of freedom 14" in out


def test_plan_tells_of_hydrogens_without_a_bond(tmp_path, capsys):
    path = tmp_path / "cut.xyz"
    path.write_text("3\n\nO 0 0 0\nH 0.96 0 0\nH 11.76 0.93 0\n")
    status, out, _ = plan(path, capsys=capsys)
    assert status == 0 and "no bond was guessed for 1 hydrogens" in out


def test_plan_with_a_selection_and_rigid_residues(alanine, capsys):
    status, out, _ = plan(alanine, "--rigid-residues", "ALA", "--constrain", "none", capsys=capsys)
    assert status == 0
    assert "rank 24" in out  # ten atoms
    status, out, _ = plan(alanine, "--select", "resname ALA", "--constrain", "allbonds", capsys=capsys)
    assert status == 0
    assert "9 rows on 10 atoms" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--select", "resname ALAX"], "no resname ALAX (did you mean ALA?)"),
        (["--rigid-residues", "ALAX"], "no residue is called ALAX (did you mean ALA?)"),
        (["--coordinates", "nowhere.xtc"], "there is no file nowhere.xtc"),
        (["--forces", "emt"], "a plan needs no forces; leave --forces out"),
    ],
)
def test_errors_name_the_file_and_the_item(alanine, arguments, said, capsys):
    status, _, err = plan(alanine, *arguments, capsys=capsys)
    assert status == 2
    assert said in err
    if arguments[0] in ("--select", "--rigid-residues"):
        assert "alanine.gro" in err


def test_coordinates_of_another_system_are_refused(alanine, ethanol, capsys):
    status, _, err = plan(alanine, "--coordinates", ethanol, capsys=capsys)
    assert status == 2
    assert "ethanol.xyz has 9 atoms" in err
    assert "alanine.gro has 22" in err


def test_unreadable_files_and_unknown_names(tmp_path, capsys):
    broken = tmp_path / "broken.gro"
    broken.write_text("nothing\n3\nno atoms here\n")
    status, _, err = plan(broken, capsys=capsys)
    assert status == 2
    assert f"{broken}: MDAnalysis cannot read this topology" in err
    (tmp_path / "empty.xyz").touch()
    assert "empty.xyz is empty" in plan(tmp_path / "empty.xyz", capsys=capsys)[2]
    (tmp_path / "run.odd").write_text("nothing")
    assert (
        "its name tells no format of a topology that MDAnalysis reads; rename it"
        in plan(tmp_path / "run.odd", capsys=capsys)[2]
    )
    assert plan("missing.gro", capsys=capsys)[2] == "kcons: there is no file missing.gro\n"
    assert "there is no test system 'watr'" in plan("watr", capsys=capsys)[2]
    assert "--forces is for files" in plan("ethanol", "--forces", "emt", capsys=capsys)[2]


def test_system_with_a_calculator_of_ase(ethanol):
    system = quietly(test_systems.from_file, ethanol, forces="emt", constrain="hangles")
    assert system.constraint_set.n_rows == len(system.bonds) == 13
    assert system.openmm is None
    assert max(system.residuals(system.positions, system.velocities)) < 1e-12
    assert "ASE's emt" in system.title


def test_system_with_a_force_field_is_the_one_of_openmm(alanine):
    by_openmm = test_systems.build("alanine", constrain="hbonds")
    system = quietly(test_systems.from_file, alanine)
    assert system.openmm.home
    assert {tuple(sorted(p)) for p in system.bonds.tolist()} == {tuple(sorted(p)) for p in by_openmm.bonds.tolist()}
    x = by_openmm.positions
    assert system.potential.energy(x) == pytest.approx(by_openmm.potential.energy(x), abs=1e-9)
    assert system.openmm.system.getNumConstraints() == 12


def test_rigid_residues_in_openmm(alanine):
    system = quietly(test_systems.from_file, alanine, rigid_residues=["ALA"])
    inside = [k for k, name in enumerate(system.symbols) if name]
    assert system.openmm.home and len(inside) == 22
    assert system.openmm.system.getNumConstraints() == system.motion.constraint_set.n_rows
    assert system.motion.rank == 3 * 10 - 6 + 7  # the residue, and the hydrogens of both caps


def test_forces_that_do_not_fit(ethanol, alanine):
    with pytest.raises(InputError, match="no forces 'emtt'; there are openmm, emt"):
        quietly(test_systems.from_file, ethanol, forces="emtt")
    with pytest.raises(InputError, match="residue"):
        quietly(test_systems.from_file, ethanol)  # no template
    with pytest.raises(UnsupportedError, match="holds distances only"):
        any_file._openmm_engine(None, [LinearRelation(0, [1, 2], [0.5, 0.5])], (), "Reference")


def test_compare_runs_on_a_file(ethanol, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["compare", str(ethanol), "--forces", "emt", "--constrain", "allbonds", "--quick", "--budget", "0.5"]
    status = main.main([*arguments, "--methods", "rattle", "--dt", "4"])
    told = capsys.readouterr()
    assert status == 0, told.err
    assert "kcons: 8 bonds were guessed" in told.err
    assert "ethanol.xyz, 9 atoms, allbonds: 8 Distance" in told.out
    assert (tmp_path / "compare-ethanol" / "compare.csv").is_file()


def test_virtual_sites_have_a_plan_and_no_system(tmp_path):
    path = tmp_path / "tip4p.gro"
    lines = ["water", "    4"]
    for name, x, y in (("OW", 0.0, 0.0), ("HW1", 0.096, 0.0), ("HW2", -0.024, 0.093), ("MW", 0.009, 0.012)):
        lines.append(f"{1:5d}{'SOL':<5}{name:>5}{1:5d}{x:8.3f}{y:8.3f}{0:8.3f}")
    path.write_text("\n".join([*lines, "   0.00000   0.00000   0.00000", ""]))
    found = any_file.plan(path, constrain="none")
    assert len(found.rows.virtual_sites) == 1
    assert found.motion.degrees_of_freedom == 6
    with pytest.raises(UnsupportedError, match="1 virtual sites"):
        quietly(test_systems.from_file, path)


def test_pdb_files_go_the_new_way_when_asked(capsys):
    status, out, _ = plan(ALANINE, "--select", "all", capsys=capsys)
    assert status == 0
    assert "hbonds: 12 Distance" in out


VILLIN = Path(openmm.app.__file__).parent / "data" / "test.pdb"


def test_a_protein_in_water_with_force_fields_by_name(tmp_path, capsys, monkeypatch):
    """Villin in water: rows and energy are those of OpenMM alone, in a box that is not NumPy's."""
    from openmm import app, unit

    monkeypatch.setenv("OPENMM_CPU_THREADS", "1")
    test_system = quietly(test_systems.from_file, VILLIN, select="all", forces="amber14-all,amber14/tip3p")
    pdb = app.PDBFile(str(VILLIN))
    system = app.ForceField("amber14-all.xml", "amber14/tip3p.xml").createSystem(
        pdb.topology, nonbondedMethod=app.PME, constraints=app.HBonds, rigidWater=True
    )
    wanted = {
        tuple(sorted(p[:2])): p[2].value_in_unit(unit.angstrom)
        for p in map(system.getConstraintParameters, range(system.getNumConstraints()))
    }
    held = {tuple(sorted(pair)) for pair in test_system.bonds.tolist()}
    assert held == set(wanted) and test_system.constraint_set.n_atoms == 8867
    box = [list(v.value_in_unit(unit.angstrom)) for v in system.getDefaultPeriodicBoxVectors()]
    np.testing.assert_allclose(test_system.cell, box, atol=1e-4)
    # The same water: the parameters of the Systems, which one by one decide the energy.
    theirs, ours = (
        next(f for f in one.getForces() if isinstance(f, openmm.NonbondedForce))
        for one in (system, test_system.openmm.system)
    )
    for k in range(0, 8867, 7):
        assert theirs.getParticleParameters(k) == ours.getParticleParameters(k)


def test_compare_runs_on_a_protein_in_water(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENMM_CPU_THREADS", "1")
    arguments = ["compare", str(VILLIN), "--constrain", "hbonds", "--forces", "amber14-all,amber14/tip3p", "--quick"]
    status = main.main([*arguments, "--budget", "1", "--methods", "openmm-kcons-rattle", "--dt", "4"])
    told = capsys.readouterr()
    assert status == 0, told.err
    assert "test.pdb, 8867 atoms, hbonds" in told.out
    assert (tmp_path / "compare-test" / "compare.csv").is_file()


def test_force_fields_that_do_not_fit(ethanol):
    with pytest.raises(InputError, match="--forcefield out"):
        quietly(test_systems.from_file, VILLIN, forces="amber14-all", force_field=["tip3p.xml"])
    with pytest.raises(InputError, match="residue Cl 36"):
        quietly(test_systems.from_file, VILLIN, select="all", forces="amber14-all")
    with pytest.raises(InputError, match=r"nosuch\.xml"):
        quietly(test_systems.from_file, VILLIN, select="all", forces="amber14-all,nosuch")
    with pytest.raises(InputError, match="residue"):
        quietly(test_systems.from_file, ethanol, forces="tip3p.xml")
