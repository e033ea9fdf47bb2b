"""`kcons compare --slow --fast`."""

from __future__ import annotations

import json

import pytest

from kcons.cli import main
from kcons.comparison.averages import long_steps, sampling


def test_how_long_the_step_may_be(tmp_path, monkeypatch, capsys):
    """A fluid with near molecules inside; a table, and files."""
    monkeypatch.chdir(tmp_path)
    command = "compare thermostat-water --quick --fast 3.8 --methods spheres --dt 4 --budget 0.3 --out found"
    assert main.main(command.split()) == 0
    assert "isokinetic spheres" in capsys.readouterr().out
    data = json.loads((tmp_path / "found" / "compare.json").read_text(encoding="utf-8"))
    assert data["format"] == "kcons-long-steps-1" and {run["step"] for run in data["runs"]} == {4.0}


@pytest.mark.parametrize(
    "command, text",
    [
        ("compare thermostat-water --slow 4", "--slow needs --fast"),
        ("compare thermostat-water --fast near", "kcons: --fast near: for a fluid give how far molecules reach"),
        ("compare chain --fast 3", "are for thermostat, thermostat-dumbbells, thermostat-water and for files"),
        ("compare thermostat-water --fast 3 --methods rattle", "there is no method 'rattle'"),
        ("compare thermostat-water --fast 9", "molecules reach 9"),
        ("compare run.pdb --slow gfn2 --fast gfn2", "are both gfn2: give cheaper forces to --fast"),
        ("compare thermostat --fast 1 --seed -1", "give a non-negative number"),
        ("compare thermostat --fast 1 --criterion temperature", "--criterion does not go with --slow and --fast"),
        ("compare thermostat --fast 1 --constrain hbonds", "--constrain does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --add-hydrogens", "--add-hydrogens does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --size 3", "--size does not go with"),
        ("compare run.pdb --slow gfn2 --fast lj --forces emt", "--forces does not go with"),
    ],
)
def test_expensive_and_cheap_forces_that_cannot_be(command, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.pdb").touch()
    assert main.main(command.split()) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    "module, function, planned, command",
    [
        (sampling, "_measured", 2, "compare thermostat --size 8 --methods isokinetic --dt 0.01,0.005 --budget 0.4"),
        (long_steps, "measure", 4, "compare thermostat-water --quick --fast 3.8 --methods spheres --dt 4,8 --budget 1"),
    ],
)
def test_ctrl_c_writes_the_runs_that_are_done(module, function, planned, command, tmp_path, monkeypatch, capsys):
    measure, calls = getattr(module, function), []

    def second_is_stopped(*arguments, **options):
        calls.append(arguments)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return measure(*arguments, **options)

    monkeypatch.setattr(module, function, second_is_stopped)
    assert main.main([*command.split(), "--out", str(tmp_path / "found")]) == 130
    said = f"interrupted: 1 of {planned} runs were measured"
    assert said in capsys.readouterr().out and said in (tmp_path / "found" / "compare.txt").read_text(encoding="utf-8")
    data = json.loads((tmp_path / "found" / "compare.json").read_text(encoding="utf-8"))
    assert data["settings"]["interrupted"] == said
    assert len(data["runs" if "runs" in data else "measurements"]) == 1
    calls[:] = [None]  # before anything is done
    assert main.main([*command.split(), "--out", str(tmp_path / "empty")]) == 130
    assert not (tmp_path / "empty" / "compare.json").exists()
