"""The command `kcons freeenergy`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ase.build import molecule
from ase.io import write

from kcons.cli.main import main
from kcons.free_energy import Windows, read_input

INPUT = """
[structure]
file = "methanol.xyz"
[forces]
calculator = "lj"
settings = {sigma = 1.0, epsilon = 0.02, rc = 6.0}
[[coordinate]]
name = "turn"
dihedral = [2, 0, 1, 3]
values = [60, 120, 180, 240]
[held]
fixed = [0]
distances = [[0, 1], [1, 3], [0, 3], [0, 2], [0, 4], [0, 5], [2, 4], [4, 5], [2, 5], [1, 2], [1, 4], [1, 5]]
[sampling]
relax = 2
pull = 10
equilibration = 10
production = 64
every = 2
both_sides = false
"""


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "methanol.xyz", molecule("CH3OH"))
    (tmp_path / "input.toml").write_text(INPUT)


def test_an_input_runs_and_goes_on(tmp_path, capsys):
    assert main(["freeenergy", "input.toml", "--workers", "1"]) == 0
    shown = capsys.readouterr()
    assert "turn (degrees)" in shown.out and "wrote input/profile.png" in shown.out
    assert len(list((tmp_path / "input").glob("window-*.npz"))) == 4
    known = json.loads((tmp_path / "input" / "free_energy.json").read_text())
    assert main(["freeenergy", "input.toml", "--workers", "1"]) == 0
    assert json.loads((tmp_path / "input" / "free_energy.json").read_text()) == known
    assert main(["freeenergy", "nothing.toml"]) == 2
    assert "No such file or directory: 'nothing.toml'" in capsys.readouterr().err


def test_modules_of_an_input_are_allowed_by_name(tmp_path, capsys):
    mine = 'calculator = "lj"\nsettings = {sigma = 1.0, epsilon = 0.02, rc = 6.0}'
    other = 'calculator = "os:system"\nsettings = {command = "touch ran"}'
    assert mine in INPUT
    (tmp_path / "input.toml").write_text(INPUT.replace(mine, other))
    for more, said in (
        ([], "--allow-module os on the command"),
        (["--allow-module", "os"], "os:system is no calculator of ASE"),
    ):
        assert main(["freeenergy", "input.toml", *more]) == 2
        assert said in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["input.toml", "methanol.xyz"]


def test_a_run_that_is_stopped_says_how_it_goes_on(tmp_path):
    """And ends within seconds, whatever its windows would take."""
    (tmp_path / "input.toml").write_text(INPUT.replace("production = 64", "production = 100_000_000"))
    process = subprocess.Popen(
        [sys.executable, "-m", "kcons", "freeenergy", "input.toml", "--workers", "2"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while not (tmp_path / "input" / "settings.json").exists():
            assert process.poll() is None
            time.sleep(0.05)
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 143
    assert "kcons: terminated; finished windows are kept: run again to resume" in said and "Traceback" not in said
    assert [path.name for path in (tmp_path / "input").iterdir()] == ["settings.json"]


def test_two_runs_into_one_folder(capsys):
    given = read_input("input.toml")
    with Windows(given.sampler, "input", given.settings, **given.options).taken():
        assert main(["freeenergy", "input.toml"]) == 2
    assert "kcons: another run writes into input (process " in capsys.readouterr().err
