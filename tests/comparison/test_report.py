"""What is shown of a comparison: at most 30 lines, one file, one figure without cut or covered names."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise

import pandas as pd
import pytest

from kcons.comparison import compare, figure, rank, read_csv, test_systems, text, write_csv
from kcons.comparison.progress import duration
from kcons.comparison.report import CURVES, chosen_curves, sentence
from kcons.errors import InputError


@functools.cache
def table():
    names = ["rattle", "suzuki4", "blanes-moan4", "kahan-li6", "blanes-moan6", "dop853", "ase-kcons"]
    names += ["ase-bonds", "verlet", "openmm-verlet", "openmm-kcons-rattle", "openmm-verlet-1e-12"]
    system = test_systems.build("dumbbells").shortened(50).with_time_steps([0.01, 0.005])
    return compare(system, names, rounds=1, budget=10)


def test_the_text_has_at_most_thirty_lines():
    found = rank(table())
    shown = text(table(), found, "\n".join(f"line {k}" for k in range(14)), "Forces are too expensive.")
    assert len(shown.splitlines()) + 1 <= 30  # and one that says what was written
    assert shown.splitlines()[0].startswith("Use ") and "In Python:" in shown
    assert "... and" in shown and "are equal (=)" in shown
    assert f"Measured on {table().attrs['title']}; a run of {table().attrs['horizon']:g} " in shown
    assert max(len(line) for line in shown.splitlines()[3:]) <= 100


def test_the_sentence_names_ties_and_no_winner_within_the_scatter():
    found = rank(table())
    words = sentence(table(), replace(found, table=found.table.assign(place=1)))
    assert "; equally cheap within" in words and "more" in words
    assert sentence(table(), rank(table(), limit=1e-30)).startswith("No method makes an error of at most 1e-30")
    nothing = table()[table().method == "verlet"]
    assert rank(nothing) is None and "No method reached the horizon" in sentence(nothing, None)
    assert "no method reached the horizon" in [t.get_text() for t in figure(nothing).axes[0].texts]


def test_few_steps_and_times_that_were_taken_once_are_told():
    """A step that is too long may fail later."""
    few, more = (replace(found, table=found.table.assign(steps=n)) for found in [rank(table())] for n in (2, 20))
    assert "made 2 steps only: see how a longer run goes" in sentence(table(), few)
    assert "steps only" not in sentence(table(), more)
    once = table().assign(rounds=0)
    once.attrs = {**table().attrs, "force_seconds": 1.0}
    assert "once" in text(once, rank(once))


def test_the_file_gives_back_the_table(tmp_path):
    path = tmp_path / "compare.csv"
    write_csv(path, table())
    again = read_csv(str(path))
    pd.testing.assert_frame_equal(again, table(), check_dtype=False, check_exact=True)
    assert again.attrs == table().attrs
    assert path.read_text(encoding="utf-8").startswith("# name: ")
    assert [file.name for file in tmp_path.iterdir()] == ["compare.csv"]
    with pytest.raises(InputError, match=r"read it by kcons\.comparison\.read_csv"):
        rank(pd.read_csv(path, comment="#"))
    for bad in ("", "a,b\n1,2\n", "# title: 1\n"):
        path.write_text(bad)
        with pytest.raises(InputError, match="holds no comparison of kcons"):
            read_csv(path)


@pytest.mark.parametrize("width", [5.0, 7.0, 11.0])
def test_no_name_is_cut_or_covers_another(width):
    """By pixels: all text lies within the picture, and names of curves do not touch each other or the panel."""
    drawn = figure(table(), width)
    drawn.canvas.draw()
    (axes,) = drawn.axes
    whole, panel = drawn.bbox, axes.get_window_extent()
    names = [note.get_window_extent() for note in axes.texts]
    labels = [axes.xaxis.label, axes.yaxis.label, axes.title, axes._left_title, *axes.texts, *drawn.texts]
    for box in (label.get_window_extent() for label in labels if label.get_text()):
        assert whole.x0 - 1 <= box.x0 and box.x1 <= whole.x1 + 1, "cut"
        assert whole.y0 - 1 <= box.y0 and box.y1 <= whole.y1 + 1, "cut"
    assert 5 <= len(names) <= CURVES
    text_only = [(note._renderer and note.get_bbox_patch()) or note for note in axes.texts]
    assert all(note.xyann[0] > 1.0 for note in text_only) and panel.width > 0.4 * whole.width
    heights = sorted(note.xyann[1] * panel.height for note in axes.texts)
    pixels = 8 * drawn.dpi / 72
    assert all(b - a >= pixels for a, b in pairwise(heights))
    legend = axes.get_legend().get_window_extent()
    assert panel.x0 <= legend.x0 and legend.x1 <= panel.x1 and panel.y0 <= legend.y0 and legend.y1 <= panel.y1


def test_a_figure_shows_few_curves_and_rattle():
    kept = chosen_curves(table())
    assert len(kept) == CURVES and "rattle" in kept
    ours = [name for name in kept if "kcons" in table()[table().method == name].title.iloc[0]]
    assert CURVES // 2 <= len(ours) < CURVES


def test_durations():
    given = (2.5e-9, 1.25e-5, 0.0125, 3.0, 700.0, 8000.0)
    assert [duration(s) for s in given] == ["2.50 ns", "12.5 µs", "12.5 ms", "3.00 s", "12 min", "2.2 h"]
