"""What `--list` prints."""

from __future__ import annotations

import pytest

from kcons.cli.main import main


@pytest.mark.parametrize("command", ["compare", "plan"])
def test_list(command, capsys):
    assert main([command, "--list"]) == 0
    text = capsys.readouterr().out
    for word in ("water", "chain-straight", "ethanol", "triple-pendulum", "slab", "rattle", "dop853"):
        assert word in text
    for word in ("isokinetic-notes", "nose-hoover", "langevin-halfway"):
        assert f"  {word} " in text
    for word in ("geodesic", "yoshida4", "blanes-moan6a", "projected-verlet", "projected-rk4", "baumgarte"):
        (line,) = (line for line in text.splitlines() if line.startswith(f"  {word} "))
        assert line.endswith("(only when named)")
