"""Panels of curves: logarithmic axes, marks along an edge, one legend."""

from __future__ import annotations

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
