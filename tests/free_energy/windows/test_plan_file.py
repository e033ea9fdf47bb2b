"""Plans in TOML: what they make, and what is said of wrong ones."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import openmm
import pytest
from ase.build import molecule
from ase.io import write
from openmm import app
from openmm_systems import DATA

from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.free_energy import AseWindows, OpenMMWindows, Windows, read_plan

PLAN = """
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
thermostat = "nose-hoover"
both_sides = false
seed = 4

[improve]
error = 0.5
most = 20
below = 40

[workers]
processes = 3
"""
IMPROVE = PLAN[PLAN.index("[improve]") : PLAN.index("[workers]")]


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "methanol.xyz", molecule("CH3OH"))
    return tmp_path


def read(folder, text=PLAN):
    (folder / "plan.toml").write_text(text)
    return read_plan(folder / "plan.toml")


def test_a_plan_for_ase(folder):
    plan = read(folder)
    assert isinstance(plan.sampler, AseWindows) and plan.sampler.names == ("turn",)
    assert plan.settings.temperature == 310 and plan.settings.thermostat == "nose-hoover"
    assert plan.settings.production == 20000
    np.testing.assert_allclose(plan.targets[:, 0], np.radians(np.arange(-180, 180, 30)))
    assert plan.options == {"both_sides": False, "seed": 4} and plan.improve == {"error": 0.5, "most": 20, "below": 40}
    assert plan.processes == 3
    with plan.executor() as executor:
        assert executor is None
    assert plan.sampler.begin()[0] == pytest.approx([np.pi])
    assert plan.sampler.held[0].n_rows == 4


def test_atoms_from_one_and_two_coordinates(folder):
    text = PLAN.replace('file = "methanol.xyz"', 'file = "methanol.xyz"\ncount_from = 1').replace(
        "dihedral = [2, 0, 1, 3]", "dihedral = [3, 1, 2, 4]"
    )
    text += "\n[[coordinate]]\ndistance = [1, 2]\nvalues = [1.4, 1.5]\n"
    plan = read(folder, text.replace(IMPROVE, ""))
    assert plan.sampler.coordinates["turn"].atoms.tolist() == [[2, 0, 1, 3]]
    assert plan.sampler.names == ("turn", "distance-1-2") and plan.targets.shape == (24, 2)
    assert plan.targets[1] == pytest.approx([-np.pi, 1.5])


def test_pulls(folder):
    assert read(folder).pulls is None
    plan = read(folder, PLAN + "\n[pulls]\nfrom = -60\ncount = 8\nboth_ways = false\nsteps = 300\n")
    assert plan.pulls["start"] == pytest.approx([-np.pi / 3]) and plan.pulls["end"] == pytest.approx(plan.targets[-1])
    assert plan.pulls["count"] == 8 and plan.pulls["both_ways"] is False and plan.pull_steps == 300
    text = PLAN + "\n[[coordinate]]\ndistance = [0, 1]\nvalues = [1.4, 1.5]\n[pulls]\nto = [90.0, 1.6]\n"
    plan = read(folder, text.replace(IMPROVE, ""))
    assert plan.pulls["end"] == pytest.approx([np.pi / 2, 1.6]) and plan.pull_steps == 20000


def test_a_plan_for_openmm(folder):
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    field = app.ForceField("amber14-all.xml", "implicit/gbn2.xml")
    system = field.createSystem(pdb.topology, constraints=app.HBonds)
    (folder / "system.xml").write_text(openmm.XmlSerializer.serialize(system))
    (folder / "alanine.pdb").write_text((DATA / "alanine-dipeptide-implicit.pdb").read_text())
    plan = read(
        folder,
        """
        [structure]
        file = "alanine.pdb"
        [forces]
        system = "system.xml"
        platform = "Reference"
        [[coordinate]]
        name = "r"
        distance = [4, 14]
        from = 2.8
        to = 3.4
        windows = 4
        """,
    )
    assert isinstance(plan.sampler, OpenMMWindows) and plan.sampler.scales.tolist() == [10.0]
    np.testing.assert_allclose(plan.targets[:, 0], [2.8, 3.0, 3.2, 3.4])


def test_the_way_to_a_window_is_in_degrees_as_all_angles_are(folder):
    assert read(folder, PLAN.replace("seed = 4", "approach = 6")).options["approach"] == pytest.approx(np.radians(6))
    more = PLAN.replace("[held]", "[[coordinate]]\ndistance = [1, 4]\nvalues = [2.0]\n[held]").replace(IMPROVE, "")
    found = read(folder, more.replace("seed = 4", "approach = [6, 0.2]")).options["approach"]
    assert found == pytest.approx([np.radians(6), 0.2])
    with pytest.raises(InputError, match="approach has 3 values; give one for each of turn, distance-1-4"):
        read(folder, more.replace("seed = 4", "approach = [6, 0.2, 1]"))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[sampling]", "[samplings]", r"unknown key 'samplings' \(did you mean 'sampling'\?"),
        ("timestep = 0.5", "time_step = 0.5", r"\[sampling\] has an unknown key 'time_step' .did you mean 'timestep'"),
        ("temperature = 310", "temperature = -310", "temperature is -310"),
        ('calculator = "lj"', 'calculator = "no such"', "no calculator 'no such'"),
        ('file = "methanol.xyz"', 'file = "nothing.xyz"', "there is no file .*nothing.xyz"),
        ('file = "methanol.xyz"', "", "the plan has no structure"),
        ('calculator = "lj"', "", r"give calculator or system"),
        ("windows = 12", "", "give values, or from, to and windows"),
        ("dihedral = [2, 0, 1, 3]", "", "coordinate turn is nothing"),
        ("dihedral = [2, 0, 1, 3]", "dihedral = [2, 0, 1, 3]\nangle = [2, 0, 1]", "turn is angle and dihedral"),
        ("[[coordinate]]", "[coordinate]", r"write \[\[coordinate\]\]"),
        ("temperature = 310", "temperature 310", "is no TOML"),
        ('constrain = "hbonds"', 'constrain = "everything"', "everything"),
        ("[workers]", "[pulls]\nfrom = [1.0, 2.0]\n[workers]", r"from of \[pulls\] has 2 values.*turn"),
        ("[workers]", "[pulls]\ncount = 4\n[workers]", r"count of \[pulls\] is 4.*5 or more"),
        ("[workers]", "[pulls]\nsteps = 0.5\n[workers]", r"steps of \[pulls\] is 0.5"),
        ("[workers]", "[pulls]\nsteps = true\n[workers]", r"steps of \[pulls\] is True"),
        ("[workers]", "[pulls]\nfrom = 3\nto = 3\n[workers]", "begin where they end"),
        ("windows = 12", "windows = 12\nvalues = [1, 2, 3]", "turn has values and from"),
        ("windows = 12", "windows = 2", r"\[improve\] adds windows.*has 1, with 2 windows"),
        ("[workers]", "[[coordinate]]\nangle = [2, 0, 1]\nvalues = [100, 110]\n[workers]", "has 2, with 24 windows"),
        ("[workers]", "[[coordinate]]\nangle = [2, 0, 1]\nvalues = [100, 180]\n[workers]", "no angle of 180 to hold"),
        ("[workers]", "[[coordinate]]\ndistance = [0, 1]\nvalues = [1.4, -1]\n[workers]", "no distance of -1 to hold"),
        (
            'calculator = "lj"',
            'calculator = "lj"\nplatform = "CPU"',
            "platform of .forces. says nothing to a calculator",
        ),
        ("windows = 12", 'windows = "x"', r"windows of \[coordinate\] is 'x'; give a whole number above 0"),
        ("windows = 12", "windows = -2", r"windows of \[coordinate\] is -2"),
        ("dihedral = [2, 0, 1, 3]", "dihedral = [2.5, 0, 1, 3]", "give whole numbers"),
        ("dihedral = [2, 0, 1, 3]", 'dihedral = "abc"', "give whole numbers"),
        ("both_sides = false", 'both_sides = "no"', "give true or false"),
        ("temperature = 310", 'temperature = "x"', "temperature is 'x'"),
        ("most = 20", "", r"\[improve\] has no most"),
        ("error = 0.5", 'error = "x"', "give a number above 0"),
        (
            'file = "methanol.xyz"',
            'file = "methanol.xyz"\ncount_from = -1',
            "count_from of .structure. is -1; give 0 or 1",
        ),
        (
            'file = "methanol.xyz"',
            'file = "methanol.xyz"\ncount_from = 1',
            "there is no atom 0; atoms are counted from 1",
        ),
        ("sigma = 1.0", "sgima = 1.0", r"lj has no setting 'sgima' .did you mean 'sigma'"),
        ("seed = 4", 'approach = "x"', "approach of .sampling. is 'x'; give a number, or numbers"),
        ("processes = 3", "processes = 0", r"processes of \[workers\] is 0"),
        ("[workers]", "[pull]\ncount = 5\n[workers]", r"unknown key 'pull' .did you mean 'pulls'"),
        (
            "[workers]",
            '[[coordinate]]\nname = "turn"\nangle = [2, 0, 1]\nvalues = [100.0]\n[workers]',
            "two coordinates",
        ),
        ("windows = 12", "windows = 2000000000", "the plan has 2,000,000,000 windows; give at most 100,000"),
        ("windows = 12", f"windows = 1{'0' * 400}", "windows of .coordinate. is 1000.*; give a whole number above 0"),
        (
            "[workers]",
            "".join(f"[[coordinate]]\ndistance = [0, {k}]\nfrom=1\nto=2\nwindows=90000\n" for k in range(1, 5))
            + "[workers]",
            "the plan has 787,320,000,000,000,000,000 windows",
        ),
        ("to = 180", f"to = 1{'0' * 400}", r"to of \[coordinate\] is 10{10,30}\.\.\.0+; give a number"),
        ("timestep = 0.5", f"timestep = 1{'0' * 400}", "give a positive number"),
        ("timestep = 0.5", f"timestep.{'.'.join('a' * 3000)} = 0.5", r"timestep of \[sampling\] is .*give one value"),
        ("[workers]", f"a = {'[' * 5000}{']' * 5000}\n[workers]", "lists or tables are too deep in each other"),
        ("[workers]", f"a = {'{b = ' * 5000}1{'}' * 5000}\n[workers]", "lists or tables are too deep in each other"),
    ],
)
def test_wrong_plans(folder, old, new, match):
    assert old in PLAN
    with pytest.raises(KconsError, match=match):
        read(folder, PLAN.replace(old, new))


FORCES = PLAN[PLAN.index('calculator = "lj"') : PLAN.index("[[coordinate]]")]
STRANGE = """
import pathlib
from ase.calculators.lj import LennardJones
pathlib.Path(__file__).with_suffix(".ran").touch()
def made():
    return LennardJones()
"""


def test_a_plan_runs_no_code_that_nobody_allowed(folder, monkeypatch):
    """Modules are named by who runs the plan, and nothing of them is imported by reading it."""
    (folder / "strange.py").write_text(STRANGE)
    monkeypatch.syspath_prepend(folder)
    with pytest.raises(InputError, match="--allow-module strange "):
        read(folder, PLAN.replace(FORCES, 'calculator = "strange:made"\n'))
    plan = read_plan(folder / "plan.toml", allow_modules=["strange"])
    assert plan.sampler.begin()[0] == pytest.approx([np.pi])
    assert not (folder / "strange.ran").exists()
    Windows(plan.sampler, folder / "out", plan.settings)  # about to run
    assert (folder / "strange.ran").exists()
    for name, module in (("cp2k", "ase.calculators.cp2k"), ("os:system", "os")):
        with pytest.raises(InputError, match=f"--allow-module {module} "):
            read(folder, PLAN.replace(FORCES, f'calculator = "{name}"\nsettings = {{command = "touch ran"}}\n'))


def nothing(state):
    return 0.0, np.zeros((6, 3))


class Touches:
    """Touches a file when its pickle is read."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_system_of_a_plan_runs_no_code(folder):
    """A PythonForce is code, which OpenMM runs while it reads the file."""
    system = openmm.System()
    for mass in molecule("CH3OH").get_masses():
        system.addParticle(mass)
    system.addForce(openmm.PythonForce(nothing))
    code = pickle.dumps(Touches(folder / "ran")).hex()
    xml, changed = re.subn('function="[0-9a-f]*"', f'function="{code}"', openmm.XmlSerializer.serialize(system))
    assert changed == 1
    (folder / "system.xml").write_text(xml)
    text = PLAN.replace(FORCES, 'system = "system.xml"\n').replace('[held]\nconstrain = "hbonds"\n', "")
    with pytest.raises(InputError, match=r"system\.xml has a PythonForce in it, whose code would run"):
        read(folder, text)
    assert not (folder / "ran").exists()


def test_an_unknown_scheduler(folder, monkeypatch):
    with pytest.raises(InputError, match="cannot be read"):
        read_plan(folder)
    with pytest.raises(InputError, match="give a path"):
        read_plan(None)
    with pytest.raises(InputError, match="no file"):
        read_plan(folder / "nothing.toml")
    plan = read(folder, PLAN.replace("processes = 3", 'scheduler = "tcp://127.0.0.1:9"'))
    distributed = pytest.importorskip("distributed")
    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", lambda address, timeout: client(address, timeout="1s"))
    with pytest.raises((InputError, UnsupportedError), match=r"no scheduler of Dask answers at tcp://127\.0\.0\.1:9"):
        plan.executor()
