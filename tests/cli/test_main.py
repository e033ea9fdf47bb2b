"""The command `kcons`: what it writes, and how it says that something is wrong."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from kcons.cli import main, plan

needs_openmm = pytest.mark.skipif(find_spec("openmm") is None, reason="openmm is an extra")


ALANINE = Path(__file__).parents[1] / "data" / "alanine-dipeptide-implicit.pdb"


def run(*arguments):
    return main.main([str(a) for a in arguments])


def test_plan_prints_clusters_rank_and_solver(capsys):
    assert run("plan", "chain", "--size", 6) == 0
    text = capsys.readouterr().out
    assert "chain of 6 rigid bonds" in text
    assert "rank 6" in text
    assert "solver" in text


def test_without_command_prints_help(capsys):
    assert run() == 0
    assert "compare" in capsys.readouterr().out


def test_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("kcons ")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["compare"], "name a test system: alanine"),
        (["compare", "wat"], "there is no test system 'wat'"),
        (["plan", "wat"], "there is no test system 'wat'"),
        (["compare", "chain", "--methods", "shake"], "there is no method 'shake'"),
        (["compare", "chain", "--methods", ","], "no method"),
        (["compare", "chain", "--size", "0"], "at least one bond"),
        (["compare", "chain", "--size", "3", "--dt", "3"], "does not divide the horizon"),
        (["compare", "chain", "--size", "3", "--dt", ","], "--dt is empty"),
        (["compare", "chain", "--seed", "-1"], "non-negative"),
        (["compare", "chain", "--size", "3", "--budget", "-1"], "positive number of seconds"),
        (["compare", "chain", "--size", "3", "--out", "/dev/null/x"], "/dev/null"),
        (["plan", str(ALANINE), "--constrain", "none"], "none with kcons compare --forces"),
    ],
)
def test_mistakes_give_one_line_and_status_2(arguments, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("kcons: ")]
    assert len(lines) == 1
    assert text in lines[0]
    assert not list(tmp_path.glob("**/compare.*"))


@pytest.mark.parametrize("arguments", [["frobnicate"], ["compare", "chain", "--dt", "a,b"], ["compare", "--size", "x"]])
def test_unreadable_arguments_leave_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as left:
        run(*arguments)
    assert left.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("place", ["taken", "taken/below"])
def test_a_file_where_a_folder_has_to_be(place, tmp_path, capsys):
    (tmp_path / "taken").touch()
    assert run("compare", "chain", "--size", 4, "--methods", "rattle", "--dt", 10, "--out", tmp_path / place) == 2
    assert "there is a file where a folder has to be; give another folder (--out)" in capsys.readouterr().err


def test_interrupt(monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(plan, "test_system", stop)
    assert run("plan", "chain") == 130
    assert capsys.readouterr().err == "kcons: interrupted\n"


def test_importing_the_command_imports_no_md_engine():
    code = (
        "import sys, kcons.cli.main; "
        "print([m for m in ('ase', 'openmm', 'matplotlib', 'rich', 'tblite') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


# -- molecules in OpenMM ----------------------------------------------------------------------------


@needs_openmm
def test_plan_of_own_file(capsys):
    assert run("plan", ALANINE, "--constrain", "hangles") == 0
    assert "HAngles: 30 distances" in capsys.readouterr().out


@needs_openmm
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("compare", "missing.pdb"), "there is no file missing.pdb"),
        (("compare", ALANINE, "--size", "3"), "leave --size out"),
        (("compare", ALANINE, "--forcefield", "nowhere.xml"), "force field nowhere.xml"),
        (("plan", ALANINE, "--platform", "Abacus"), "no platform 'Abacus'"),
        (("compare", "chain", "--constrain", "hbonds"), "not for 'chain'"),
        (("compare", "alanine", "--add-hydrogens"), "is for files"),
    ],
)
def test_what_is_wrong_with_molecules(tmp_path, monkeypatch, capsys, arguments, text):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["chain", "--criterion", "drift", "--target-error", "1e-3"], "leave --criterion drift out"),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value),
)
def test_criteria_that_do_not_fit(words, said, capsys):
    assert run("compare", *words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["compare", "chain", "--methods", "rattle"], ["compare.csv", "compare.png", "compare.txt"]),
        (["compare", "chain", "--criterion", "temperature"], ["compare.csv", "compare.png", "compare.txt"]),
    ],
    ids=lambda given: "-".join(given[:2]),
)
def test_results_of_others_are_not_overwritten(words, names, tmp_path, capsys):
    """Before anything is measured."""
    for name in names:
        other = tmp_path / name / name
        other.parent.mkdir()
        other.write_text("precious")
        assert run(*words, "--out", other.parent) == 2
        assert f"other files called {name}; give another folder (--out)" in capsys.readouterr().err
        assert [path.name for path in other.parent.iterdir()] == [name] and other.read_text() == "precious"


def test_a_comparison_replaces_that_of_the_same_system_alone(tmp_path, capsys):
    words = ("--methods", "rattle", "--dt", 10, "--out", tmp_path)
    assert run("compare", "chain", "--size", 3, *words) == 0
    assert run("compare", "chain", "--size", 4, *words) == 0
    before = (tmp_path / "compare.csv").read_bytes()
    assert run("compare", "sphere", *words) == 2
    assert "has a comparison of other system (chain); give another folder (--out)" in capsys.readouterr().err
    assert (tmp_path / "compare.csv").read_bytes() == before
