"""The command `kcons freeenergy`."""

from __future__ import annotations

import json

from ase.build import molecule
from ase.io import write

from kcons.cli.main import main

PLAN = """
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


def test_a_plan_runs_and_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "methanol.xyz", molecule("CH3OH"))
    (tmp_path / "plan.toml").write_text(PLAN)
    assert main(["freeenergy", "plan.toml", "--list"]) == 0
    assert capsys.readouterr().out == "4 windows of turn, 1 runs of 84 steps each\n"
    assert main(["freeenergy", "plan.toml", "--workers", "1"]) == 0
    shown = capsys.readouterr()
    assert "turn (degrees)" in shown.out and "wrote plan/profile.png" in shown.out
    assert len(list((tmp_path / "plan").glob("window-*.npz"))) == 4
    known = json.loads((tmp_path / "plan" / "free_energy.json").read_text())
    assert main(["freeenergy", "plan.toml", "--workers", "1"]) == 0
    assert json.loads((tmp_path / "plan" / "free_energy.json").read_text()) == known
    assert main(["freeenergy", "nothing.toml"]) == 2
    assert "there is no file" in capsys.readouterr().err
