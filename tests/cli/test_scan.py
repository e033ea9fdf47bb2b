"""The command `kcons scan`."""

from __future__ import annotations

import json

import ase.io
import numpy as np
import pandas
import pytest
from ase.build import molecule

from kcons.cli import main


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    molecule("H2O2").write("peroxide.xyz")

    def command(*words):
        return main.main(["scan", *map(str, words)])

    return command


EMT = ("--calculator", "emt", "--fmax", "0.05")


def test_a_torsion(run, tmp_path, capsys):
    assert run("peroxide.xyz", "--dihedral", 2, 0, 1, 3, "--steps", 3, *EMT) == 0
    shown = capsys.readouterr().out
    assert "dihedral_2_0_1_3_degrees" in shown and "3 of 3 points" in shown and "wrote scan-peroxide/scan.csv" in shown
    first = pandas.read_csv(tmp_path / "scan-peroxide" / "scan.csv")
    assert [*first.dihedral_2_0_1_3_degrees.round()] == [-180, -60, 60]
    # Again: nothing is left to be done, and nothing changes.
    assert run("peroxide.xyz", "--dihedral", 2, 0, 1, 3, "--steps", 3, *EMT) == 0
    assert pandas.read_csv(tmp_path / "scan-peroxide" / "scan.csv").equals(first)
    # Atoms counted from 1.
    words = ("--dihedral", 3, 1, 2, 4, "--count-from", 1, "--steps", 3, "--out", "other")
    assert run("peroxide.xyz", *words, *EMT) == 0
    assert pandas.read_csv(tmp_path / "other" / "scan.csv").equals(first)


def test_two_coordinates_and_what_is_held(run, tmp_path):
    words = ("--dihedral", 2, 0, 1, 3, "--distance", 0, 1, "--from", 60, 1.4, "--to", 90, 1.5, "--steps", 1, 2)
    assert run("peroxide.xyz", *words, "--hold-angle", 2, 0, 1, "--hold-distance", 0, 2, "--one-way", *EMT) == 0
    plan = json.loads((tmp_path / "scan-peroxide" / "plan.json").read_text())
    assert [item["family"] for item in plan["coordinates"]] == ["Dihedral", "Distance"]
    assert [item["family"] for item in plan["held"]] == ["Distance", "Angle"]
    assert plan["values"][0] == pytest.approx(np.radians([60, 90])) and plan["values"][1] == [1.4, 1.45, 1.5]
    assert plan["settings"]["both_ways"] is False
    points = pandas.read_csv(tmp_path / "scan-peroxide" / "scan.csv")
    assert len(points) == 6 and points.error.isna().all()


def test_a_difference_of_distances(run, tmp_path):
    """r(0, 2) - r(2, 1), of atoms of which one is in both."""
    words = ("--difference", 0, 2, 2, 1, "--from", -0.9, "--to", -0.8, "--steps", 2)
    assert run("peroxide.xyz", *words, "--hold-difference", 1, 3, 0, 1, *EMT) == 0
    found = ase.io.read(tmp_path / "scan-peroxide" / "scan.extxyz", ":")
    differences = [atoms.get_distance(0, 2) - atoms.get_distance(2, 1) for atoms in found]
    assert differences == pytest.approx([-0.9, -0.85, -0.8], abs=1e-7)
    first = ase.io.read("peroxide.xyz")
    held = [atoms.get_distance(1, 3) - atoms.get_distance(0, 1) for atoms in (first, *found)]
    assert held == pytest.approx([held[0]] * 4, abs=1e-7)


def test_bonds_by_name_are_held(run, tmp_path):
    words = ("--dihedral", 2, 0, 1, 3, "--from", 100, "--to", 120, "--steps", 1)
    assert run("peroxide.xyz", *words, "--constrain", "hbonds", *EMT) == 0
    first = ase.io.read("peroxide.xyz")
    for atoms in ase.io.read(tmp_path / "scan-peroxide" / "scan.extxyz", ":"):
        for pair in ((0, 2), (1, 3)):
            assert atoms.get_distance(*pair) == pytest.approx(first.get_distance(*pair), abs=1e-7)
        assert atoms.get_distance(0, 1) != pytest.approx(first.get_distance(0, 1), abs=1e-3)  # relaxed


def test_points_that_fail_are_told_by_the_exit_status(run, capsys):
    words = ("--distance", 2, 3, "--from", 1.5, "--to", 3.5, "--steps", 1, "--fix", 0, 1)
    held = ("--hold-distance", 0, 2, "--hold-distance", 1, 3)
    assert run("peroxide.xyz", *words, *held, *EMT) == 3
    assert "failed: Distance(2, 3) = 3.5: InfeasibleError" in capsys.readouterr().out


TURN = ("--dihedral", 2, 0, 1, 3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("none.xyz", *TURN), "there is no file none.xyz"),
        (("bad.xyz", *TURN), "ASE cannot read bad.xyz"),
        (("peroxide.xyz",), "name what is scanned: --dihedral"),
        (("peroxide.xyz", "--distance", 0, 1, "--from", 0, "--to", 1), "there is no distance of 0 to hold"),
        (("peroxide.xyz", "--distance", 0, 1), "give --from: only dihedrals have a range by themselves"),
        (("peroxide.xyz", "--difference", 0, 2, 2, 1, "--to", 1), "give --from: only dihedrals have a range by"),
        (("peroxide.xyz", "--angle", 0, 1, 2, "--from", 60, "--to", 190), "there is no angle of 184"),
        (("peroxide.xyz", *TURN, "--to", 1, 2), "--to has 2 numbers for 1 coordinates"),
        (("peroxide.xyz", *TURN, "--steps", 0), "--steps is 0; give a positive number"),
        (("peroxide.xyz", *TURN, "--count-from", 1), "there is no atom 0; atoms are counted from 1"),
        (("peroxide.xyz", "--dihedral", 2, 0, 1, 9), "atom 9"),
        (("peroxide.xyz", *TURN, "--settings", "{"), "--settings are {; give names and values as JSON"),
        (("peroxide.xyz", *TURN, "--settings", "[]"), "--settings are []; give names and values"),
        (("peroxide.xyz", *TURN, "--calculator", "abacus"), "no calculator 'abacus'"),
        (("peroxide.xyz", *TURN, "--calculator", "ase.calculators.emt:None"), "no calculator 'ase.calculators.emt:N"),
        (("peroxide.xyz", *TURN, "--fmax", 0), "fmax is 0.0; give a positive number"),
        (("peroxide.xyz", *TURN, "--hold-dihedral", *TURN[1:]), "dihedral_2_0_1_3 depends on the other constraints"),
    ],
)
def test_wrong_use(run, tmp_path, capsys, words, said):
    (tmp_path / "bad.xyz").write_text("three\n")
    extra = () if "--calculator" in words else ("--calculator", "ase.calculators.emt:EMT")
    assert run(*words, *extra) == 2
    shown = capsys.readouterr().err
    assert said in shown and "relaxed scan" not in shown
