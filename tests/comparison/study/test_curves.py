"""Panels of curves: logarithmic axes, marks along an edge, one legend."""

from __future__ import annotations

from itertools import pairwise

import pytest

from kcons.comparison.study.curves import Curve, Panel, draw, say


@pytest.fixture
def figure():
    left = Panel([Curve([1, 10], [1e-3, 1e-5], "a", {"color": "red", "marker": "o"})], "x / s", "error", plain="x")
    edge = Curve([2.0], [0.03], "costs", {"linestyle": "none", "marker": "x"}, along="x")
    level = Curve([0, 1], [1e-4, 1e-4], along="y")
    right = Panel([Curve([1, 1e5], [1e-3, 1e-5], "b"), edge, level], notes=("", "made today"), plain="x")
    return draw([[left, right]], (6, 3), title="Title", same_y=True, legend=2)


def test_curves_are_drawn_on_logarithmic_axes(figure):
    left, right = figure.axes
    assert (left.get_xscale(), left.get_yscale(), right.get_xscale()) == ("log",) * 3
    (line,) = left.lines
    assert list(line.get_xdata()) == [1, 10] and line.get_color() == "red"
    assert (left.get_xlabel(), left.get_ylabel(), right.get_title(loc="right")) == ("x / s", "error", "made today")


def test_marks_along_an_edge_do_not_count_as_data(figure):
    _, right = figure.axes
    low, high = right.get_ylim()
    assert 1e-6 < low < 1e-5 and 1e-3 < high < 1e-2
    _, edge, level = right.lines
    assert edge.get_transform() == right.get_xaxis_transform()
    assert level.get_transform() == right.get_yaxis_transform()


def test_narrow_axes_have_plain_numbers(figure):
    figure.draw_without_rendering()
    left, right = ([label.get_text() for label in axes.get_xticklabels()] for axes in figure.axes)
    assert {"1", "2", "5", "10"} <= set(left)
    assert "20" not in right and "100" in right


def test_one_legend_with_the_curves_of_the_last_panel(figure):
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["b", "costs"]
    assert figure.get_suptitle() == "Title"


def test_legends_inside_and_empty_panels():
    figure = draw([[Panel([Curve([1, 2], [1, 2], "a")], legend="small"), Panel([], legend="small")]], (6, 3), legend=3)
    first, second = figure.axes
    assert first.get_legend() is not None and second.get_legend() is None
    assert figure.legends == []
    say(second, "nothing")
    assert [text.get_text() for text in second.texts] == ["nothing"]
    figure.draw_without_rendering()


def test_names_beside_the_panel_do_not_cover_each_other():
    """In the order of the last points, apart, in the colours of their curves; the legend has what is no curve."""
    curves = [Curve([1, 10], [1.0, 1e-3 * (1 + k / 50)], f"c{k}", {"color": f"C{k}"}) for k in range(5)]
    edge = Curve([2.0], [0.03], "costs", {"linestyle": "none", "marker": "x"}, along="x")
    figure = draw([[Panel([*curves, edge], direct=True)]], (6, 3), legend=2)
    (axes,) = figure.axes
    heights = [text.xyann[1] for text in axes.texts]
    assert [text.get_text() for text in axes.texts] == ["c0", "c1", "c2", "c3", "c4"]
    assert all(after - before > 0.06 for before, after in pairwise(heights))
    assert [text.get_color() for text in axes.texts] == [f"C{k}" for k in range(5)]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["costs"]


def test_names_at_the_top_stay_inside():
    curves = [Curve([1, 10], [1e-3, 1.0], f"c{k}") for k in range(8)]
    figure = draw([[Panel(curves, direct=True)]], (6, 3))
    heights = [text.xyann[1] for text in figure.axes[0].texts]
    assert max(heights) <= 1.0 + 1e-9 and min(heights) >= 0.0
