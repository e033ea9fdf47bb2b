"""The command `kcons`: what it writes, and how it says that something is wrong."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from kcons.cli import main

ALANINE = Path(__file__).parents[1] / "data" / "alanine-dipeptide-implicit.pdb"
needs_openmm = pytest.mark.skipif(find_spec("openmm") is None, reason="openmm is an extra")


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").touch()


def run(*arguments):
    return main.main([str(a) for a in arguments])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("plan", "chain", "--size", 6), ("chain of 6 rigid bonds", "rank 6", "solver")),
        ((), ("compare", "freeenergy", "warmup")),
        pytest.param(("plan", ALANINE, "--constrain", "hangles"), ("21 Distance, 9 Angle",), marks=needs_openmm),
    ],
    ids=str,
)
def test_what_is_said(words, said, capsys):
    assert run(*words) == 0
    text = capsys.readouterr().out
    assert all(each in text for each in said)


@pytest.mark.parametrize("command", ["compare", "plan"])
def test_list(command, capsys):
    assert run(command, "--list") == 0
    text = capsys.readouterr().out
    listed = ("  isokinetic-notes ", "  nose-hoover ", "  langevin-halfway ")
    for word in (*listed, "water", "chain-straight", "ethanol", "triple-pendulum", "slab", "rattle", "dop853"):
        assert word in text
    for word in ("geodesic", "yoshida4", "blanes-moan6a", "projected-verlet", "projected-rk4"):
        (line,) = (line for line in text.splitlines() if line.startswith(f"  {word} "))
        assert line.endswith("(only when named)")


TAKEN = "there is a file where a folder has to be; give another folder (--out)"
#: What is wrong, and what is said of it.
MISTAKES = [
    ("compare", "name a test system: alanine"),
    ("compare wat", "there is no test system 'wat'"),
    ("plan wat", "there is no test system 'wat'"),
    ("compare watr", "did you mean 'water'?"),
    ("compare water --methods ratle", "did you mean 'rattle'?"),
    ("warmup watr", "did you mean 'water'?"),
    ("compare chain --methods shake", "there is no method 'shake'"),
    ("compare chain --methods ,", "no method"),
    ("compare chain --size 0", "size is 0; give a whole number, 1 or more"),
    ("compare chain --size 3 --dt 3", "does not divide the horizon"),
    *((f"compare chain --size 3 --dt {dt}", "give a positive step of at most the horizon") for dt in (0, -1, 1e9)),
    ("compare chain --size 3 --dt ,", "--dt is empty"),
    ("compare chain --size 3 --budget -1", "budget is -1.0; give a positive number"),
    ("compare chain --size 3 --out /dev/null/x", "/dev/null"),
    ("compare chain --criterion temperature --target-error 1e-3", "leave --criterion temperature out"),
    *((f"compare chain --size 4 --methods rattle --dt 10 --out {place}", TAKEN) for place in ("taken", "taken/below")),
]
OF_MOLECULES = [
    ("compare missing.pdb", "there is no file missing.pdb"),
    (f"compare {ALANINE} --size 3", "leave --size out"),
    (f"compare {ALANINE} --forcefield nowhere.xml", "force field nowhere.xml"),
    ("plan alanine --platform Abacus", "no platform 'Abacus'"),
    (f"plan {ALANINE} --platform Abacus", "a plan needs no forces; leave --platform out"),
    ("compare chain --constrain hbonds", "chain takes no options, not constrain"),
    ("compare alanine --add-hydrogens", "alanine takes constrain, force_field, platform, not add_hydrogens"),
]


@pytest.mark.parametrize(
    ("words", "text"), [*MISTAKES, *(pytest.param(*each, marks=needs_openmm) for each in OF_MOLECULES)]
)
def test_mistakes_give_one_line_and_status_2(words, text, capsys, tmp_path):
    assert run(*words.split()) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("kcons: ")]
    assert len(lines) == 1 and text in lines[0]
    assert not list(tmp_path.glob("**/compare.*"))


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("comapre water", "invalid choice: 'comapre'"),
        ("compare water --metods rattle", "unrecognized arguments: --metods rattle (did you mean '--methods'?)"),
        ("compare water --constrain hbond", "invalid choice: 'hbond'"),
        ("compare chain --dt a,b", "'a,b' is no list of numbers such as 4,2,1"),
        ("compare --size x", "invalid int value"),
    ],
)
def test_unreadable_arguments_leave_with_status_2(words, meant, capsys):
    with pytest.raises(SystemExit) as left:
        run(*words.split())
    assert left.value.code == 2 and meant in capsys.readouterr().err


def test_importing_the_command_imports_no_md_engine():
    code = "import sys, kcons.cli.main; print({'ase', 'openmm', 'matplotlib', 'rich', 'tblite'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout.strip() == b"set()"


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("compare", "chain", "--methods", "rattle"), ("compare.csv", "compare.png", "compare.txt")),
        (("compare", "chain", "--criterion", "temperature"), ("compare.csv",)),
        (("check", "run.xtc", "--topology", "t.gro"), ("check.json", "check.png", "check.txt")),
    ],
    ids=str,
)
def test_results_of_others_are_not_overwritten(words, names, tmp_path, capsys):
    """Before anything is read or measured."""
    for name in names:
        other = tmp_path / name / name
        other.parent.mkdir()
        other.write_text("precious")
        assert run(*words, "--out", other.parent) == 2
        assert f"other files called {name}; give another folder (--out)" in capsys.readouterr().err
        assert list(other.parent.iterdir()) == [other] and other.read_text() == "precious"


def test_a_comparison_replaces_that_of_the_same_system_alone(tmp_path, capsys):
    words = ("--methods", "rattle", "--dt", 10, "--out", tmp_path)
    assert run("compare", "chain", "--size", 3, *words) == 0
    assert run("compare", "chain", "--size", 4, *words) == 0
    before = (tmp_path / "compare.csv").read_bytes()
    assert run("compare", "sphere", *words) == 2
    assert "has a comparison of another system (chain); give another folder (--out)" in capsys.readouterr().err
    assert (tmp_path / "compare.csv").read_bytes() == before
