"""The figures and examples of the notes: every script runs, says something and draws its figure."""

from __future__ import annotations

import re
import runpy
from contextlib import chdir, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import matplotlib
import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "notes"
SCRIPTS = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "growth_results")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs a script once, in a folder for all: its names, what it said, and the folder."""
    before = matplotlib.get_backend()
    matplotlib.use("Agg")
    folder = tmp_path_factory.mktemp("notes")

    @cache
    def one(name):
        with chdir(folder), redirect_stdout(StringIO()) as out:
            names = runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        plt.close("all")
        return names, out.getvalue(), folder

    yield one
    matplotlib.use(before)


@pytest.mark.parametrize("name", SCRIPTS)
def test_script_draws_its_figure(name, run):
    names, out, folder = run(name)
    assert out.strip() and len(SCRIPTS) == 11 + 5
    picture = matplotlib.image.imread(folder / f"{name}.png")
    assert picture.shape[0] > 200 and np.ptp(picture[..., :3]) > 0.5
    assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    check_labels(names["fig"])
    check_legends(names["fig"])


def check_labels(figure):
    """What is drawn along an axis is said, with its unit in parentheses; a shared axis says it once, at the bottom."""
    for axes in figure.axes:
        if not axes.axison:
            continue
        shared = [other.get_xlabel() for other in axes.get_shared_x_axes().get_siblings(axes)]
        labels = [max(shared, key=len), axes.get_ylabel()] + ([axes.get_zlabel()] if axes.name == "3d" else [])
        if axes.get_label() == "<colorbar>":
            labels = [axes.get_ylabel()]
        for label in labels:
            assert re.search(r"\(.+\)$", label), label


def check_legends(figure):
    """No legend lies on a panel, its labels or its curves; curves of several colors in a panel have one."""
    figure.draw_without_rendering()
    assert not [axes for axes in figure.axes if axes.get_legend()]
    boxes = [legend.get_window_extent() for legend in figure.legends]
    for axes in figure.axes:
        for box in boxes:
            assert axes.name == "3d" or not box.overlaps(axes.get_tightbbox())
            for line in axes.lines:
                path = line.get_transform().transform_path(line.get_path()).interpolated(10)
                assert not box.count_contains(path.vertices)
        colors = {line.get_color() for line in axes.lines if len(line.get_xdata()) > 100}
        assert boxes or len(colors) < 2


def test_example_1_says_what_is_so(run):
    names, out, _ = run("example_1")
    omega, form = names["omega"], names["form"]
    assert np.array_equal(np.diag(form.J), [-1j * omega, 1j * omega])  # (16), (17)
    assert np.array_equal(form.T, [[1j, -1j], [1, 1]])
    assert "eigenvalues ((-0-2j), (-0+2j))" in out
    # exp(At) three ways and by the flow.
    c, s = np.cos(omega * names["t"]), np.sin(omega * names["t"])
    for P in (names["series"], names["by_jordan"], names["turn"], names["flow"].propagator(names["t"])):
        assert pytest.approx(np.array([[c, s], [-s, c]]), abs=1e-15) == P
    assert pytest.approx(np.cos(omega * names["times"]), abs=1e-14) == names["X"][:, 0]


def test_figure_11_starts_where_the_text_of_the_notes_holds(run):
    _, out, _ = run("figure_11")
    largest = [float(line.split("half the time ")[1].split(";")[0]) for line in out.splitlines()]
    # (c) a tenth below (a), as the docstring has them, and (b) on its way to rest.
    assert largest[0] == pytest.approx(0.783, abs=2e-3)
    assert largest[2] == pytest.approx(0.697, abs=2e-3)
    assert largest[1] < 0.4
