"""The commands `kcons hardcases` and `kcons stability`."""

from __future__ import annotations

from kcons.cli import main
from kcons.comparison.stability import fuzz


def test_hard_cases(tmp_path, capsys):
    assert main.main(["hardcases", "--list", "--only", "H14,X06"]) == 0
    assert capsys.readouterr().out.startswith("H14  Pendulum at 2 rad, 1e7 steps")
    assert main.main(["hardcases", "--quick", "--only", "X06", "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "as asked for" in shown and "hard_cases.html" in shown
    assert main.main(["hardcases", "--only", "nothing", "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()


def test_stability(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fuzz, "trial", lambda seed: fuzz.Trial(seed, "tree", "solved"))
    assert main.main(["stability", "--quick", "--only", "fuzz", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "300 random molecules" in shown and "stability.html" in shown
