"""Input files in TOML: what they make, and what is said of wrong ones."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from ase.build import molecule
from ase.io import write
from openmm import app
from openmm_systems import DATA

from kcons.errors import InputError, KconsError
from kcons.free_energy import AseWindows, OpenMMWindows, Windows, read_input

INPUT = """
[structure]
file = "methanol.xyz"

[forces]
calculator = "lj"
settings = {sigma = 1.0, epsilon = 0.02, rc = 6.0}

[[coordinate]]
name = "turn"
dihedral = [2, 0, 1, 3]
from = -180
to = 180
windows = 12

[held]
constrain = "hbonds"

[sampling]
temperature = 310
timestep = 0.5
both_sides = false
rng = 4

[improve]
error = 0.5
most = 20
below = 40
"""
IMPROVE = INPUT[INPUT.index("[improve]") :]


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "methanol.xyz", molecule("CH3OH"))
    return tmp_path


def read(folder, text=INPUT):
    (folder / "input.toml").write_text(text)
    return read_input(folder / "input.toml")


def test_an_input_for_ase(folder):
    found = read(folder)
    assert isinstance(found.sampler, AseWindows) and found.sampler.names == ("turn",)
    assert found.settings.temperature == 310
    assert found.settings.production == 20000
    np.testing.assert_allclose(found.targets[:, 0], np.radians(np.arange(-180, 180, 30)))
    assert found.options == {"both_sides": False, "rng": 4}
    assert found.improve == {"error": 0.5, "most": 20, "below": 40}
    assert found.sampler.start == pytest.approx([np.pi])
    assert found.sampler.held[0].n_rows == 4


def test_a_difference_of_distances(folder):
    """In angstrom and of either sign; beside a torsion in degrees."""
    text = INPUT.replace("[2, 0, 1, 3]", "[3, 1, 2, 4]").replace(IMPROVE, "")
    text = text.replace('methanol.xyz"', 'methanol.xyz"\ncount_from = 1')
    text += "\n[[coordinate]]\ndifference = [1, 2, 4, 2]\nfrom = -0.5\nto = 0.5\nwindows = 3.0\n"
    found = read(folder, text)
    assert found.sampler.names == ("turn", "difference-1-2-4-2")
    assert found.sampler.coordinates["turn"].atoms.tolist() == [[2, 0, 1, 3]]
    assert found.targets.shape == (36, 2) and found.targets[:3, 1].tolist() == [-0.5, 0.0, 0.5]
    atoms = molecule("CH3OH")
    assert found.sampler.start[1] == pytest.approx(atoms.get_distance(0, 1) - atoms.get_distance(3, 1))


def test_an_input_for_openmm(folder):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml", "implicit/gbn2.xml")
    system = field.createSystem(pdb.topology, constraints=app.HBonds)
    (folder / "system.xml").write_text(openmm.XmlSerializer.serialize(system))
    (folder / "alanine.pdb").write_text((DATA / "alanine-dipeptide-implicit.pdb").read_text())
    found = read(
        folder,
        """
        [structure]
        file = "alanine.pdb"
        [forces]
        system = "system.xml"
        [[coordinate]]
        name = "r"
        distance = [4, 14]
        from = 2.8
        to = 3.4
        windows = 4
        [[coordinate]]
        difference = [4, 14, 14, 8]
        values = [0.3]
        """,
    )
    assert isinstance(found.sampler, OpenMMWindows) and found.sampler.scales.tolist() == [10.0, 10.0]
    np.testing.assert_allclose(found.targets, [[2.8, 0.3], [3.0, 0.3], [3.2, 0.3], [3.4, 0.3]])
    x = np.array(pdb.positions.value_in_unit(openmm.unit.nanometer))
    first, second = np.linalg.norm(x[[4, 8]] - x[14], axis=1)
    assert found.sampler.start == pytest.approx([first, first - second])


LJ, FILE, TURN = 'calculator = "lj"', 'file = "methanol.xyz"', "dihedral = [2, 0, 1, 3]"
#: Another coordinate.
MORE, ROW = "[[coordinate]]\nangle = [2, 0, 1]\nvalues = ", "[[coordinate]]\ndistance = [0, "
MANY = "".join(f"{ROW}{k}]\nfrom=1\nto=2\nwindows=90000\n" for k in range(1, 5))
ZEROS = "0" * 400


def before_improve(text):
    return IMPROVE[:9], f"{text}\n[improve]"


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[sampling]", "[samplings]", r"unknown key 'samplings' \(did you mean 'sampling'\?"),
        ("timestep = 0.5", "time_step = 0.5", r"\[sampling\] has an unknown key 'time_step' .did you mean 'timestep'"),
        ("temperature = 310", "temperature = -310", "temperature of .sampling. is -310; give a positive number"),
        (LJ, 'calculator = "no such"', "no calculator 'no such'"),
        (FILE, 'file = "nothing.xyz"', "there is no file .*nothing.xyz"),
        (FILE, "", r"\[structure\] has no file; write file = "),
        (LJ, "", r"give calculator or system"),
        (LJ, 'system = "system.xml"', "settings of .forces. is for a calculator of ASE, and no System; leave it out"),
        ("windows = 12", "", "give values, or from, to and windows"),
        (TURN, "", "coordinate turn is nothing"),
        (TURN, f"{TURN}\nangle = [2, 0, 1]", "turn is angle and dihedral"),
        (TURN, "dihedral = [2, 0, 1]", "dihedral names 3 atoms; give 4"),
        ("[[coordinate]]", "[coordinate]", r"write \[\[coordinate\]\]"),
        ("temperature = 310", "temperature 310", "is no TOML that can be read: .*line"),
        ('constrain = "hbonds"', 'constrain = "everything"', "everything"),
        ("windows = 12", "windows = 12\nvalues = [1, 2, 3]", "turn has values and from"),
        ("windows = 12", "windows = 2", r"\[improve\] adds windows.*has 1, with 2 windows"),
        (*before_improve(f"{MORE}[100, 110]"), "has 2, with 24 windows"),
        (*before_improve(f"{MORE}[100, 180]"), "no angle of 180 to hold"),
        (*before_improve(f'{MORE}[100.0]\nname = "turn"'), "two coordinates"),
        (*before_improve(f"{ROW}1]\nvalues = [1.4, -1]"), "no distance of -1 to hold"),
        (*before_improve(MANY), "the input file has 787,320,000,000,000,000,000 windows"),
        (*before_improve(f"a = {'[' * 5000}{']' * 5000}"), "is no TOML that can be read: .*recursion"),
        ("windows = 12", 'windows = "x"', r"windows of \[coordinate\] is 'x'; give a number"),
        (TURN, "dihedral = [2.5, 0, 1, 3]", "give whole numbers"),
        ("both_sides = false", 'both_sides = "no"', "give true or false"),
        ("most = 20", "", r"\[improve\] has no most; write most = "),
        (FILE, f"{FILE}\ncount_from = -1", "count_from of .structure. is -1; choose 0 or 1"),
        (FILE, f"{FILE}\ncount_from = 1", "there is no atom 0; atoms are counted from 1"),
        ("sigma = 1.0", "sgima = 1.0", r"lj has no setting 'sgima' .did you mean 'sigma'"),
        ("windows = 12", "windows = 2000000000", "the input file has 2,000,000,000 windows; give at most 100,000"),
        ("windows = 12", f"windows = 1{ZEROS}", r"windows of \[coordinate\] is 10{10,30}\.\.\.0+; give a number"),
        ("timestep = 0.5", f"timestep.{'.'.join('a' * 3000)} = 0.5", r"timestep of \[sampling\] is .*give a number"),
    ],
)
def test_wrong_files(folder, old, new, match):
    assert old in INPUT
    with pytest.raises(KconsError, match=match):
        read(folder, INPUT.replace(old, new))


FORCES = INPUT[INPUT.index('calculator = "lj"') : INPUT.index("[[coordinate]]")]
STRANGE = """
import pathlib
from ase.calculators.lj import LennardJones
pathlib.Path(__file__).with_suffix(".ran").touch()
def made():
    return LennardJones()
"""


def test_an_input_runs_no_code_that_nobody_allowed(folder, monkeypatch):
    """Modules are named by who runs it, and nothing of them is imported by reading it."""
    (folder / "strange.py").write_text(STRANGE)
    monkeypatch.syspath_prepend(folder)
    with pytest.raises(InputError, match="--allow-module strange "):
        read(folder, INPUT.replace(FORCES, 'calculator = "strange:made"\n'))
    found = read_input(folder / "input.toml", allow_modules=["strange"])
    assert found.sampler.start == pytest.approx([np.pi])
    assert not (folder / "strange.ran").exists()
    Windows(found.sampler, folder / "out", found.settings)  # about to run
    assert (folder / "strange.ran").exists()
    for name, module in (("cp2k", "ase.calculators.cp2k"), ("os:system", "os")):
        with pytest.raises(InputError, match=f"--allow-module {module} "):
            read(folder, INPUT.replace(FORCES, f'calculator = "{name}"\nsettings = {{command = "touch ran"}}\n'))


def nothing(state):
    return 0.0, np.zeros((6, 3))


def test_a_system_of_an_input_runs_no_code(folder):
    """A PythonForce is code, which OpenMM runs while it reads the file."""
    system = openmm.System()
    system.addForce(openmm.PythonForce(nothing))
    (folder / "system.xml").write_text(openmm.XmlSerializer.serialize(system))
    text = INPUT.replace(FORCES, 'system = "system.xml"\n').replace('[held]\nconstrain = "hbonds"\n', "")
    with pytest.raises(InputError, match=r"system\.xml has a PythonForce in it, whose code would run"):
        read(folder, text)


def test_no_file_to_read(folder):
    for wrong, said in ((folder, "is no TOML that can be read: .*directory"), (None, "give a path")):
        with pytest.raises(InputError, match=said):
            read_input(wrong)
