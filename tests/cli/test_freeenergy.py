"""The command `kcons freeenergy`."""

from __future__ import annotations

import json

import numpy as np
import pytest
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
    assert capsys.readouterr().out == (
        "4 windows of turn, a run each\n84 steps a run: pull 10, equilibration 10, production 64; a sample every 2\n"
    )
    assert main(["freeenergy", "plan.toml", "--workers", "1"]) == 0
    shown = capsys.readouterr()
    assert "turn (degrees)" in shown.out and "wrote plan/profile.png" in shown.out
    assert len(list((tmp_path / "plan").glob("window-*.npz"))) == 4
    known = json.loads((tmp_path / "plan" / "free_energy.json").read_text())
    assert main(["freeenergy", "plan.toml", "--workers", "1"]) == 0
    assert json.loads((tmp_path / "plan" / "free_energy.json").read_text()) == known
    assert main(["freeenergy", "nothing.toml"]) == 2
    assert "there is no file" in capsys.readouterr().err


PULLS = """
[pulls]
to = 200
count = 5
steps = 40
"""


def test_pulls_beside_windows(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "methanol.xyz", molecule("CH3OH"))
    (tmp_path / "plan.toml").write_text(PLAN + PULLS)
    assert main(["freeenergy", "plan.toml", "--list"]) == 0
    assert "5 pulls both ways of 40 steps each" in capsys.readouterr().out
    assert main(["freeenergy", "plan.toml", "--workers", "1"]) == 0
    shown = capsys.readouterr().out
    assert "pulls give " in shown and "(BAR;" in shown and " standard errors" in shown and "plan/pulls.json" in shown
    assert len(list((tmp_path / "plan" / "pulls").glob("pull-*.npz"))) == 10
    known = json.loads((tmp_path / "plan" / "pulls.json").read_text())
    assert np.degrees([known["from"][0], known["to"][0]]) == pytest.approx([60, 200])
    assert set(known) >= {"bar", "jarzynski", "windows"}
    difference = (known["bar"][0] - known["windows"][0]) / np.hypot(known["bar"][1], known["windows"][1])
    assert f"{difference:+.1f} standard errors" in shown
