"""The figures and examples of the notes: every script runs, says something and draws its figure."""

from __future__ import annotations

import runpy
from pathlib import Path

import matplotlib
import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "examples" / "notes"
SCRIPTS = [f"figure_{k:02d}" for k in range(1, 12)] + [f"example_{k}" for k in range(1, 6)]


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_draws_its_figure(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = matplotlib.get_backend()
    matplotlib.use("Agg")
    try:
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
    finally:
        plt.close("all")
        matplotlib.use(before)
    assert capsys.readouterr().out.strip()
    picture = matplotlib.image.imread(tmp_path / f"{name}.png")
    assert picture.shape[0] > 200
    assert np.ptp(picture[..., :3]) > 0.5


def test_every_figure_and_example_has_a_script():
    assert {path.stem for path in FOLDER.glob("*.py")} - {"growth_results"} == set(SCRIPTS)
